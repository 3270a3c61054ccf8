"""Battery on the DC link."""

from __future__ import annotations

from typing import Any

from dcvrt.models import smooth
from dcvrt.models.block import Block, Equations, Input, Parameter, State


class Bess(Block):
    r"""Battery converter that supports the DC link, within power, energy and state of charge.

    .. math::
        P^\star = \operatorname{sat}_{[-P_{ch} H \chi_1,\; P_{dis} H \chi_0]}\!\left[
            a\,(P^{drain} - P^g) + K_b H\, \operatorname{dead}_{w_b}(1 - w) - c\, K_c H (s^\star - s) \right]

    .. math::
        T_b \dot P^b = P^\star - P^b, \qquad \dot s = -P^b / (T_E H)

    Discharge positive. Flags: a (assist), the mismatch between load and grid power is fed forward; c
    (charge), the battery is brought back to s*. :math:`\chi_0, \chi_1` fall from 1 to 0 over the last
    `fade` of charge.
    Equilibrium: w = 1, P_b = 0, s = s*.
    Differs: the paper tells in words that the battery acts on the DC voltage and on the power mismatch; the
    law, its deadband and its limits are ours. The deadband leaves small errors to the grid converter.
    """

    H = Parameter(1.0, "pu(S)", (1e-6, 1e3), "hosted capacity", "decision of the planner")
    T_b = Parameter(0.01, "s", (1e-3, 0.2), "lag of the battery converter", "illustrative: 2-12 ms")
    P_dis = Parameter(1.2, "1", (0.0, 3.0), "discharge limit over H", "illustrative: carries the whole load")
    P_ch = Parameter(0.1, "1", (0.0, 3.0), "charge limit over H", "illustrative")
    K_b = Parameter(8.0, "1", (0.0, 100.0), "support gain over H per DC energy error", "illustrative")
    w_b = Parameter(0.03, "1", (0.0, 0.3), "deadband of the DC energy error", "illustrative")
    T_E = Parameter(270.0, "s", (1.0, 1e5), "energy over H: time at full load", "illustrative: 4.5 minutes")
    soc_ref = Parameter(0.8, "1", (0.05, 0.95), "charge that is kept", "illustrative")
    soc_min = Parameter(0.1, "1", (0.0, 0.9), "charge at which discharge ends", "illustrative")
    soc_max = Parameter(0.95, "1", (0.1, 1.0), "charge at which charging ends", "illustrative")
    fade = Parameter(0.02, "1", (1e-3, 0.2), "charge over which the limits fade", "illustrative")
    K_c = Parameter(5.0, "1", (0.0, 100.0), "recharge power over H per missing charge", "illustrative")
    eps = Parameter(1e-3, "1", (1e-6, 0.1), "smoothing width over H", "own choice: numerics")

    w = Input("1", "DC energy over its nominal value")
    drain = Input("pu(S)", "power drawn from the DC link")
    p_g = Input("pu(S)", "power from the grid")
    assist = Input("1", "1: feed the mismatch forward")
    charge = Input("1", "1: bring the charge back")

    p = State(0.0, "pu(S)", "battery power, discharge positive")
    soc = State(0.8, "1", "state of charge", bounds=(0.0, 1.0), crossing="battery charge left 0-100 %")

    def equations(self, s: Any) -> Equations:
        support = s.K_b * s.H * smooth.dead(1 - s.w, s.w_b, s.eps)
        recharge = s.charge * s.K_c * s.H * (s.soc_ref - s.soc)
        can_discharge = smooth.sat((s.soc - s.soc_min) / s.fade, 0.0, 1.0, s.eps)
        can_charge = smooth.sat((s.soc_max - s.soc) / s.fade, 0.0, 1.0, s.eps)
        wanted = smooth.sat(
            s.assist * (s.drain - s.p_g) + support - recharge,
            -s.P_ch * s.H * can_charge,
            s.P_dis * s.H * can_discharge,
            s.eps * s.H,
        )
        return Equations(der=dict(p=(wanted - s.p) / s.T_b, soc=-s.p / (s.T_E * s.H)))

    def rest(self, s: Any) -> dict[str, Any]:
        return dict(p=0.0, soc=s.soc_ref)
