"""The forms of a sheet: Markdown, a LaTeX document, and a page in a terminal."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import TYPE_CHECKING

from dcvrt.models.prose import SPANS, Formula, Heading, Items, Node, Table, Text
from dcvrt.models.unicode_math import readable

if TYPE_CHECKING:
    from rich.console import RenderableType

# ---- Markdown ---------------------------------------------------------------------------------------------


def markdown(nodes: list[Node]) -> str:
    """A Markdown text, formulas between dollar signs."""
    return "\n\n".join(_markdown(node) for node in nodes) + "\n"


def _markdown(node: Node) -> str:
    if isinstance(node, Heading):
        return f"{'#' * node.level} {node.text}"
    if isinstance(node, Formula):
        return f"$$\n{node.tex}\n$$"
    if isinstance(node, Items):
        return "\n".join(f"- {item}" for item in node.items)
    if isinstance(node, Text):
        return node.text

    def row(cells: tuple[str, ...]) -> str:
        return "| " + " | ".join(re.sub(r"(?<!\\)\|", r"\\|", cell) for cell in cells) + " |"

    return "\n".join([row(node.head), "|" + "---|" * len(node.head), *(row(cells) for cells in node.rows)])


# ---- LaTeX ------------------------------------------------------------------------------------------------

PREAMBLE = r"""\documentclass[10pt,a4paper]{article}
\usepackage[T1]{fontenc}
\usepackage[margin=18mm]{geometry}
\usepackage{amsmath,amssymb,array,booktabs,longtable}
\setlength{\parindent}{0pt}
\setlength{\parskip}{4pt}
\newcolumntype{L}[1]{>{\raggedright\arraybackslash}p{#1}}
\begin{document}
"""
SPECIAL = {
    "\\": r"\textbackslash{}", "{": r"\{", "}": r"\}", "_": r"\_", "%": r"\%", "&": r"\&", "#": r"\#",
    "$": r"\$", "^": r"\textasciicircum{}", "~": r"\textasciitilde{}", "<": r"\textless{}",
    ">": r"\textgreater{}", "|": r"\textbar{}",
    "α": r"$\alpha$", "β": r"$\beta$", "δ": r"$\delta$", "ε": r"$\epsilon$", "η": r"$\eta$", "θ": r"$\theta$",
    "λ": r"$\lambda$", "ρ": r"$\rho$", "σ": r"$\sigma$", "τ": r"$\tau$", "φ": r"$\varphi$", "ω": r"$\omega$",
    "Δ": r"$\Delta$", "±": r"$\pm$", "≤": r"$\le$", "≥": r"$\ge$", "·": r"$\cdot$", "×": r"$\times$",
    "²": "\\textsuperscript{2}", "→": r"$\to$", "°": r"$^\circ$", "–": "--", "—": "---", "’": "'",
}  # fmt: skip
"""What stands for itself in Markdown but not in LaTeX."""


def latex(nodes: list[Node]) -> str:
    """A LaTeX document that compiles on its own."""
    return PREAMBLE + "\n".join(_latex(node) for node in nodes) + "\n\\end{document}\n"


def _latex(node: Node) -> str:
    if isinstance(node, Heading):
        command = ("section", "subsection", "subsubsection", "paragraph")[min(node.level, 4) - 1]
        return f"\\{command}*{{{_inline(node.text)}}}"
    if isinstance(node, Formula):
        body = node.tex
        if "\\\\" in re.sub(r"\\begin\{(\w+\*?)\}.*?\\end\{\1\}", "", body, flags=re.DOTALL):
            body = f"\\begin{{aligned}}{body}\\end{{aligned}}"
        return f"\\[\n{body}\n\\]"
    if isinstance(node, Items):
        items = "\n".join(rf"\item {_inline(item)}" for item in node.items)
        return f"\\begin{{itemize}}\n{items}\n\\end{{itemize}}"
    if isinstance(node, Text):
        return _inline(node.text) + "\n"
    share = _shares(node)
    columns = "".join(rf"L{{{width:.3f}\linewidth}}" for width in share)
    head = " & ".join(rf"\textbf{{{_inline(cell)}}}" for cell in node.head)
    body = "\n".join(" & ".join(_inline(cell) for cell in row) + r" \\" for row in node.rows)
    return (
        f"{{\\footnotesize\\setlength{{\\tabcolsep}}{{3pt}}\n\\begin{{longtable}}{{{columns}}}\n\\toprule\n"
        f"{head} \\\\\n\\midrule\n\\endhead\n{body}\n\\bottomrule\n\\end{{longtable}}}}\n"
    )


def _shares(node: Table) -> list[float]:
    """Widths of the columns by what stands in them, together a little less than the line."""
    lengths = [
        min(30, max(6, *(len(cell) for cell in column))) for column in zip(node.head, *node.rows, strict=True)
    ]
    room = 0.97 - 0.012 * len(lengths)
    return [room * length / sum(lengths) for length in lengths]


def _inline(text: str) -> str:
    """Text with its marks as LaTeX."""
    return _spans(
        text,
        plain=lambda s: "".join(SPECIAL.get(c, c) for c in s),
        code=lambda s: r"\texttt{" + "".join(SPECIAL.get(c, c) for c in s) + "}",
        bold=lambda s: r"\textbf{" + _inline(s) + "}",
        math=lambda s: f"${s}$",
    )


def _spans(
    text: str,
    plain: Callable[[str], str],
    code: Callable[[str], str],
    bold: Callable[[str], str],
    math: Callable[[str], str],
) -> str:
    """Text with each kind of mark put through its own function."""
    out, at = [], 0
    for match in SPANS.finditer(text):
        out.append(plain(text[at : match.start()]))
        if match["math"]:
            out.append(math(match[0][1:-1]))
        elif match["code"]:
            out.append(code(match[0][1:-1]))
        else:
            out.append(bold(match[0][2:-2]))
        at = match.end()
    return "".join([*out, plain(text[at:])])


# ---- terminal ---------------------------------------------------------------------------------------------


NARROW = 100
"""Columns of a terminal below which the source of a parameter stands under its meaning, not beside it."""


def terminal(nodes: list[Node], width: int) -> list[RenderableType]:
    """What rich prints on a terminal of this width: tables with borders, formulas as a line of text."""
    from rich import box
    from rich.console import Group
    from rich.markup import escape
    from rich.padding import Padding
    from rich.table import Table as Grid
    from rich.text import Text as Styled

    def styled(text: str) -> Styled:
        return Styled.from_markup(
            _spans(
                text,
                plain=escape,
                code=lambda s: f"[cyan]{escape(s.replace('*', ' * '))}[/]",  # a line may break there
                bold=lambda s: f"[bold]{escape(s)}[/]",
                math=lambda s: f"[green]{escape(readable(s))}[/]",
            )
        )

    out: list[RenderableType] = []
    for node in nodes:
        if isinstance(node, Heading):
            style = "bold underline" if node.level == 1 else "bold"
            out += ["", Styled(node.text, style=style)] if out else [Styled(node.text, style=style)]
        elif isinstance(node, Formula):
            lines = [line for line in re.split(r",? {3,}", readable(node.tex)) if line]
            out.append(Padding(Styled("\n".join(lines), style="green"), (0, 0, 0, 4), expand=False))
        elif isinstance(node, Items):
            for item in node.items:
                grid = Grid.grid(padding=(0, 1))
                grid.add_row("-", styled(item))
                out.append(grid)
        elif isinstance(node, Text):
            out.append(styled(node.text))
        else:
            together = width < NARROW and node.head[-2:] == ("meaning", "source")
            grid = Grid(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), show_edge=False)
            for k, head in enumerate(node.head[:-1] if together else node.head):
                narrow = max(len(head), *(len(row[k]) for row in node.rows)) <= 14
                grid.add_column(head, no_wrap=narrow, overflow="fold")
            for row in node.rows:
                cells: list[RenderableType] = [styled(cell) for cell in row]
                if together:  # of a bound parameter the value tells what it is bound to
                    source = [Styled(row[-1], style="dim")] if row[-1] != "bound" else []
                    cells[-2:] = [Group(cells[-2], *source)]
                grid.add_row(*cells)
            out += [grid, ""]
    return out
