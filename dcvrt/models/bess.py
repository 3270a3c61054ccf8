"""Battery on the DC link."""

from __future__ import annotations

from typing import Any

import casadi as ca

from dcvrt.models import smooth
from dcvrt.models.block import Block, Equations, Input, Output, Parameter, State


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
    Equilibrium: w = 1, P_b = 0, s = s*. No losses here: :class:`BessWithLosses` has them.
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

    energy = Output("pu(S) s", "energy of the battery")
    loss = Output("pu(S)", "power lost in battery and converter")

    p = State(0.0, "pu(S)", "battery power, discharge positive")
    soc = State(0.8, "1", "state of charge", bounds=(0.0, 1.0), crossing="battery charge left 0-100 %")

    def wanted(self, s: Any) -> Any:
        """Power that the converter is asked for, within its limits."""
        support = s.K_b * s.H * smooth.dead(1 - s.w, s.w_b, s.eps)
        recharge = s.charge * s.K_c * s.H * (s.soc_ref - s.soc)
        can_discharge = smooth.sat((s.soc - s.soc_min) / s.fade, 0.0, 1.0, s.eps)
        can_charge = smooth.sat((s.soc_max - s.soc) / s.fade, 0.0, 1.0, s.eps)
        return smooth.sat(
            s.assist * (s.drain - s.p_g) + support - recharge,
            -s.P_ch * s.H * can_charge,
            s.P_dis * s.H * can_discharge,
            s.eps * s.H,
        )

    def equations(self, s: Any) -> Equations:
        return Equations(
            der=dict(p=(self.wanted(s) - s.p) / s.T_b, soc=-s.p / (s.T_E * s.H)),
            out=dict(energy=s.T_E * s.H * s.soc, loss=0.0),
        )

    def rest(self, s: Any) -> dict[str, Any]:
        return dict(p=0.0, soc=s.soc_ref)


class BessWithLosses(Bess):
    r"""Battery that loses energy in both directions and whose converter ramps at a limited rate.

    .. math::
        \dot P^b = \operatorname{sat}_{\pm R H}\frac{P^\star - P^b}{T_b}, \qquad
        \dot s = -\frac{P^b + P^{loss}}{T_E H}

    .. math::
        P^{loss} = \begin{cases}
            (1/\eta_{dis} - 1)\, P^b & P^b > 0\\
            (1 - \eta_{ch})\, |P^b| & P^b < 0
        \end{cases}

    The command P* is that of the block without losses, which this one replaces:
    ``f.replace("bess", BessWithLosses())``. P_b is the power at the DC link, so that a cycle returns the
    share eta_dis eta_ch of what it took. The loss is 0 at P_b = 0 and smooth there (width eps H).
    Equilibrium: w = 1, P_b = 0, s = s*. With both efficiencies 1 and a fast ramp: the block without losses.
    A ramp that needs longer to full load than the DC link holds up lets the link collapse in an interruption.
    """

    eta_dis = Parameter(0.96, "1", (0.5, 1.0), "efficiency of discharging", "illustrative")
    eta_ch = Parameter(0.96, "1", (0.5, 1.0), "efficiency of charging", "illustrative")
    R = Parameter(
        100.0, "1/s", (0.01, 1e4), "fastest change of power over H", "illustrative: 10 ms to full load"
    )

    def equations(self, s: Any) -> Equations:
        rate = smooth.sat((self.wanted(s) - s.p) / s.T_b, -s.R * s.H, s.R * s.H, s.eps * s.R * s.H)
        width = s.eps * s.H
        size = s.p * s.p / ca.sqrt(s.p * s.p + width * width)
        per_power = (1 / s.eta_dis - 1) * smooth.step(s.p, width) + (1 - s.eta_ch) * smooth.step(-s.p, width)
        loss = size * per_power
        return Equations(
            der=dict(p=rate, soc=-(s.p + loss) / (s.T_E * s.H)),
            out=dict(energy=s.T_E * s.H * s.soc, loss=loss),
        )
