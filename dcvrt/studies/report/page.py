"""Pieces of an HTML page: escaped text, tables with headers, figures that stand in the page itself."""

from __future__ import annotations

import html
import re
from collections.abc import Sequence
from pathlib import Path

SHORT = 22
"""Cells of at most so many characters stay on one line."""


class Safe(str):
    """Text that is already HTML; everything else is escaped where it enters the page."""


def escape(text: object) -> Safe:
    """Text as HTML, unless it is :class:`Safe` already.

    >>> escape("a < b & c")
    'a &lt; b &amp; c'
    """
    return text if isinstance(text, Safe) else Safe(html.escape(str(text), quote=True))


def number(value: float | None, digits: int = 1, missing: str = "–") -> str:
    """A number with a fixed count of decimals; a dash where there is none.

    >>> number(3.14159, 2), number(None), number(float("nan")), number(-0.0001, 2)
    ('3.14', '–', '–', '0.00')
    """
    if value is None or value != value:
        return missing
    text = f"{value:.{digits}f}"
    return text[1:] if text.startswith("-") and float(text) == 0.0 else text


def magnitude(value: float | None, missing: str = "–") -> str:
    """A number that may be tiny, with its power of ten; a dash where there is none.

    >>> magnitude(2.58e-9), magnitude(0.0), magnitude(None), magnitude(float("nan"))
    ('2.6e-09', '0', '–', '–')
    """
    if value is None or value != value:
        return missing
    return "0" if value == 0 else f"{value:.1e}"


def paragraph(text: object, kind: str = "") -> Safe:
    """A paragraph, with a class when `kind` is given."""
    return Safe(f'<p class="{kind}">{escape(text)}</p>' if kind else f"<p>{escape(text)}</p>")


def bullets(items: Sequence[object]) -> Safe:
    """An unordered list."""
    return Safe("<ul>" + "".join(f"<li>{escape(item)}</li>" for item in items) + "</ul>")


def section(title: str, *parts: Safe, name: str = "") -> Safe:
    """A section with a heading and an anchor."""
    anchor = name or re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-")
    body = "\n".join(part for part in parts if part)
    return Safe(
        f'<section id="{anchor}" aria-labelledby="{anchor}-title">\n<h2 '
        f'id="{anchor}-title">{escape(title)}</h2>\n'
        f"{body}\n</section>"
    )


def notice(title: str, body: Safe, kind: str = "warning") -> Safe:
    """A box that must not be overlooked. `kind` is warning, good or neutral."""
    return Safe(
        f'<div class="notice {kind}" role="note"><p class="notice-title">{escape(title)}</p>{body}</div>'
    )


def badge(verdict: str) -> Safe:
    """A verdict as a coloured word; the word alone already tells it."""
    kind = {"passed": "good", "failed": "bad"}.get(verdict, "plain")
    return Safe(
        f'<span class="badge {kind}">{escape(verdict.upper() if verdict == "failed" else verdict)}</span>'
    )


def table(
    caption: str,
    head: Sequence[object],
    rows: Sequence[Sequence[object]],
    words: Sequence[int] = (),
    marked: Sequence[int] = (),
) -> Safe:
    """A table with a caption, column headers and row headers, in a box that scrolls on narrow screens.

    Parameters
    ----------
    caption : what the table shows.
    head : column headers.
    rows : cells; the first of each is its header.
    words : columns (from 0) that hold text, beside the first; all others are aligned as numbers.
    marked : rows (from 0) that stand out.
    """
    if not rows:
        return paragraph(f"{caption}: none.")
    kinds = ["text" if k == 0 or k in words else "number" for k in range(len(head))]
    top = "".join(
        f'<th scope="col" class="{kind}">{escape(text)}</th>' for kind, text in zip(kinds, head, strict=True)
    )
    lines = []
    for n, row in enumerate(rows):
        first, *rest = zip(kinds, row, strict=True)
        cells = f'<th scope="row" class="{first[0]}">{escape(first[1])}</th>'
        cells += "".join(
            f'<td class="{kind}{" short" if len(str(cell)) <= SHORT else ""}">{escape(cell)}</td>'
            for kind, cell in rest
        )
        lines.append(f'<tr class="marked">{cells}</tr>' if n in marked else f"<tr>{cells}</tr>")
    return Safe(
        f'<div class="scroll" tabindex="0" role="region" aria-label="{escape(caption)}"><table>'
        f"<caption>{escape(caption)}</caption><thead><tr>{top}</tr></thead>\n<tbody>\n"
        + "\n".join(lines)
        + "\n</tbody></table></div>"
    )


def figure(svg: Path, alt: str, caption: str) -> Safe:
    """A drawing inside the page, with its alternative text and caption."""
    drawing = inline(svg.read_text(encoding="utf-8"), prefix=svg.stem, alt=alt)
    return Safe(f"<figure>{drawing}<figcaption>{escape(caption)}</figcaption></figure>")


def inline(svg: str, prefix: str, alt: str) -> Safe:
    """An SVG file as an element of a page: no prolog, no fixed size, ids of its own, and a text to hear.

    >>> inline('<?xml version="1.0"?><svg width="9pt" viewBox="0 0 9 9"><g id="a"/></svg>', "f", "nothing")
    '<svg role="img" aria-label="nothing" viewBox="0 0 9 9"><g id="f-a"/></svg>'
    """
    body = svg[svg.index("<svg") :]
    body = re.sub(r"<metadata>.*?</metadata>", "", body, flags=re.DOTALL)
    opening, rest = body.split(">", 1)
    opening = re.sub(r'\s(?:width|height)="[^"]*"', "", opening)
    body = (
        opening.replace("<svg", f'<svg role="img" aria-label="{html.escape(alt, quote=True)}"', 1)
        + ">"
        + rest
    )
    body = re.sub(r'\bid="([^"]+)"', rf'id="{prefix}-\1"', body)
    body = re.sub(r'href="#([^"]+)"', rf'href="#{prefix}-\1"', body)
    body = re.sub(r"url\(#([^)]+)\)", rf"url(#{prefix}-\1)", body)
    return Safe(body.strip())


def definitions(pairs: Sequence[tuple[object, object]]) -> Safe:
    """A list of terms and what they are."""
    return Safe(
        "<dl>"
        + "".join(f"<div><dt>{escape(term)}</dt><dd>{escape(text)}</dd></div>" for term, text in pairs)
        + "</dl>"
    )
