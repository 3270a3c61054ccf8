"""Margins of the surrogates against margins of the simulation, on the samples kept out of the fit."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from dcvrt.planning.surrogate import false_passes
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

Floats = npt.NDArray[np.float64]

TARGETS = {"voltage": "sustained voltage", "loss": "load loss"}
UNITS = {
    ("voltage", "paper"): "pu",
    ("voltage", "share"): "pu",
    ("loss", "paper"): "MW",
    ("loss", "share"): "share of import",
}


def draw(findings: Findings) -> Figure:
    """True against predicted margin after tightening, a row a method, a column a target."""
    points = findings.predictions
    methods = [m for m in findings.methods if (points.method == m).any()]
    figure = new_figure(PAGE, 0.45 + 2.55 * max(len(methods), 1))
    panels = figure.subplots(max(len(methods), 1), len(TARGETS), squeeze=False)
    name = letters()
    for line, method in zip(panels, methods, strict=False):
        for axes, (target, words) in zip(line, TARGETS.items(), strict=True):
            chosen = points[(points.method == method) & (points.target == target)]
            margin, predicted = fitted_points(findings, method, target)
            _scatter(axes, chosen, findings.modes, margin, predicted)
            unit = UNITS.get((target, method), "pu")
            axes.set_xlabel(f"simulated margin ({unit})")
            axes.set_ylabel(f"predicted margin ({unit})")
            panel(axes, next(name), f"{words}, method '{method}'")
    handles = _handles(findings.modes)
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))
    return figure


def fitted_points(findings: Findings, method: str, target: str) -> tuple[Floats, Floats]:
    """Simulated and predicted margins of the fitting set, all sites, faults, modes, periods and ratings."""
    fits = findings.surrogates
    fits = fits[(fits.method == method) & (fits.target == target)]
    hostings = findings.hostings.set_index("name")
    runs = findings.margins[
        (findings.margins.ok == 1) & findings.margins.hosting.isin(hostings.index[hostings.subset == "fit"])
    ]
    keys = ["mode", "site", "fault"]
    for pooled in ("period", "beta"):
        if not fits[pooled].isin(["", 0.0]).all():
            keys.append(pooled)
    joined = runs.merge(fits[[*keys, "intercept", "slopes", "rating_slope"]], on=keys)
    if joined.empty:
        return np.zeros(0), np.zeros(0)
    sites = [str(site) for site in findings.sites]
    vector = {name: [by_site[site] for site in sites] for name, by_site in hostings.by_site.items()}
    H = np.array([vector[name] for name in joined.hosting])
    slopes = np.array([[slope[site] for site in sites] for slope in joined.slopes])
    d = joined.period.map({name: period["dc_factor"] for name, period in findings.periods.items()}).to_numpy(
        dtype=float
    )
    own = H[np.arange(len(H)), [sites.index(str(site)) for site in joined.site]]
    predicted = (
        joined.intercept.to_numpy()
        + d * (slopes * H).sum(axis=1)
        + joined.rating_slope.to_numpy() * joined.beta.to_numpy() * own
    )
    column = (
        "v_margin_pu"
        if target == "voltage"
        else "loss_margin_mw"
        if method == "paper"
        else "loss_margin_share"
    )
    return joined[column].to_numpy(dtype=float), np.asarray(predicted, dtype=float)


def _scatter(
    axes: Axes, points: pd.DataFrame, modes: list[str], fit_margin: Floats, fit_predicted: Floats
) -> None:
    axes.plot(
        fit_margin,
        fit_predicted,
        linestyle="none",
        marker="o",
        markersize=2.0,
        markeredgewidth=0,
        color="#bdbdbd",
        rasterized=len(fit_margin) > 1500,
        zorder=1.5,
    )
    without = points[points.margin.isna()]
    points = points[points.margin.notna()]
    false = false_passes(points.predicted, points.margin)
    for mode in modes:
        own = points[points["mode"] == mode]
        axes.plot(
            own.margin,
            own.predicted,
            linestyle="none",
            marker=mode_marker(mode, modes),
            markersize=2.6,
            alpha=0.55,
            markeredgewidth=0,
            color=mode_colour(mode, modes),
            rasterized=len(own) > 1500,
        )
    axes.plot(
        points.margin[false],
        points.predicted[false],
        linestyle="none",
        marker="o",
        markersize=7.5,
        markerfacecolor="none",
        markeredgecolor=FAILED,
        markeredgewidth=1.3,
        zorder=6,
    )
    every = np.concatenate([points.margin, points.predicted, fit_margin, fit_predicted, [0.0]])
    low, high = float(every.min()), float(every.max())
    room = 0.05 * (high - low or 1.0)
    limits = (low - room, high + room)
    axes.set(xlim=limits, ylim=limits)
    axes.locator_params(nbins=5)
    axes.set_box_aspect(0.72)
    axes.plot(limits, limits, color=GREY, linewidth=0.8, zorder=1)
    axes.axhline(0, color=GREY, linewidth=0.6, linestyle=(0, (3, 2)), zorder=1)
    axes.axvline(0, color=GREY, linewidth=0.6, linestyle=(0, (3, 2)), zorder=1)
    axes.fill_between([limits[0], 0], 0, limits[1], color="#f8dcd6", alpha=0.6, linewidth=0, zorder=0)
    unseen = int(false_passes(without.predicted, without.margin).sum())
    count = int(false.sum()) + unseen
    total, share = len(points) + len(without), int((points.margin < 0).sum()) + len(without)
    hidden = (
        f"\n({len(without)} have no margin to show, {unseen} of them false passes)" if len(without) else ""
    )
    axes.text(
        0.03,
        0.97,
        f"validation: {count} false passes\namong {total} points, of which\n"
        f"{share} fail in simulation{hidden}",
        transform=axes.transAxes,
        va="top",
        linespacing=1.25,
        bbox=dict(facecolor="white", edgecolor="none", alpha=0.7, pad=1),
        fontsize=7,
        color=FAILED if count else "#222222",
    )


def _handles(modes: list[str]) -> list[object]:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    shown: list[object] = [
        Line2D(
            [],
            [],
            linestyle="none",
            marker=mode_marker(mode, modes),
            color=mode_colour(mode, modes),
            markersize=4,
            label=f"{mode_name(mode)}, validation",
        )
        for mode in modes
    ]
    shown.append(
        Line2D([], [], linestyle="none", marker="o", color="#bdbdbd", markersize=3.5, label="fitting set")
    )
    return [
        *shown,
        Line2D([], [], color=GREY, linewidth=0.8, label="exact"),
        Patch(facecolor="#f8dcd6", label="false-pass region"),
        Line2D(
            [],
            [],
            linestyle="none",
            marker="o",
            markersize=6.5,
            markerfacecolor="none",
            markeredgecolor=FAILED,
            label="false pass",
        ),
    ]
