"""Hosted capacity against the load that may be lost at once, a panel a mode and a curve a rating."""

from __future__ import annotations

from collections.abc import Sequence
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

LIGHTEST = 0.55
"""How much white the curve of the lowest rating is mixed with."""
MANY = 4
"""Ratings from which on the legend takes two columns."""


def curve(rows: Sequence[dict[str, Any]]) -> tuple[list[float], list[float]]:
    """The plans that passed as a curve: loss at once in the replay, MW, and hosted capacity, MW.

    Each plan stands at what it loses, which is less than its limit where the network decides. Limits in MW
    and as a share of the load lie on the same curve: a plan that is the largest for its share is the largest
    for what it loses.

    >>> plan = {"passed": True, "aggregate_loss_mw": 8.0, "total_mw": 90.0}
    >>> nothing = {"passed": None, "aggregate_loss_mw": 0.0, "total_mw": 0.0}
    >>> curve([plan, nothing, plan])
    ([0.0, 8.0], [0.0, 90.0])
    """
    passed = [row for row in rows if row["passed"] or not row["total_mw"] > 0]
    points = sorted({(row["aggregate_loss_mw"], row["total_mw"]) for row in passed})
    return [loss for loss, _ in points], [total for _, total in points]


def draw(findings: Findings) -> Figure | None:
    """Curves of all modes and ratings; plans that failed the replay are crossed out.

    Steps, not straight lines, since between two plans only the smaller one is known to keep to the limit.

    Open symbols are plans of the frontier, whose every site rides through, at what they lose at once. None
    when no limit was tried.
    """
    found = findings.system_limits
    if not found["rows"]:
        return None
    figure = new_figure(PAGE, 3.0)
    panels = figure.subplots(1, len(findings.modes), sharex=True, sharey=True, squeeze=False)[0]
    losses = [row["aggregate_loss_mw"] or 0.0 for name in ("rows", "every_site") for row in found[name]]
    edge = 1.2 * max([*losses, 1.0])
    panels[0].set_xlim(-0.02 * edge, edge)
    for axes, mode, letter in zip(panels, findings.modes, letters(), strict=False):
        axes.axhline(findings.no_vrt_mw, color=GREY, linewidth=1.0, linestyle=(0, (6, 2)))
        _curves(axes, findings, mode)
        axes.set_xlabel("load lost at once in the worst fault (MW)")
        panel(axes, letter, mode_name(mode))
    panels[0].set_ylabel("hosted capacity (MW)")
    panels[0].set_ylim(-0.03 * findings.no_vrt_mw, 1.08 * max(findings.no_vrt_mw, panels[0].dataLim.ymax))
    failed = any(row["passed"] is False for name in ("rows", "every_site") for row in found[name])
    figure.legend(handles=_handles(failed), loc="outside lower center", ncols=4)
    return figure


def _curves(axes: Axes, findings: Findings, mode: str) -> None:
    from matplotlib.colors import to_rgb

    found = findings.system_limits
    betas = sorted({row["beta"] for row in found["rows"]})
    full = to_rgb(mode_colour(mode, findings.modes))
    for k, beta in enumerate(betas):
        white = LIGHTEST * (1.0 - k / max(len(betas) - 1, 1)) if len(betas) > 1 else 0.0
        colour = tuple(white + (1.0 - white) * part for part in full)
        marker = MARKERS[k % len(MARKERS)]
        rows = [row for row in found["rows"] if (row["mode"], row["beta"]) == (mode, beta)]
        loss, total = curve(rows)
        axes.step(loss, total, where="post", color=colour, marker=marker, label=f"β = {beta:g}", zorder=3)
        widest = max([row["limit_mw"] for row in rows if row["passed"]], default=0.0)
        if loss and widest > loss[-1]:  # the network decides: as much up to the largest limit
            axes.plot([loss[-1], min(widest, axes.get_xlim()[1])], [total[-1]] * 2, color=colour, zorder=2.5)
        every = [r for r in found["every_site"] if (r["mode"], r["beta"]) == (mode, beta) and r["passed"]]
        axes.plot(
            [row["aggregate_loss_mw"] for row in every],
            [row["total_mw"] for row in every],
            linestyle="none", marker=marker, markersize=9, markerfacecolor="none", markeredgecolor=colour,
            markeredgewidth=1.2, zorder=4,
        )  # fmt: skip
        bad = [row for row in rows if row["passed"] is False]
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
        Line2D([], [], color=INK, marker="o", label="within a limit on the loss at once"),
        Line2D(
            [], [], linestyle="none", marker="o", markersize=9, markerfacecolor="none", markeredgecolor=INK,
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
