"""What each fault leaves of the voltage at each site."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from dcvrt.planning.replay import fault_label
from dcvrt.studies.findings import Findings
from dcvrt.studies.style import GREY, INK, PAGE, new_figure, site_colour, site_marker

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure


def retained(margins: pd.DataFrame) -> pd.DataFrame:
    """Lowest POI voltage by fault and site: smallest, middle and largest over hosting vectors and periods."""
    once = margins.dropna(subset=["v_poi_min_pu"]).drop_duplicates(["hosting", "period", "fault", "site"])
    return once.groupby(["fault", "site"]).v_poi_min_pu.agg(["min", "median", "max"]).reset_index()


def rating_line(beta: float, loss_share: float) -> float:
    """Retained voltage at which a converter of rating beta sheds just the allowed share at full load, pu.

    From P = min(1, beta V): a constant-current bound that leaves out every dynamic of the facility.

    >>> round(rating_line(1.25, 0.10), 3)
    0.72
    """
    return (1.0 - loss_share) / beta


def draw(findings: Findings) -> Figure:
    """One line a fault, one marker a site; the bar spans hosting vectors and periods."""
    table, sites = retained(findings.margins), findings.sites
    present = set(table.fault)
    labels = [fault_label(fault.model_dump()) for fault in findings.faults]
    faults = [name for name in labels if name in present]
    figure = new_figure(PAGE, 0.95 + 0.36 * max(len(faults), 1))
    axes = figure.add_subplot()
    spread = np.linspace(0.27, -0.27, len(sites)) if len(sites) > 1 else np.zeros(1)
    for k, site in enumerate(sites):
        rows = table[table.site == site]
        y = np.array([faults.index(fault) for fault in rows.fault]) + spread[k]
        colour = site_colour(site, sites)
        axes.hlines(y, rows["min"], rows["max"], color=colour, linewidth=1.6, alpha=0.75)
        axes.plot(
            rows["median"],
            y,
            linestyle="none",
            marker=site_marker(site, sites),
            color=colour,
            markersize=4.2,
            label=f"bus {site}",
        )
    low, high = (float(table["min"].min()), float(table["max"].max())) if len(table) else (0.0, 1.0)
    axes.set_xlim(max(0.0, low - 0.04), high + 0.04)
    for beta in findings.study.facility.beta:
        voltage = rating_line(beta, findings.study.criteria.loss_share)
        if axes.get_xlim()[0] < voltage < axes.get_xlim()[1]:
            axes.axvline(voltage, color=GREY, linewidth=0.7, linestyle=(0, (3, 2)), zorder=1)
            axes.annotate(
                f"β {beta:g}",
                (voltage, 1.0),
                (0, 2),
                xycoords=("data", "axes fraction"),
                textcoords="offset points",
                ha="center",
                fontsize=6.2,
                color=INK,
                rotation=60,
            )
    axes.set_yticks(range(len(faults)), faults)
    axes.set_ylim(max(len(faults), 1) - 0.5, -0.5)
    axes.set_xlabel("lowest POI voltage during the fault (pu)")
    axes.set_ylabel("fault")
    axes.grid(axis="y", visible=False)
    axes.plot(
        [],
        [],
        color=GREY,
        linewidth=0.7,
        linestyle=(0, (3, 2)),
        label="static limit of the load loss for a rating β",
    )
    figure.legend(loc="outside lower center", ncols=min(6, len(sites) + 1))
    return figure
