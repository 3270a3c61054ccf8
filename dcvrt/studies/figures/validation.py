"""Margins of the surrogates against margins of the simulation, on the samples kept out of the fit."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from dcvrt.studies.findings import Findings
from dcvrt.studies.style import (
    FAILED,
    GREY,
    PAGE,
    letters,
    mode_colour,
    mode_marker,
    mode_name,
    new_figure,
    panel,
)

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TARGETS = {"voltage": "sustained voltage", "loss": "load loss"}
UNITS = {("voltage", "paper"): "pu", ("voltage", "share"): "pu", ("loss", "paper"): "MW", ("loss", "share"): "share of import"}


def draw(findings: Findings) -> Figure:
    """True against predicted margin after tightening: a row a method, a column a target; false passes are ringed."""
    points = findings.predictions
    methods = [m for m in findings.methods if (points.method == m).any()]
    figure = new_figure(PAGE, 0.45 + 2.6 * max(len(methods), 1))
    panels = figure.subplots(max(len(methods), 1), len(TARGETS), squeeze=False)
    name = letters()
    for line, method in zip(panels, methods, strict=False):
        for axes, (target, words) in zip(line, TARGETS.items(), strict=True):
            chosen = points[(points.method == method) & (points.target == target)]
            _scatter(axes, chosen, findings.modes)
            unit = UNITS.get((target, method), "pu")
            axes.set_xlabel(f"simulated margin ({unit})")
            axes.set_ylabel(f"predicted margin ({unit})")
            panel(axes, next(name), f"{words}, method '{method}'")
    handles = _handles(findings.modes)
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))
    return figure


def _scatter(axes: Axes, points: pd.DataFrame, modes: list[str]) -> None:
    false = (points.predicted >= 0) & (points.margin < 0)
    for mode in modes:
        own = points[points["mode"] == mode]
        axes.plot(own.margin, own.predicted, linestyle="none", marker=mode_marker(mode, modes), markersize=2.6, alpha=0.55,
                  markeredgewidth=0, color=mode_colour(mode, modes), rasterized=len(own) > 1500)
    axes.plot(points.margin[false], points.predicted[false], linestyle="none", marker="o", markersize=7.5, markerfacecolor="none",
              markeredgecolor=FAILED, markeredgewidth=1.3, zorder=6)
    if len(points):
        low = float(min(points.margin.min(), points.predicted.min()))
        high = float(max(points.margin.max(), points.predicted.max()))
    else:
        low, high = -1.0, 1.0
    low, high = min(low, 0.0), max(high, 0.0)
    room = 0.05 * (high - low or 1.0)
    limits = (low - room, high + room)
    axes.set(xlim=limits, ylim=limits)
    axes.set_box_aspect(1)
    axes.plot(limits, limits, color=GREY, linewidth=0.8, zorder=1)
    axes.axhline(0, color=GREY, linewidth=0.6, linestyle=(0, (3, 2)), zorder=1)
    axes.axvline(0, color=GREY, linewidth=0.6, linestyle=(0, (3, 2)), zorder=1)
    axes.fill_between([limits[0], 0], 0, limits[1], color="#f8dcd6", alpha=0.6, linewidth=0, zorder=0)
    count = int(np.sum(false))
    share = int((points.margin < 0).sum())
    axes.text(0.03, 0.97, f"false passes: {count} of {len(points)} points\n({share} of them truly fail)", transform=axes.transAxes,
              va="top", fontsize=7, color=FAILED if count else "#222222")


def _handles(modes: list[str]) -> list[object]:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    shown: list[object] = [Line2D([], [], linestyle="none", marker=mode_marker(mode, modes), color=mode_colour(mode, modes),
                                  markersize=4, label=mode_name(mode)) for mode in modes]
    return [*shown, Line2D([], [], color=GREY, linewidth=0.8, label="exact"),
            Patch(facecolor="#f8dcd6", label="passed by the fit, failed in simulation"),
            Line2D([], [], linestyle="none", marker="o", markersize=6.5, markerfacecolor="none", markeredgecolor=FAILED,
                   label="false pass")]
