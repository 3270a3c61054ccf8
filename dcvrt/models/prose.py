"""Docstrings as a sheet needs them: headings, text, formulas, tables and lists, whatever form they end in.

Text carries three marks: `code` between backticks, **bold**, and formulas between dollar signs.
"""

from __future__ import annotations

import inspect
import re
import textwrap
from dataclasses import dataclass


@dataclass(frozen=True)
class Heading:
    """Title of a section; level 1 is that of the whole sheet."""

    level: int
    text: str


@dataclass(frozen=True)
class Text:
    """A paragraph."""

    text: str


@dataclass(frozen=True)
class Formula:
    """A displayed formula in LaTeX."""

    tex: str


@dataclass(frozen=True)
class Table:
    """Rows under a head; cells are text."""

    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Items:
    """A list of short texts."""

    items: tuple[str, ...]


Node = Heading | Text | Formula | Table | Items

SPANS = re.compile(r"(?P<math>\$[^$]+\$)|(?P<code>`[^`]+`)|(?P<bold>\*\*.+?\*\*)")
"""The marks in a text."""

_SECTION = re.compile(r"(Parameters|Returns|Raises|Attributes|Examples|Notes|See Also)\n-{3,}")


def marks(text: str) -> str:
    """Text with the marks of reStructuredText in it, with our own marks."""
    text = re.sub(r":math:`([^`]*)`", r"$\1$", text)
    text = re.sub(r":\w+:`~?(?:[\w.]*\.)?(\w+)`", r"`\1`", text)
    return re.sub(r"``([^`]*)``", r"`\1`", text)


def parse(docstring: str) -> list[Node]:
    """Nodes of a docstring; examples and numpydoc sections, which are for programmers, are left out.

    >>> parse("Lag of a signal.\\n\\n.. math::\\n    T y' = u - y\\n\\nDiffers: not in the paper.")[1:]
    [Formula(tex="T y' = u - y"), Text(text='**Differs:** not in the paper.')]
    """
    text = inspect.cleandoc(docstring)
    if section := _SECTION.search(text):
        text = text[: section.start()]
    lines = text.splitlines()
    nodes: list[Node] = []
    k = 0
    while k < len(lines):
        line = lines[k]
        if line.startswith(">>>"):
            while k < len(lines) and lines[k].strip():
                k += 1
        elif line.startswith(".. math::"):
            body = [line.removeprefix(".. math::").strip()]
            k += 1
            while k < len(lines) and (not lines[k].strip() or lines[k].startswith("    ")):
                body.append(lines[k])
                k += 1
            formulas = re.split(r"\n\s*\n", textwrap.dedent("\n".join(body[1:])).strip("\n"))
            nodes += [Formula(f.strip()) for f in [body[0], *formulas] if f.strip()]
        elif line.startswith("|"):
            rows = []
            while k < len(lines) and lines[k].startswith("|"):
                rows.append(tuple(marks(c.strip()) for c in re.split(r"(?<!\\)\|", lines[k])[1:-1]))
                k += 1
            below = [row for row in rows[1:] if not re.fullmatch(r"[-: ]*", "".join(row))]
            nodes.append(Table(rows[0], tuple(below)))
        elif line.startswith(("- ", "* ")):
            items: list[str] = []
            while k < len(lines) and lines[k].startswith(("- ", "* ", "  ")):
                if lines[k].startswith("  "):
                    items[-1] += " " + lines[k].strip()
                else:
                    items.append(lines[k][2:].strip())
                k += 1
            nodes.append(Items(tuple(marks(item) for item in items)))
        elif line.strip():
            paragraph = [line.strip()]
            k += 1
            while k < len(lines) and lines[k].strip() and not _starts_something(lines[k]):
                paragraph.append(lines[k].strip())
                k += 1
            joined = marks(" ".join(paragraph))
            nodes.append(Text(re.sub(r"^Differs:", "**Differs:**", joined)))
        else:
            k += 1
    return nodes


def _starts_something(line: str) -> bool:
    """Whether a line ends the paragraph before it."""
    return line.startswith((".. math::", "|", "- ", "* ", ">>>", "Differs:"))
