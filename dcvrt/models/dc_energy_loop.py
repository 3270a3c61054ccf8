"""Outer loop of both modes: import what keeps the DC link charged."""

from __future__ import annotations

from typing import Any

from dcvrt.models import smooth
from dcvrt.models.block import Block, Equations, Input, Output, Parameter, State
from dcvrt.models.phasor import Phasor


class DcEnergyLoop(Block):
    r"""PI control of the DC energy that commands the import, held within what the converter can import.

    .. math::
        e = 1 - w, \qquad
        P^u = P^{ref} + H (K_p e + K_i \xi), \qquad
        P^c = \operatorname{sat}_{[0,\, \kappa \beta H |V|]}(P^u), \qquad Q^c = P^c \tan\varphi

    .. math::
        \dot\xi = h\, e \quad\text{unless the limit is reached and } e \text{ pushes further into it}

    P_ref is the power drawn from the link. :math:`\kappa` is the supervisor's share of the current limit, h
    is 1 in NORMAL. While the battery feeds the mismatch forward the integral holds: the battery makes up
    whatever is missing, so that an integral would not find the import but drift.
    Paper: eqs. (ups_dc_error), (ups_p_command), (ups_q_command).
    Equilibrium: w = 1, xi = 0, P_c = P_ref.
    Differs: P_min = 0 and P_max = I_max |V|, which the paper leaves open: the facility never commands an
    export, nor more than the current limit lets through.
    Differs: the conditional anti-windup, words in the paper, is a smooth gate; outside NORMAL the
    integral holds.
    Differs: the reactive reference is the load's power factor on the active command, in a sag too; reactive
    current yields to active current in the limiter, and the grid-following mode gives no voltage support.
    """

    H = Parameter(1.0, "pu(S)", (1e-6, 1e3), "hosted capacity", "decision of the planner")
    beta = Parameter(1.15, "1", (0.5, 3.0), "converter rating over hosted capacity", "illustrative")
    pf = Parameter(0.98, "1", (0.8, 1.0), "power factor of the import, lagging", "illustrative")
    K_p = Parameter(
        4.0,
        "1",
        (0.01, 100.0),
        "proportional gain over H",
        "illustrative: half the bandwidth of the current loop",
    )
    K_i = Parameter(20.0, "1/s", (0.0, 1000.0), "integral gain over H", "illustrative")
    eps = Parameter(
        1e-3, "1", (1e-6, 0.1), "smoothing width of limits and gate, over H", "own choice: numerics"
    )
    eps_v = Parameter(1e-3, "pu(V)", (1e-6, 0.1), "rounding of |V| at 0", "own choice: numerics")

    w = Input("1", "DC energy over its nominal value")
    p_ref = Input("pu(S)", "power drawn from the DC link")
    v = Input("pu(V)", "POI voltage", kind=Phasor)
    share = Input("1", "share of the current limit that the supervisor grants")
    steady = Input("1", "1: the integral acts")
    p_c = Output("pu(S)", "active-power command")
    q_c = Output("pu(S)", "reactive-power command")

    xi = State(0.0, "s", "integral of the energy error")

    def equations(self, s: Any) -> Equations:
        e = 1 - s.w
        ask = s.p_ref + s.H * (s.K_p * e + s.K_i * s.xi)
        p_max = s.share * s.beta * s.H * smooth.mag(s.v, s.eps_v)
        p_c = smooth.sat(ask, 0.0, p_max, s.eps * s.H)
        into_high = smooth.step(e, s.eps) * smooth.step(ask - p_max, s.eps * s.H)
        into_low = smooth.step(-e, s.eps) * smooth.step(-ask, s.eps * s.H)
        return Equations(
            der=dict(xi=s.steady * e * (1 - into_high) * (1 - into_low)),
            out=dict(p_c=p_c, q_c=p_c * smooth.root(1 / s.pf**2 - 1, 1e-6)),
        )
