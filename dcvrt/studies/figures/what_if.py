"""How far each assumption moves the least rating of the largest plan of a mode."""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING, Any

from dcvrt.studies.findings import Findings
from dcvrt.studies.store import records
from dcvrt.studies.style import FAILED, GREY, INK, PAGE, letters, mode_colour, mode_name, new_figure, panel

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ROW, HEAD = 0.2, 0.62
"""Height of a bar with its gap, and of what a panel has beside its bars, inches."""


def rows_of(findings: Findings, mode: str) -> tuple[dict[str, Any] | None, list[dict[str, Any]]]:
    """The plan of a mode as studied, and its what-ifs in the order of the study file; a rating that no
    converter reaches is None."""
    frame = findings.what_ifs
    rows = [
        row | {"rating": None if row["rating"] != row["rating"] else row["rating"]}
        for row in records(frame[frame["mode"] == mode])
    ]
    return (rows[0], rows[1:]) if rows else (None, [])


def modes_varied(findings: Findings) -> list[str]:
    """Modes whose plan as studied has a rating that what-ifs can be compared with."""
    return [
        mode
        for mode in findings.modes
        for base, varied in [rows_of(findings, mode)]
        if base is not None and base["rating"] is not None and varied
    ]


def draw(findings: Findings) -> Figure | None:
    """One bar an assumption, from the least rating as studied to the varied one, the longest on top.

    None when there is nothing to draw.
    """
    modes = modes_varied(findings)
    if not modes:
        return None
    counts = [len(rows_of(findings, mode)[1]) for mode in modes]
    figure = new_figure(PAGE, sum(HEAD + ROW * n for n in counts))
    panels = figure.subplots(
        len(modes), 1, squeeze=False, sharex=True, height_ratios=[HEAD + ROW * n for n in counts]
    )[:, 0]
    ratings = [
        row["rating"]
        for mode in modes
        for base, varied in [rows_of(findings, mode)]
        for row in [base, *varied]
        if row is not None and row["rating"] is not None
    ]
    room = 0.12 * max(max(ratings) - min(ratings), 0.1)
    panels[0].set_xlim(min(ratings) - room, max(ratings) + 2.5 * room)
    for axes, mode, letter in zip(panels, modes, letters(), strict=False):
        _bars(axes, findings, mode)
        base, _ = rows_of(findings, mode)
        assert base is not None
        panel(axes, letter, f"{mode_name(mode)}: {base['total_mw']:.1f} MW, needs β = {base['rating']:.3f}")
    panels[-1].set_xlabel("least converter rating over capacity, β")
    return figure


def _bars(axes: Axes, findings: Findings, mode: str) -> None:
    base, varied = rows_of(findings, mode)
    assert base is not None
    start, edge = base["rating"], axes.get_xlim()[1]
    far = float("inf")
    ordered = sorted(varied, key=lambda row: -abs((row["rating"] or far) - start))
    colour = mode_colour(mode, findings.modes)
    for k, row in enumerate(ordered):
        end = row["rating"]
        if end is None:
            axes.barh(
                k, edge - start, left=start, height=0.62, facecolor="none", edgecolor=FAILED, hatch="////"
            )
            text, place, side = f"none up to {row['high']:g}", edge, "right"
        else:
            axes.barh(k, end - start, left=start, height=0.62, color=colour)
            text, place, side = f"{end:.3f}", end, "left" if end >= start else "right"
        axes.annotate(
            text,
            (place, k),
            (3 if side == "left" else -3, 0),
            textcoords="offset points",
            ha=side,
            va="center",
            fontsize=6.8,
            color=INK,
            bbox=dict(facecolor="white", edgecolor="none", pad=0.6),
        )
    axes.axvline(start, color=GREY, linewidth=1.0)
    axes.set_yticks(range(len(ordered)), [_short(row["label"]) for row in ordered], parse_math=False)
    axes.set_ylim(len(ordered) - 0.4, -0.6)
    axes.grid(axis="y", visible=False)
    axes.tick_params(axis="x", labelbottom=True)


def _short(label: str) -> str:
    """A label that leaves room for the bars; the report's table has it in full."""
    return textwrap.shorten(label, 44, placeholder=" ...")
