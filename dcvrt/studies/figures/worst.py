"""Waveforms of the worst replayed case of a mode: the grid's voltages, what the facility made of them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from dcvrt.planning.replay import fault_label
from dcvrt.studies.figures.ride import shade_modes
from dcvrt.studies.findings import Case, Findings
from dcvrt.studies.style import (
    GREY,
    INK,
    PAGE,
    PALETTE,
    letters,
    mode_band,
    mode_name,
    new_figure,
    panel,
    site_colour,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from dcvrt.trajectory import Trajectory

SITE_LINES = ("-", (0, (5, 1.5)), (0, (3, 1.2, 1, 1.2)), (0, (1, 1)))


def draw(findings: Findings, case: Case) -> Figure:
    """POI voltage at every site above; voltages, powers and DC energy of the worst facility below."""
    grid = {
        key["site"]: signals
        for key, signals in findings.waveforms(hosting=case.hosting, period=case.period, fault=case.fault)
    }
    run = findings.run(case)
    figure = new_figure(PAGE, 5.2 if run else 2.4)
    panels = figure.subplots(3 if run else 1, 1, sharex=True, squeeze=False)[:, 0]
    name = letters()
    volts = panels[0]
    for k, site in enumerate(findings.sites):
        if site in grid:
            wave = grid[site]
            volts.plot(
                wave["t_s"],
                np.hypot(wave["v_re_pu"], wave["v_im_pu"]),
                color=site_colour(site, findings.sites),
                linestyle=SITE_LINES[k % len(SITE_LINES)],
                label=f"bus {site}" + (" (worst)" if site == case.site else ""),
            )
    volts.set_ylabel("voltage (pu)")
    volts.set_ylim(bottom=0.0)
    panel(volts, next(name), f"POI voltage at each site, fault {case.fault}, period {case.period}")
    if run:
        _facility(findings, case, run, panels[1:], name)
    for axes in panels:
        axes.legend(loc="center left", bbox_to_anchor=(1.005, 0.5))
    panels[-1].set_xlabel("time (s)")
    start, end = _window(findings, case, grid, run)
    panels[-1].set_xlim(start, end)
    figure.align_ylabels()
    return figure


def _facility(findings: Findings, case: Case, run: Trajectory, panels: Any, name: Any) -> None:
    from matplotlib.patches import Patch

    inside, powers = panels
    t = run.t
    modes = findings.facility(case.mode).automaton_behind("mode").modes
    inside.plot(t, run["v_it"], color=PALETTE[0], label="protected IT voltage")
    inside.plot(t, run["w_dc"], color=PALETTE[4], linestyle=(0, (4, 1.5)), label="DC energy / nominal")
    inside.axhline(
        findings.study.criteria.v_it_min_pu,
        color=GREY,
        linewidth=0.9,
        linestyle=(0, (1, 1.5)),
        label="required of the IT voltage",
    )
    inside.set_ylabel("voltage, energy (pu)")
    panel(
        inside,
        next(name),
        f"{mode_name(case.mode)}, β = {case.beta:g}, at bus {case.site}: voltage and DC energy",
    )
    powers.plot(t, run["p_out"], color=PALETTE[2], linestyle=(0, (1, 1.2)), label="facility load")
    powers.plot(t, run["p_g"], color=INK, label="import at the POI")
    powers.plot(t, run["p_b"], color=PALETTE[1], label="battery")
    powers.plot(t, run["q_g"], color=PALETTE[3], linestyle=(0, (4, 1.5)), label="reactive import")
    floor = (1.0 - findings.study.criteria.loss_share) * float(run["p_g"][0])
    powers.axhline(floor, color=GREY, linewidth=0.9, linestyle=(0, (1, 1.5)), label="least import allowed")
    powers.set_ylabel("power (pu of H)")
    panel(powers, next(name), "powers")
    for axes in panels:
        shade_modes(axes, t, run["mode"], modes)
    visited = sorted(set(np.round(run["mode"]).astype(int).tolist()))
    handles = [
        Patch(facecolor=mode_band(modes[k], modes), edgecolor=GREY, linewidth=0.6, label=modes[k])
        for k in visited
    ]
    powers.figure.legend(
        handles=handles,
        loc="outside lower center",
        ncols=len(handles),
        title="supervisor mode",
        title_fontsize=7.5,
    )


def _window(
    findings: Findings, case: Case, grid: Mapping[int, Mapping[str, Any]], run: Trajectory | None
) -> tuple[float, float]:
    """Time from shortly before the fault to when the supervisor has settled, or the end of the record."""
    ends = [float(s["t_s"][-1]) for s in grid.values()]
    end = max(ends, default=1.0)
    fault = next((f for f in findings.faults if fault_label(f.model_dump()) == case.fault), None)
    if fault is None:
        return 0.0, end
    cleared = fault.t_start_s + 1e-3 * fault.t_clear_ms
    settled = cleared + 0.5
    if run:
        moving = np.flatnonzero(np.diff(np.round(run["mode"])))
        if len(moving):
            settled = max(settled, float(run.t[moving[-1] + 1]) + 0.2)
    return max(0.0, fault.t_start_s - 0.1), min(end, settled)
