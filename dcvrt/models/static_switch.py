"""Static switch between grid and inverter."""

from __future__ import annotations

from typing import Any

from dcvrt.models.automaton import Go, always
from dcvrt.models.block import Block, Equations, Input, Output, Parameter
from dcvrt.models.command import given, withdrawn
from dcvrt.models.phasor import Phasor


class StaticSwitch(Block):
    r"""Feeds the bus from the grid or from the inverter, with a gap on the way to the inverter.

    .. math::
        V^{bus} = g V^{grid} + b V^{inv}

    | mode | g | b | meaning |
    |---|---|---|---|
    | GRID | 1 | 0 | thyristors conduct |
    | OPEN | 0 | 0 | they are being turned off: no voltage on the bus for T_transfer |
    | INVERTER | 0 | 1 | the inverter carries the bus |

    The command is a flag of another automaton: 1 away from the grid, 0 back to it. Back is without a gap, as
    of a switch that closes on a synchronised inverter; whoever commands must see to it that it is. A transfer
    that has begun is completed. The loads bridge the gap from what they store. Algebraic in every mode.
    Differs: not in the paper, whose UPS has no bypass.
    """

    modes = ("GRID", "OPEN", "INVERTER")
    start = "GRID"
    flags = {"number": (0, 1, 2), "closed": (1, 0, 0), "carrying": (0, 0, 1)}  # noqa: RUF012

    T_transfer = Parameter(
        2e-3,
        "s",
        (0.0, 0.1),
        "gap on the way to the inverter",
        "Eaton 9395: 2 ms; 91PS: less than 2 ms",
    )

    v_grid = Input("pu(V)", "voltage on the grid side, network frame", kind=Phasor)
    v_inverter = Input("pu(V)", "voltage of the inverter, network frame", kind=Phasor)
    transfer = Input("1", "1: away from the grid")
    v = Output("pu(V)", "voltage of the bus, network frame", kind=Phasor)
    on_grid = Output("1", "1 while the grid feeds the bus")
    on_inverter = Output("1", "1 while the inverter feeds the bus")
    mode = Output("1", "number of the mode, from 0")

    def transitions(self, s: Any) -> tuple[Go, ...]:
        return (
            Go("GRID", "OPEN", given(s.transfer)),
            Go("OPEN", "INVERTER", always(), held=s.T_transfer),
            Go("INVERTER", "GRID", withdrawn(s.transfer)),
        )

    def equations(self, s: Any) -> Equations:
        return Equations(
            out=dict(
                v=s.v_grid * s.closed + s.v_inverter * s.carrying,
                on_grid=s.closed,
                on_inverter=s.carrying,
                mode=s.number,
            )
        )
