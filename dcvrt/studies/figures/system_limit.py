"""Hosted capacity against the load that may be lost at once: a panel a mode, a curve a rating."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from dcvrt.studies.findings import Findings
from dcvrt.studies.style import (
    FAILED,
    GREY,
    INK,
    MARKERS,
    PAGE,
    letters,
    mode_colour,
    mode_name,
    new_figure,
    panel,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LIGHTEST = 0.75
"""How much white the curve of the lowest rating is mixed with."""
MANY = 4
"""Ratings from which on the legend takes two columns."""


def curve(rows: Sequence[Mapping[str, Any]]) -> tuple[list[float], list[float]]:
    """What may be hosted within a loss at once, MW against MW, from nothing on.

    >>> curve([{"loss_mw": 8.0, "total_mw": 90.0}, {"loss_mw": 11.0, "total_mw": 120.0}])
    ([0.0, 8.0, 11.0], [0.0, 90.0, 120.0])
    """
    points = [(0.0, 0.0), *sorted((row["loss_mw"], row["total_mw"]) for row in rows)]
    return [loss for loss, _ in points], [total for _, total in points]


def draw(findings: Findings) -> Figure | None:
    """Curves of all modes and ratings; plans that failed the replay are crossed out. None when no limit was
    tried.

    Steps, not straight lines, since between two vectors only the smaller one is known to keep to the limit.
    Filled symbols are plans that were searched for a limit, open ones plans of the frontier, whose every site
    rides through, each at what it loses at once in the replay.
    """
    found = findings.system_limits
    if not found["rows"]:
        return None
    figure = new_figure(PAGE, 3.4)
    panels = figure.subplots(1, len(findings.modes), sharex=True, sharey=True, squeeze=False)[0]
    losses = [row["aggregate_loss_mw"] or 0.0 for name in ("rows", "every_site") for row in found[name]]
    edge = 1.1 * max([*losses, *(row["loss_mw"] for row in found["front"]), 1.0])
    panels[0].set_xlim(-0.02 * edge, edge)
    for axes, mode, letter in zip(panels, findings.modes, letters(), strict=False):
        axes.axhline(findings.no_vrt_mw, color=GREY, linewidth=1.0, linestyle=(0, (6, 2)))
        _curves(axes, findings, mode, edge)
        axes.set_xlabel("load lost at once in the worst fault (MW)")
        panel(axes, letter, mode_name(mode))
    panels[0].set_ylabel("hosted capacity (MW)")
    panels[0].set_ylim(-0.03 * findings.no_vrt_mw, 1.08 * max(findings.no_vrt_mw, panels[0].dataLim.ymax))
    failed = any(row["passed"] is False for name in ("rows", "every_site") for row in found[name])
    figure.legend(handles=_handles(failed), loc="outside lower center", ncols=3)
    return figure


def _curves(axes: Axes, findings: Findings, mode: str, edge: float) -> None:
    from matplotlib.colors import to_rgb

    found = findings.system_limits
    here = {name: [row for row in found[name] if row["mode"] == mode] for name in found}
    betas = sorted({row["beta"] for row in [*here["front"], *here["rows"]]})
    full = to_rgb(mode_colour(mode, findings.modes))
    for k, beta in enumerate(betas):
        white = LIGHTEST * (1.0 - k / max(len(betas) - 1, 1)) if len(betas) > 1 else 0.0
        colour = tuple(white + (1.0 - white) * part for part in full)
        front, plans, every = (
            [row for row in here[name] if row["beta"] == beta] for name in ("front", "rows", "every_site")
        )
        loss, total = curve(front)
        axes.step(
            [*loss, edge], [*total, total[-1]], where="post", color=colour, label=f"β = {beta:g}",
            linewidth=1.1, zorder=3 + 0.01 * k,
        )  # fmt: skip
        marker = MARKERS[k % len(MARKERS)]
        for rows, filled, size in ((plans, True, 4.5), (every, False, 7.0)):
            passed = [row for row in rows if row["passed"]]
            axes.plot(
                [row["aggregate_loss_mw"] for row in passed],
                [row["total_mw"] for row in passed],
                linestyle="none", marker=marker, markersize=size, markeredgecolor=colour,
                markerfacecolor=colour if filled else "none", zorder=4,
            )  # fmt: skip
    bad = [row for row in here["rows"] if row["passed"] is False]
    axes.plot(
        [row["aggregate_loss_mw"] or row["limit_mw"] for row in bad],
        [row["total_mw"] for row in bad],
        linestyle="none", marker="x", markersize=8, markeredgewidth=1.7, color=FAILED, zorder=9,
    )  # fmt: skip
    axes.legend(loc="lower right", ncols=2 if len(betas) >= MANY else 1)


def _handles(failed: bool) -> list[Any]:
    """Legend of what all panels share."""
    from matplotlib.lines import Line2D

    handles = [
        Line2D([], [], color=GREY, linewidth=1.0, linestyle=(0, (6, 2)), label="without ride-through"),
        Line2D([], [], color=INK, label="replayed: as much at this loss, or more"),
        Line2D([], [], linestyle="none", color=INK, marker="o", label="searched within a limit"),
        Line2D(
            [], [], linestyle="none", marker="o", markersize=7, markerfacecolor="none", markeredgecolor=INK,
            label="every site rides through",
        ),
    ]  # fmt: skip
    if failed:
        handles.append(
            Line2D(
                [], [], linestyle="none", marker="x", markersize=7, markeredgewidth=1.7, color=FAILED,
                label="failed the replay",
            )
        )  # fmt: skip
    return handles
