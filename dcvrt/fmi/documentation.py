"""The documentation inside an FMU: one page without any outside resource, and the licences."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from importlib.resources import files

from dcvrt import __version__
from dcvrt.dae import Row
from dcvrt.fmi.description import mode_name
from dcvrt.fmi.variables import Layout, structured

STYLE = (
    "body{font:16px/1.5 sans-serif;max-width:70em;margin:2em auto;padding:0 1em}"
    "table{border-collapse:collapse}td,th{border:1px solid #bbb;padding:.2em .6em;text-align:left}"
    "pre{white-space:pre-wrap;background:#f4f4f4;padding:1em}"
)
USE = (
    "Per unit on the base of the facility, import positive, phasors in the network frame at nominal "
    "frequency, time in seconds.",
    "The unit starts at its equilibrium for the inputs and parameters set before the end of the "
    "initialization; parameters are fixed from then on. Without an equilibrium the initialization fails, and "
    "the log names the largest residuals.",
    "Modes change when the guard of a row has been true, strictly, for longer than its dwell time; rows are "
    "tried from top to bottom. Guards and bounds are event indicators, dwell times are time events. A tool "
    "shall treat a jump of an input as an event.",
    "A state that leaves its bounds ends the simulation: the unit asks to terminate, and the log says what "
    "happened.",
)


def page(layout: Layout, doc: str, sheet: str) -> str:
    """Text of `documentation/index.html`."""
    dae = layout.dae
    body = [f"<h1>{escape(dae.name)}</h1>", f"<p>{escape(doc)}</p>" if doc else ""]
    body += [f"<p>{escape(text)}</p>" for text in USE]
    ports = [
        *(("input", structured(r.path), r.unit, r.doc) for r in dae.inputs),
        *(("output", structured(r.path), r.unit, r.doc) for r in dae.outputs),
        *(("output", mode_name(dae, a.path), "mode", ", ".join(a.modes)) for a in dae.automata),
    ]
    body += [heading("Inputs and outputs"), table(("", "name", "unit", "meaning"), ports)]
    if dae.parameter_rows:
        parameters = [
            (structured(r.path), f"{r.value:g}", r.unit, limits(r), r.doc, r.source)
            for r in dae.parameter_rows
        ]
        titles = ("name", "value", "unit", "bounds", "meaning", "source")
        body += [heading("Parameters"), table(titles, parameters)]
    states = [(structured(r.path), r.unit, limits(r), r.doc, r.crossing) for r in dae.states]
    body += [heading("States"), table(("name", "unit", "bounds", "meaning", "beyond the bounds"), states)]
    if layout.rows:
        names = layout.indicator_names()[: len(layout.rows)]
        changes = [(name, row.text) for name, (_, row) in zip(names, layout.rows, strict=True)]
        body += [heading("Changes of mode, tried from top to bottom"), table(("guard", "row"), changes)]
    if dae.notes:
        body += [heading("Deviations from the source of the equations")]
        body += ["<ul>", *(f"<li>{escape(note)}</li>" for note in dae.notes), "</ul>"]
    if sheet:
        body += [heading("Equations of every block"), f"<pre>{escape(sheet)}</pre>"]
    body.append(f"<p>Written by dcvrt {__version__}.</p>")
    head = f'<meta charset="utf-8">\n<title>{escape(dae.name)}</title>\n<style>{STYLE}</style>'
    text = "\n".join(filter(None, body))
    return f'<!DOCTYPE html>\n<html lang="en">\n<head>\n{head}\n</head>\n<body>\n{text}\n</body>\n</html>\n'


def limits(row: Row) -> str:
    """Bounds as an interval."""
    return f"[{row.bounds[0]:g}, {row.bounds[1]:g}]"


def heading(text: str) -> str:
    """A heading of second order."""
    return f"<h2>{escape(text)}</h2>"


def table(titles: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table of plain texts."""

    def line(cells: Sequence[str], tag: str) -> str:
        return "<tr>" + "".join(f"<{tag}>{escape(cell)}</{tag}>" for cell in cells) + "</tr>"

    return "\n".join(("<table>", line(titles, "th"), *(line(row, "td") for row in rows), "</table>"))


def licence_text() -> str:
    """What each part of an FMU may be used under."""
    return (files("dcvrt.fmi") / "sources" / "LICENCES.txt").read_text("utf-8")
