"""The tornado: how far each assumption moves the hosted MW of a mode, by gradients and by searching again."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from dcvrt.studies.findings import Findings
from dcvrt.studies.sensitivity import SHOWN
from dcvrt.studies.store import records
from dcvrt.studies.style import FAILED, GREY, INK, PAGE, letters, mode_colour, mode_name, new_figure, panel

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ROW, HEAD = 0.24, 0.75
"""Height of a bar with its gap, and of what a panel has beside its bars, inches."""
MOST = 12
"""Assumptions that are drawn; the report's table has all."""


def rows_of(findings: Findings, mode: str) -> list[dict[str, Any]]:
    """Sensitivities of a mode, those with most at stake first; what is missing is None."""
    frame = findings.sensitivities
    return [
        {name: None if value != value else value for name, value in row.items()}
        for row in records(frame[frame["mode"] == mode])
    ]


def drawn(findings: Findings, mode: str) -> list[dict[str, Any]]:
    """Assumptions with something to show."""
    return [row for row in rows_of(findings, mode) if row["stake_mw"] >= SHOWN][:MOST]


def draw(findings: Findings) -> Figure | None:
    """One bar for each end of an assumption's range, those with most at stake on top.

    None when no assumption of any mode moves anything.
    """
    modes = [mode for mode in findings.modes if drawn(findings, mode)]
    if not modes:
        return None
    heights = [HEAD + ROW * len(drawn(findings, mode)) for mode in modes]
    figure = new_figure(PAGE, sum(heights) + 0.3)
    panels = figure.subplots(len(modes), 1, squeeze=False, height_ratios=heights)[:, 0]
    for axes, mode, letter in zip(panels, modes, letters(), strict=False):
        about = findings.sensitivity_plans[mode]
        _bars(axes, findings, mode, about)
        panel(axes, letter, f"{mode_name(mode)} at β = {about['beta']:g}: {about['total_mw']:.1f} MW")
    panels[-1].set_xlabel("change of the hosted capacity (MW)")
    _legend(figure, findings, modes[0])
    return figure


def _bars(axes: Axes, findings: Findings, mode: str, about: dict[str, Any]) -> None:
    rows = drawn(findings, mode)
    colour = mode_colour(mode, findings.modes)
    for k, row in enumerate(rows):
        for side, offset, shade in (("low", -0.19, 0.45), ("high", 0.19, 1.0)):
            end, y = row["sides"][side], k + offset
            mw = by_gradient(end)
            if mw is not None:
                axes.barh(y, mw, height=0.36, color=colour, alpha=shade, linewidth=0)
            if end["rerun_mw"] is not None:
                change = end["rerun_mw"] - about["rerun_mw"]
                axes.plot(change, y, "D", markersize=4, color=INK, fillstyle="none", clip_on=False)
            elif end["unseen"]:
                axes.plot(0.0, y, "x", markersize=5, color=FAILED)
    axes.axvline(0.0, color=GREY, linewidth=1.0)
    axes.use_sticky_edges = False  # else bars to one side only leave 0 at the very edge
    axes.margins(x=0.08)
    axes.set_yticks(range(len(rows)), [label(row) for row in rows], parse_math=False)
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.grid(axis="y", visible=False)
    axes.tick_params(axis="x", labelbottom=True)


def by_gradient(end: dict[str, Any]) -> float | None:
    """What gradients say of one end of a range; None where they say nothing: no margin holds the plan, the
    values cannot be, or the plan fails by what they do not see and they see nothing else."""
    mw: float | None = end["gradient_mw"]
    blind = mw is None or end["refused"] or (end["unseen"] and abs(mw) < SHOWN)
    return None if blind else mw


def label(row: dict[str, Any]) -> str:
    """Path of an assumption with its range."""
    unit = "" if row["unit"] == "1" else f" {row['unit']}"
    sides = row["sides"]
    return f"{row['path']} = {sides['low']['value']:g} … {sides['high']['value']:g}{unit}"


def _legend(figure: Figure, findings: Findings, mode: str) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    colour = mode_colour(mode, findings.modes)
    figure.legend(
        handles=[
            Patch(facecolor=colour, alpha=0.45, label="low end, by gradient"),
            Patch(facecolor=colour, label="high end, by gradient"),
            Line2D([], [], marker="D", color=INK, fillstyle="none", linestyle="", label="searched again"),
            Line2D([], [], marker="x", color=FAILED, linestyle="", label="plan fails, unseen by gradients"),
        ],
        loc="outside lower center",
        ncols=4,
    )
