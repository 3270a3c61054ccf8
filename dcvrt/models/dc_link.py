"""The DC link: the energy that decides whether the facility holds."""

from __future__ import annotations

from typing import Any

from dcvrt.models.block import Block, Equations, Input, Output, Parameter, State


class DcLink(Block):
    r"""Energy balance of the DC link, over its nominal energy.

    .. math::
        \dot E = P^g + P^b - P^{out}/\eta, \qquad E^\star = T_{hold} H, \qquad w = E/E^\star

    Import positive, battery discharge positive. Equilibrium: the powers balance.
    Valid while the converters have voltage to work with; w is the square of the link voltage in pu.
    The outputs `energy` (E) and `loss` are entries of the facility's energy ledger.
    Differs: the paper has no balance for its DC-link state; this is it.
    Differs: the state is w = E/E*, so that its bounds and tolerances do not depend on H.
    Differs: losses are counted in PUE, hence eta = 1 unless set; below 1 they are drawn on top of the demand.
    """

    H = Parameter(1.0, "pu(S)", (1e-6, 1e3), "hosted capacity", "decision of the planner")
    T_hold = Parameter(
        0.03, "s", (1e-3, 1.0), "nominal energy over H: hold-up time", "illustrative: 20-30 ms"
    )
    eta = Parameter(
        1.0, "1", (0.8, 1.0), "efficiency from the link to the protected bus", "PUE counts the losses"
    )

    p_g = Input("pu(S)", "power from the grid")
    p_b = Input("pu(S)", "power from the battery")
    p_out = Input("pu(S)", "power drawn from the protected bus")
    drain = Output("pu(S)", "power drawn from the link")
    energy = Output("pu(S) s", "energy of the link")
    loss = Output("pu(S)", "power lost between link and protected bus")

    w = State(
        1.0, "1", "energy over its nominal value", bounds=(0.36, 1.44),
        crossing="DC link voltage left 0.6-1.2 pu: link collapsed (below) or over-voltage (above)",
    )  # fmt: skip

    def equations(self, s: Any) -> Equations:
        drain = s.p_out / s.eta
        return Equations(
            der=dict(w=(s.p_g + s.p_b - drain) / (s.T_hold * s.H)),
            out=dict(drain=drain, energy=s.T_hold * s.H * s.w, loss=drain - s.p_out),
        )
