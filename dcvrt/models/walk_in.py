"""Walk-in: a load is handed over to the grid little by little."""

from __future__ import annotations

from typing import Any

from dcvrt.models.automaton import Go, always
from dcvrt.models.block import Block, Equations, Input, Output, Parameter
from dcvrt.models.command import given, withdrawn


class WalkIn(Block):
    r"""Ramp from 0 to 1 while commanded; back to 0 at once when not.

    .. math::
        r = t_{mode}/T_{walk} \text{ in RAMP}, \qquad r = 0 \text{ in OFF}, \qquad r = 1 \text{ in FULL}

    The command is a flag of another automaton. Diesel generators ask for the ramp, and the grid gains from
    it: a load that comes back in one step is the next disturbance.
    """

    modes = ("OFF", "RAMP", "FULL")
    start = "OFF"
    flags = {"number": (0, 1, 2), "ramping": (0, 1, 0), "full": (0, 0, 1)}  # noqa: RUF012

    T_walk = Parameter(10.0, "s", (1e-3, 600.0), "time of the ramp", "Mitsubishi 9800A: 5 to 30 s")

    command = Input("1", "1: walk in")
    share = Output("1", "share that has been handed over")
    done = Output("1", "1 once all has been")
    mode = Output("1", "number of the mode, from 0")

    def transitions(self, s: Any) -> tuple[Go, ...]:
        stop = withdrawn(s.command)
        return (
            Go("OFF", "RAMP", given(s.command)),
            Go("RAMP", "OFF", stop),
            Go("RAMP", "FULL", always(), held=s.T_walk),
            Go("FULL", "OFF", stop),
        )

    def equations(self, s: Any) -> Equations:
        return Equations(out=dict(share=s.ramping * s.clock / s.T_walk + s.full, done=s.full, mode=s.number))
