"""What limits a facility at the instant that decides a margin: supervisor, converter rating, DC link or
battery."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from dcvrt.trajectory import Trajectory

AT_LIMIT = 0.99
"""Share of the current limit from which on the limiter counts as active."""
DISCHARGING = 0.01
"""Battery power, over the import before the fault, from which on it counts as supplying the load."""
SAME_VOLTAGE = 0.02
"""Distance of the protected voltage to a ceiling within which the ceiling counts as what holds it, pu."""


def mechanism(run: Trajectory, modes: Sequence[str], target: str, time: float, window: float) -> str:
    r"""What is active in the window that decides a margin.

    Parameters
    ----------
    run : run of the facility, with the outputs `mode`, `i_g`, `i_max`, `p_b`, `p_g`, `v_it`, `w_dc`.
    modes : names of the supervisor's modes, in the order of the output `mode`; empty for a variant without.
    target : 'loss' or 'voltage'.
    time, window : begin and length of the deciding window, s.

    Returns
    -------
    str
        The first that applies, for most of the window. `supervisor`: the facility is in BATTERY or RETURN;
        `DC link`, of the voltage: the output stage is at the most that it can modulate,
        :math:`m_{max} \sqrt{w}`; `limiter`: the current is at its limit; `BESS`: the battery supplies load
        that the grid could; `control`: none of these, so the loops themselves.
    """
    inside = (run.t >= time - 1e-9) & (run.t <= time + window + 1e-9)
    if not inside.any():
        inside = np.arange(len(run.t)) == int(abs(run.t - time).argmin())
    away = [bool(modes) and modes[round(float(k))] in ("BATTERY", "RETURN") for k in run["mode"][inside]]
    ceiling = run.parameters.get("bus.m_max", np.inf) * np.sqrt(np.maximum(run["w_dc"][inside], 0.0))
    active = {
        "supervisor": np.array(away),
        "DC link": (target == "voltage") & (run["v_it"][inside] >= ceiling - SAME_VOLTAGE),
        "limiter": run["i_g"][inside] >= AT_LIMIT * run["i_max"][inside],
        "BESS": run["p_b"][inside] > DISCHARGING * run["p_g"][0],
    }
    t = run.t[inside]
    span = np.gradient(t) if len(t) > 1 else np.ones(1)  # samples are closer where signals turn
    return next((name for name, when in active.items() if span[when].sum() > 0.5 * span.sum()), "control")
