"""Cooling: follows the heat of the servers, late."""

from __future__ import annotations

from typing import Any

from dcvrt.models.block import Block, Equations, Input, Output, Parameter, State


class Cooling(Block):
    r"""First-order response of the cooling power to the IT load.

    .. math::
        T\, \dot g = 1 + \rho\,(g_{IT} - 1) - g, \qquad P^{cool} = \varphi_{cool}\, d\, H\, g

    Paper: eqs. (cooling_response), (dc_dynamic_load). rho = 0: constant cooling.
    Equilibrium: g = 1 + rho (g_IT - 1). After a step of g_IT: 1 - exp(-t/T) of the way.
    """

    T = Parameter(30.0, "s", (0.1, 7200.0), "thermal time constant", "illustrative: 30-60 s")
    rho = Parameter(0.6, "1", (0.0, 1.5), "how far cooling follows the servers", "illustrative: 0.3-0.6")
    H = Parameter(1.0, "pu(S)", (1e-6, 1e3), "hosted capacity", "decision of the planner")
    d = Parameter(
        1.0, "1", (0.0, 1.2), "load factor: facility demand over hosted capacity at g = 1", "full load"
    )
    share = Parameter(
        0.17,
        "1",
        (0.0, 1.0),
        "share of the demand at g = 1",
        "PUE 1.3, three quarters of the rest: illustrative",
    )

    g_it = Input("1", "normalised IT load")
    p = Output("pu(S)", "cooling power")

    g = State(1.0, "1", "cooling multiplier")

    def equations(self, s: Any) -> Equations:
        return Equations(
            der=dict(g=(1 + s.rho * (s.g_it - 1) - s.g) / s.T),
            out=dict(p=s.share * s.d * s.H * s.g),
        )

    def rest(self, s: Any) -> dict[str, Any]:
        return dict(g=1 + s.rho * (s.g_it - 1))
