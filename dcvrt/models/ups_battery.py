"""Battery of a UPS that stands beside the grid, and the lack of one."""

from __future__ import annotations

from typing import Any

import casadi as ca

from dcvrt.models import smooth
from dcvrt.models.block import Block, Equations, Input, Output, Parameter, State


class UpsBattery(Block):
    r"""Battery that covers what the loads draw and the grid does not give.

    .. math::
        P^b = P - P^g, \qquad \dot s = -\frac{P^b + P^{loss}}{T_E H}, \qquad
        P^{loss} = (1/\eta - 1) \frac{P^b + |P^b|}{2} + (1 - \eta) \frac{|P^b| - P^b}{2}

    .. math::
        P^{ask} = c \operatorname{sat}_{\pm P_{ch} H} K_c H (s^\star - s)

    Discharge positive, measured on the AC side of its converter; P_ask is the power it wants drawn for it
    while c (charge) is 1. Equilibrium: s = s*, P_b = 0.
    The inverter is a voltage source: its power is what the loads make it, its rating shows as voltage.
    Differs: not in the paper, whose battery stands on a DC link.
    Differs: losses are counted in PUE, hence eta = 1 unless set.
    """

    H = Parameter(1.0, "pu(S)", (1e-6, 1e3), "hosted capacity", "decision of the planner")
    T_E = Parameter(270.0, "s", (1.0, 1e5), "energy over H: time at full load", "illustrative: 4.5 minutes")
    soc_ref = Parameter(0.8, "1", (0.05, 0.99), "charge that is kept", "illustrative")
    P_ch = Parameter(0.1, "1", (0.0, 3.0), "charge limit over H", "illustrative")
    K_c = Parameter(5.0, "1", (0.0, 100.0), "recharge power over H per missing charge", "illustrative")
    eta = Parameter(1.0, "1", (0.5, 1.0), "efficiency in each direction", "PUE counts the losses")
    eps = Parameter(1e-3, "1", (1e-6, 0.1), "smoothing width over H", "own choice: numerics")

    p_load = Input("pu(S)", "power drawn by the loads")
    p_g = Input("pu(S)", "power from the grid")
    charge = Input("1", "1: bring the charge back")
    p = Output("pu(S)", "battery power, discharge positive")
    ask = Output("pu(S)", "power wanted for charging")
    energy = Output("pu(S) s", "energy of the battery")
    loss = Output("pu(S)", "power lost in battery and converter")

    soc = State(0.8, "1", "state of charge", bounds=(0.0, 1.0), crossing="battery charge left 0-100 %")

    def equations(self, s: Any) -> Equations:
        p, width = s.p_load - s.p_g, s.eps * s.H
        size = ca.sqrt(p * p + width * width) - width
        loss = (1 / s.eta - 1) * (size + p) / 2 + (1 - s.eta) * (size - p) / 2
        missing = s.K_c * s.H * (s.soc_ref - s.soc)
        return Equations(
            der=dict(soc=-(p + loss) / (s.T_E * s.H)),
            out=dict(
                p=p,
                ask=s.charge * smooth.sat(missing, -s.P_ch * s.H, s.P_ch * s.H, width),
                energy=s.T_E * s.H * s.soc,
                loss=loss,
            ),
        )

    def rest(self, s: Any) -> dict[str, Any]:
        return dict(soc=s.soc_ref)


class NoBattery(Block):
    """In the place of a battery: no power, no charge. For the outputs that every facility has."""

    p = Output("pu(S)", "battery power: none")
    soc = Output("1", "state of charge: none")

    def equations(self, s: Any) -> Equations:
        return Equations(out=dict(p=0.0, soc=0.0))
