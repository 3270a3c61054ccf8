"""Cooling as fans, pumps and chillers, each with its own lag."""

from __future__ import annotations

from typing import Any

from dcvrt.models.block import Block, Equations, Input, Output, Parameter, State


class SplitCooling(Block):
    r"""Cooling power of fans, pumps and chillers that follow the servers at different speeds.

    .. math::
        T_k\, \dot g_k = 1 + \rho_k\,(g_{IT} - 1) - g_k, \qquad
        P^{cool} = \varphi_{cool}\, d\, H \frac{\sum_k a_k g_k}{\sum_k a_k}, \qquad
        k \in \{fan, pump, chiller\}

    The parts a_k are divided by their sum, so that the total at rest is that of the plain cooling, which this
    block replaces: ``f.replace("cooling", SplitCooling())``. With equal T_k and rho_k it is that cooling.
    Equilibrium: g_k = 1 + rho_k (g_IT - 1). After a step each part goes its own exponential.
    Differs: the paper has one lag for all of the cooling.
    """

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
    a_fan = Parameter(0.25, "1", (0.0, 1.0), "part of the fans", "illustrative")
    a_pump = Parameter(0.15, "1", (0.0, 1.0), "part of the pumps", "illustrative")
    a_chiller = Parameter(0.60, "1", (1e-3, 1.0), "part of the chillers", "illustrative")
    T_fan = Parameter(2.0, "s", (0.05, 600.0), "time constant of the fans", "illustrative")
    T_pump = Parameter(10.0, "s", (0.05, 600.0), "time constant of the pumps", "illustrative")
    T_chiller = Parameter(60.0, "s", (0.1, 7200.0), "time constant of the chillers", "illustrative: 30-60 s")
    rho_fan = Parameter(1.0, "1", (0.0, 3.0), "how far the fans follow the servers", "illustrative")
    rho_pump = Parameter(0.5, "1", (0.0, 3.0), "how far the pumps follow the servers", "illustrative")
    rho_chiller = Parameter(0.5, "1", (0.0, 3.0), "how far the chillers follow the servers", "illustrative")

    g_it = Input("1", "normalised IT load")
    p = Output("pu(S)", "cooling power")

    g_fan = State(1.0, "1", "multiplier of the fans")
    g_pump = State(1.0, "1", "multiplier of the pumps")
    g_chiller = State(1.0, "1", "multiplier of the chillers")

    def equations(self, s: Any) -> Equations:
        goal = self.rest(s)
        mean = (s.a_fan * s.g_fan + s.a_pump * s.g_pump + s.a_chiller * s.g_chiller) / (
            s.a_fan + s.a_pump + s.a_chiller
        )
        return Equations(
            der=dict(
                g_fan=(goal["g_fan"] - s.g_fan) / s.T_fan,
                g_pump=(goal["g_pump"] - s.g_pump) / s.T_pump,
                g_chiller=(goal["g_chiller"] - s.g_chiller) / s.T_chiller,
            ),
            out=dict(p=s.share * s.d * s.H * mean),
        )

    def rest(self, s: Any) -> dict[str, Any]:
        step = s.g_it - 1
        return dict(
            g_fan=1 + s.rho_fan * step, g_pump=1 + s.rho_pump * step, g_chiller=1 + s.rho_chiller * step
        )
