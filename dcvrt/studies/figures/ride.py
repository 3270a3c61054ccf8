"""What a facility does inside while the voltage at its terminals varies."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from dcvrt.studies.style import GREY, INK, PAGE, PALETTE, letters, mode_band, new_figure, panel

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from dcvrt.trajectory import Trajectory

Signals = Mapping[str, Any]


def draw(signals: Signals, modes: Sequence[str], title: str, v_it_min: float | None = None) -> Figure:
    """Voltages, powers and reactive power of one run over time, with the supervisor's modes as shades.

    Parameters
    ----------
    signals : `t_s`, `v_poi` (magnitude), `v_it`, `p_g`, `p_b`, `p_it`, `p_cool`, `q_g`, `mode`; pu on H.
    modes : names of the supervisor's modes, by number.
    title : what was run; stands above the figure.
    v_it_min : required voltage of the protected bus, drawn as a line.
    """
    figure = new_figure(PAGE, 4.9)
    figure.suptitle(title, x=0.01, ha="left", fontsize=8.5)
    volts, powers, reactive = figure.subplots(
        3, 1, sharex=True, gridspec_kw={"height_ratios": [1.1, 1.2, 0.8]}
    )
    t = np.asarray(signals["t_s"], dtype=float)
    name = letters()

    volts.plot(t, signals["v_poi"], color=INK, linestyle=(0, (4, 1.5)), label="POI voltage, imposed")
    volts.plot(t, signals["v_it"], color=PALETTE[0], label="protected IT voltage")
    if v_it_min is not None:
        volts.axhline(
            v_it_min, color=GREY, linewidth=0.9, linestyle=(0, (1, 1.5)), label="required of the IT voltage"
        )
    volts.set_ylabel("voltage (pu)")
    volts.set_ylim(bottom=0.0)
    least = float(np.min(signals["v_it"]))
    panel(volts, next(name), f"voltages; the protected IT voltage is at least {round(least, 2) + 0.0:.2f} pu")

    for key, label, colour, line in (
        ("p_g", "import at the POI", INK, "-"),
        ("p_b", "battery", PALETTE[1], "-"),
        ("p_it", "IT demand", PALETTE[0], (0, (4, 1.5))),
        ("p_cool", "cooling demand", PALETTE[2], (0, (1, 1.2))),
    ):
        powers.plot(t, signals[key], color=colour, linestyle=line, label=label)
    powers.set_ylabel("active power (pu of H)")
    panel(powers, next(name), "active power")

    reactive.plot(t, signals["q_g"], color=PALETTE[3], label="UPS reactive import")
    reactive.set_ylabel("reactive power\n(pu of H)")
    reactive.set_xlabel("time (s)")
    panel(reactive, next(name), "reactive power")
    for axes in (volts, powers, reactive):
        shade_modes(axes, t, np.asarray(signals["mode"]), modes)
        axes.set_xlim(t[0], t[-1])
        axes.legend(loc="center left", bbox_to_anchor=(1.005, 0.5))
    _mode_key(figure, modes, np.asarray(signals["mode"]))
    figure.align_ylabels()
    return figure


def signals_of(run: Trajectory, v_poi: Any) -> dict[str, Any]:
    """Signals of a trajectory under the names that `draw` reads; `v_poi` is the imposed phasor."""
    outputs = {key: run[key] for key in ("v_it", "p_g", "p_b", "p_it", "p_cool", "q_g", "mode")}
    return {"t_s": run.t, "v_poi": np.abs(v_poi), **outputs}


def shade_modes(axes: Axes, t: Any, number: Any, modes: Sequence[str]) -> None:
    """Shade the spans of time that the supervisor spent in each mode."""
    held = np.round(np.asarray(number, dtype=float)).astype(int)
    edges = np.concatenate([[0], np.flatnonzero(np.diff(held)) + 1, [len(held)]])
    for a, b in itertools.pairwise(edges):
        end = t[b] if b < len(t) else t[-1]
        axes.axvspan(t[a], end, facecolor=mode_band(modes[held[a]], modes), edgecolor="none", zorder=0)


def _mode_key(figure: Figure, modes: Sequence[str], number: Any) -> None:
    from matplotlib.patches import Patch

    visited = set(np.round(np.asarray(number, dtype=float)).astype(int).tolist())
    handles = [
        Patch(facecolor=mode_band(mode, modes), edgecolor=GREY, linewidth=0.6, label=mode)
        for k, mode in enumerate(modes)
        if k in visited
    ]
    figure.legend(
        handles=handles,
        loc="outside lower center",
        ncols=len(handles),
        title="supervisor mode",
        title_fontsize=7.5,
    )
