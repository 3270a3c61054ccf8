"""Hosting capacity and its allocation against the converter rating."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Any

from dcvrt.studies.findings import Findings
from dcvrt.studies.rows import Row, by_site, verdict
from dcvrt.studies.style import (
    FAILED,
    GREY,
    INK,
    PAGE,
    letters,
    mode_colour,
    mode_marker,
    mode_name,
    new_figure,
    panel,
    site_colour,
    site_hatch,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

METHOD_LINES = ("-", (0, (4, 2)), (0, (1, 1.5)))
RING: dict[str, Any] = {
    "linestyle": "none",
    "marker": "o",
    "markersize": 10,
    "markerfacecolor": "none",
    "markeredgecolor": FAILED,
    "markeredgewidth": 1.2,
}
METHOD_TEXT = {"share": "share fit", "paper": "paper's fit"}


def draw_totals(findings: Findings) -> Figure:
    """Total capacity against beta, a panel a mode, a line a method; failed plans are crossed out, and those
    that fail only in closed loop are ringed."""
    modes, methods = findings.modes, findings.methods
    figure = new_figure(PAGE, 2.75)
    panels = figure.subplots(1, len(modes), sharey=True, squeeze=False)[0]
    for axes, mode, letter in zip(panels, modes, letters(), strict=False):
        axes.axhline(
            findings.no_vrt_mw, color=GREY, linewidth=1.0, linestyle=(0, (6, 2)), label="without ride-through"
        )
        for k, method in enumerate(methods):
            rows = findings.rows(mode, method)
            beta, total = [row["beta"] for row in rows], [row["total_mw"] for row in rows]
            axes.plot(
                beta,
                total,
                color=mode_colour(mode, modes),
                linestyle=METHOD_LINES[k % len(METHOD_LINES)],
                marker=mode_marker(mode, modes),
                markerfacecolor=mode_colour(mode, modes) if k == 0 else "white",
                label=METHOD_TEXT.get(method, method),
                zorder=3 + k,
            )
            cross_failed(axes, rows, [row["total_mw"] for row in rows])
            turned = [row for row in rows if _turned(findings, row)]
            axes.plot([row["beta"] for row in turned], [row["total_mw"] for row in turned], **RING, zorder=8)
        axes.set_xlabel("converter rating over capacity, β")
        panel(axes, letter, mode_name(mode))
    panels[0].set_ylabel("hosted capacity (MW)")
    panels[0].set_ylim(
        -0.02 * findings.no_vrt_mw,
        1.12 * max([findings.no_vrt_mw] + [row["total_mw"] for row in findings.rows()]),
    )
    _legend(
        figure,
        panels[0],
        any(verdict(row) == "failed" for row in findings.rows()),
        any(_turned(findings, row) for row in findings.rows()),
    )
    return figure


def _turned(findings: Findings, row: Row) -> bool:
    """Whether a plan passed the replay and does not ride through in closed loop."""
    return verdict(row) == "passed" and findings.rides_in_closed_loop(row) is False


def draw_allocation(findings: Findings) -> Figure:
    """Capacity of each site against beta, stacked; one panel a mode and method."""
    modes, methods, sites = findings.modes, findings.methods, findings.sites
    figure = new_figure(PAGE, 0.5 + 2.0 * len(methods))
    panels = figure.subplots(len(methods), len(modes), sharex=True, sharey=True, squeeze=False)
    name = letters()
    for line, method in zip(panels, methods, strict=True):
        for axes, mode in zip(line, modes, strict=True):
            _stack(axes, findings, mode, method)
            panel(axes, next(name), f"{mode_name(mode)}, {METHOD_TEXT.get(method, method)}")
        line[0].set_ylabel("hosted capacity (MW)")
    for axes in panels[-1]:
        axes.set_xlabel("converter rating over capacity, β")
    panels[0, 0].set_ylim(0, 1.15 * max([findings.no_vrt_mw] + [row["total_mw"] for row in findings.rows()]))
    handles = [_patch(site_colour(site, sites), site_hatch(site, sites), f"bus {site}") for site in sites]
    extra = panels[0, 0].get_legend_handles_labels()[0]
    figure.legend(
        handles=handles + extra, loc="outside lower center", ncols=min(6, len(handles) + len(extra))
    )
    return figure


def cross_failed(axes: Axes, rows: list[Row], heights: list[float]) -> None:
    """Cross out the points of rows that failed the replay."""
    failed = [k for k, row in enumerate(rows) if verdict(row) == "failed"]
    if not failed:
        return
    axes.plot(
        [rows[k]["beta"] for k in failed],
        [heights[k] for k in failed],
        linestyle="none",
        marker="x",
        markersize=8,
        markeredgewidth=1.7,
        color=FAILED,
        zorder=9,
    )


def _stack(axes: Axes, findings: Findings, mode: str, method: str) -> None:
    rows, sites = findings.rows(mode, method), findings.sites
    beta = [float(row["beta"]) for row in rows]
    width = 0.72 * min([b - a for a, b in itertools.pairwise(beta)] or [0.05])
    floor = [0.0] * len(rows)
    for k, site in enumerate(sites):
        heights = [by_site(row, sites)[k] for row in rows]
        axes.bar(
            beta,
            heights,
            width,
            bottom=floor,
            color=site_colour(site, sites),
            hatch=site_hatch(site, sites),
            edgecolor="white",
            linewidth=0.4,
        )
        floor = [low + high for low, high in zip(floor, heights, strict=True)]
    axes.axhline(
        findings.no_vrt_mw, color=GREY, linewidth=1.0, linestyle=(0, (6, 2)), label="without ride-through"
    )
    cross_failed(axes, rows, [top + 0.03 * findings.no_vrt_mw for top in floor])
    if any(verdict(row) == "failed" for row in findings.rows()):
        axes.plot(
            [],
            [],
            linestyle="none",
            marker="x",
            markersize=7,
            markeredgewidth=1.7,
            color=FAILED,
            label="failed the replay",
        )
    axes.grid(axis="x", visible=False)


def _patch(colour: str, hatch: str, label: str) -> object:
    from matplotlib.patches import Patch

    return Patch(facecolor=colour, hatch=hatch, edgecolor="white", label=label)


def _legend(figure: Figure, axes: Axes, failed: bool, turned: bool) -> None:
    """One legend for all panels: lines in ink, since the panel already tells the mode."""
    from matplotlib.lines import Line2D

    handles = []
    lines: list[Any] = list(axes.get_legend_handles_labels()[0])
    for handle in lines:
        label = str(handle.get_label())
        plain = label == "without ride-through"
        colour = GREY if plain else INK
        handles.append(
            Line2D(
                [],
                [],
                color=colour,
                linestyle=handle.get_linestyle(),
                linewidth=handle.get_linewidth(),
                marker="" if plain else handle.get_marker(),
                label=label,
                markerfacecolor=INK if handle.get_markerfacecolor() != "white" else "white",
            )
        )
    if failed:
        handles.append(
            Line2D(
                [],
                [],
                linestyle="none",
                marker="x",
                markersize=7,
                markeredgewidth=1.7,
                color=FAILED,
                label="failed the replay",
            )
        )
    if turned:
        handles.append(Line2D([], [], **RING, label="fails in closed loop"))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))
