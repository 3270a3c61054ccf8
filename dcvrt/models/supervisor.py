"""Four-region supervisor: when the facility leans on its battery, and when it comes back."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from dcvrt.models.automaton import Go, above, always, below, outside, within
from dcvrt.models.block import Block, Equations, Input, Output, Parameter
from dcvrt.models.command import given, withdrawn

ILLUSTRATIVE = "illustrative: the paper prints none"


class Supervisor(Block):
    """Decides how the UPS is fed.

    | mode | meaning |
    |---|---|
    | NORMAL | all power from the grid, battery idle or recharging |
    | MIXED | still coupled; the battery covers what the grid side cannot import |
    | BATTERY | uncoupled: the current limit is zero, the battery carries the load |
    | RETURN | coupled again: the current limit ramps up, the battery covers the rest |

    Paper: fig. (ups_modes).
    It acts on the measured voltage and on the DC energy. The outputs are numbers that the modes set; the ramp
    of RETURN is the time in the mode over T_ramp.
    Differs: thresholds and dwell times are not printed in the paper; ours are illustrative parameters.
    Differs: RETURN needs the control frame to be aligned with the voltage (|error| < e_sync), the
    resynchronisation that the paper names.
    """

    modes = ("NORMAL", "MIXED", "BATTERY", "RETURN")
    start = "NORMAL"
    flags = {  # noqa: RUF012
        "number":      (0, 1, 2, 3),
        "coupled":     (1, 1, 0, 0),
        "ramping":     (0, 0, 0, 1),
        "assisting":   (0, 1, 1, 1),
        "charging":    (1, 0, 0, 0),
        "steady":      (1, 0, 0, 0),
        "resyncing":   (0, 0, 1, 0),
    }  # fmt: skip

    V_dip = Parameter(0.90, "pu(V)", (0.3, 1.0), "leave NORMAL below", ILLUSTRATIVE)
    V_swell = Parameter(1.10, "pu(V)", (1.0, 1.5), "leave NORMAL above", ILLUSTRATIVE)
    V_back = Parameter(0.92, "pu(V)", (0.3, 1.05), "healthy above", ILLUSTRATIVE)
    V_calm = Parameter(1.08, "pu(V)", (0.95, 1.5), "healthy below", ILLUSTRATIVE)
    V_deep = Parameter(0.50, "pu(V)", (0.0, 0.9), "deep dip below", ILLUSTRATIVE)
    V_low = Parameter(0.85, "pu(V)", (0.0, 1.0), "give up RETURN below", ILLUSTRATIVE)
    V_high = Parameter(1.12, "pu(V)", (1.0, 1.5), "give up RETURN above", ILLUSTRATIVE)
    w_sag = Parameter(0.85, "1", (0.4, 1.0), "DC energy below which the battery assists", ILLUSTRATIVE)
    w_back = Parameter(0.95, "1", (0.4, 1.0), "DC energy above which it may stop", ILLUSTRATIVE)
    w_min = Parameter(0.60, "1", (0.36, 1.0), "DC energy below which the grid is given up", ILLUSTRATIVE)
    e_sync = Parameter(0.05, "pu(V)", (1e-3, 0.5), "largest voltage across the frame at return", ILLUSTRATIVE)
    T_deep = Parameter(0.02, "s", (0.0, 5.0), "deep dip tolerated", ILLUSTRATIVE)
    T_dip = Parameter(0.25, "s", (0.0, 60.0), "shallow dip or swell tolerated", ILLUSTRATIVE)
    T_mixed = Parameter(0.02, "s", (0.0, 5.0), "healthy time before MIXED ends", ILLUSTRATIVE)
    T_stable = Parameter(0.40, "s", (0.0, 600.0), "healthy time before return", ILLUSTRATIVE)
    T_ramp = Parameter(0.50, "s", (0.01, 600.0), "time to ramp up the current limit", ILLUSTRATIVE)

    v_f = Input("pu(V)", "measured POI voltage")
    w = Input("1", "DC energy over its nominal value")
    error = Input("pu(V)", "voltage across the control frame")
    share = Output("1", "share of the current limit")
    assist = Output("1", "battery feeds the power mismatch forward")
    charge = Output("1", "battery may recharge")
    trim = Output("1", "1 in NORMAL: integrals and slow trims may act")
    resync = Output("1", "1 while the control frame is aligned without load")
    mode = Output("1", "number of the mode, from 0")

    def transitions(self, s: Any) -> tuple[Go, ...]:
        dip, deep = outside(s.v_f, s.V_dip, s.V_swell), below(s.v_f, s.V_deep)
        healthy = within(s.v_f, s.V_back, s.V_calm)
        aligned = within(s.error, -s.e_sync, s.e_sync)
        return (
            Go("NORMAL", "MIXED", dip | below(s.w, s.w_sag)),
            Go("MIXED", "BATTERY", below(s.w, s.w_min)),
            Go("MIXED", "BATTERY", deep, held=s.T_deep),
            Go("MIXED", "BATTERY", dip, held=s.T_dip),
            Go("MIXED", "NORMAL", healthy & above(s.w, s.w_back), held=s.T_mixed),
            Go("BATTERY", "RETURN", healthy & aligned, held=s.T_stable),
            Go("RETURN", "BATTERY", outside(s.v_f, s.V_low, s.V_high)),
            Go("RETURN", "NORMAL", always(), held=s.T_ramp),
        )

    def equations(self, s: Any) -> Equations:
        return Equations(
            out=dict(
                share=s.coupled + s.ramping * s.clock / s.T_ramp,
                assist=s.assisting,
                charge=s.charging,
                trim=s.steady,
                resync=s.resyncing,
                mode=s.number,
            )
        )


class SupervisorWithLockout(Supervisor):
    """Supervisor that stays on battery while a lock, such as that of a sag counter, keeps the grid out.

    Modes, thresholds and outputs are those of the plain supervisor. While `lock` is 1 every coupled mode
    leaves for BATTERY at once, and BATTERY does not end; when it is 0 again, the healthy time T_stable starts
    to count and the return is as ever.
    Differs: no lock-out in the paper. Sites are told to have left the grid so after a series of dips.
    """

    lock = Input("1", "1 while the facility must stay on its battery, else 0")

    def transitions(self, s: Any) -> tuple[Go, ...]:
        leave = tuple(Go(mode, "BATTERY", given(s.lock)) for mode in ("NORMAL", "MIXED", "RETURN"))
        rows = (
            replace(row, when=row.when & withdrawn(s.lock)) if row.source == "BATTERY" else row
            for row in super().transitions(s)
        )
        return (*leave, *rows)
