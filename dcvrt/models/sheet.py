"""The sheet of a diagram: what an engineer needs to read before trusting it, as Markdown."""

from __future__ import annotations

import inspect
import textwrap
from collections.abc import Iterable
from typing import TYPE_CHECKING

from dcvrt.models.block import Block, Declared, Input, Output, Parameter, State

if TYPE_CHECKING:
    from dcvrt.models.diagram import Diagram


def table(head: Iterable[str], rows: Iterable[Iterable[object]]) -> str:
    """A Markdown table; empty text when there are no rows."""
    head = list(head)
    body = ["| " + " | ".join(str(cell).replace("|", "\\|") for cell in row) + " |" for row in rows]
    if not body:
        return ""
    return "\n".join(["| " + " | ".join(head) + " |", "|" + "---|" * len(head), *body])


def markdown(docstring: str) -> str:
    """A docstring with its ``.. math::`` parts as display formulas and ``:math:`` as inline ones."""
    lines = inspect.cleandoc(docstring).splitlines()
    out: list[str] = []
    k = 0
    while k < len(lines):
        if lines[k].strip() == ".. math::":
            k += 1
            formula = []
            while k < len(lines) and (not lines[k].strip() or lines[k].startswith("    ")):
                formula.append(lines[k])
                k += 1
            out += ["$$", textwrap.dedent("\n".join(formula)).strip(), "$$", ""]
        else:
            line = lines[k].replace(":math:`", "$`")
            while "$`" in line:
                before, _, rest = line.partition("$`")
                formula_text, _, after = rest.partition("`")
                line = f"{before}${formula_text}${after}"
            out.append(
                f"\n**Differs:**{line.removeprefix('Differs:')}" if line.startswith("Differs:") else line
            )
            k += 1
    return "\n".join(out).strip()


def number(value: float) -> str:
    """A value as a person writes it."""
    return f"{value:g}"


def interval(bounds: tuple[float, float]) -> str:
    """A range of values."""
    return f"[{bounds[0]:g}, {bounds[1]:g}]"


def ports(block: Block, name: str, feeds: dict[tuple[str, str], str]) -> list[list[str]]:
    """Rows of inputs, outputs and states of a block, with what feeds each input."""
    kinds: list[tuple[str, type[Declared]]] = [("input", Input), ("output", Output), ("state", State)]
    return [
        [label, f"`{key}`", d.unit, d.doc, feeds.get((name, key), "")]
        for label, kind in kinds
        for key, d in block.declared(kind).items()
    ]


def sheet(diagram: Diagram) -> str:
    """Markdown sheet of a diagram: see :meth:`Diagram.sheet`."""
    from dcvrt.models.diagram import path_of
    from dcvrt.models.structure import find
    from dcvrt.models.table import shortener

    def output(name: str, end: tuple[str, str]) -> tuple[str, ...]:
        signal = find(diagram, end)
        unit, doc = (signal.unit, signal.doc) if signal else ("", "")
        return "output", f"`{name}`", unit, doc, f"`{path_of(end)}`"

    feeds = {target: f"`{path_of(wire.source)}`" for target, wire in diagram.wires.items()}
    parts = [f"# {diagram.name}", diagram.doc]
    parts += [
        "## Parameters of the whole",
        table(
            ("parameter", "value", "unit", "bounds", "meaning", "source"),
            [
                (f"`{k}`", number(d.value), d.unit, interval(d.bounds), d.doc, d.source)
                for k, d in ((name, shared.declared) for name, shared in diagram.shared.items())
            ],
        ),
        "## Inputs and outputs",
        table(
            ("", "name", "unit", "meaning", "from"),
            [("input", f"`{k}`", d.unit, d.doc, "") for k, (d, _) in diagram.inputs.items()]
            + [output(k, end) for k, end in diagram.outputs.items()],
        ),
    ]  # fmt: skip
    for name, block in diagram.blocks.items():
        parts += [f"## {name}: {type(block).__name__}", markdown(type(block).__doc__ or "")]
        rows = []
        for key, p in block.declared(Parameter).items():
            bound = diagram.bindings.get((name, key))
            if bound is None:
                rows.append(
                    (
                        f"`{key}`",
                        number(block.values[key]),
                        p.unit,
                        interval(p.bounds),
                        p.doc,
                        block.sources[key],
                    )
                )
            else:
                rows.append((f"`{key}`", f"`{bound}`", p.unit, interval(p.bounds), p.doc, "bound"))
        parts.append(table(("parameter", "value", "unit", "bounds", "meaning", "source"), rows))
        parts.append(table(("", "name", "unit", "meaning", "from"), ports(block, name, feeds)))
        if block.modes:
            parts.append(
                table(
                    ("mode", *block.flags),
                    [(m, *(number(c[k]) for c in block.flags.values())) for k, m in enumerate(block.modes)],
                )
            )
            short = shortener(name)
            transitions = block.transitions(block.symbols(name))
            rows_of_modes = [
                (r.source, r.target, short(str(r.when)), short(str(r.held))) for r in transitions
            ]
            parts.append(table(("from", "to", "when", "held (s)"), rows_of_modes))
    notes = [f"- **{name}**: {note}" for name, block in diagram.blocks.items() for note in block.notes()]
    if notes:
        parts += ["## Where it differs from the paper", "\n".join(notes)]
    return "\n\n".join(part for part in parts if part) + "\n"
