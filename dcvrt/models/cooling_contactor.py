"""Cooling motors behind contactors: gone below a voltage, back in stages."""

from __future__ import annotations

from typing import Any

from dcvrt.models.automaton import Go, above, below
from dcvrt.models.block import Equations, Input, Output, Parameter
from dcvrt.models.cooling import Cooling


class ContactorCooling(Cooling):
    r"""Cooling whose contactors drop out in a sag; three equal groups of motors restart one after the other.

    .. math::
        P^{cool} = \frac{n}{3}\, \varphi_{cool}\, d\, H\, g, \qquad T\, \dot g = 1 + \rho\,(g_{IT} - 1) - g

    | mode | groups n |
    |---|---|
    | RUNNING | 3 |
    | OUT | 0 |
    | STAGE_1 | 1 |
    | STAGE_2 | 2 |

    It takes the place of the plain cooling and needs one more wire, the voltage that holds the contactors:
    ``f.replace("cooling", ContactorCooling()); f.connect(f.port("bus.v"), f.port("cooling.v"))``.
    A group draws what it did before from the moment it is closed. The voltage may be that of the protected
    bus or, for contactors whose coils hang on the grid, the measured one of the POI (``meter.v_f``). The
    demand of the facility counts what the motors draw, so it falls with them.
    Equilibrium: RUNNING, g = 1 + rho (g_IT - 1).
    Differs: the paper's cooling never drops out. Left out here: starting currents, the heat that
    gathers while the motors stand, and single contactors that drop out earlier than others.
    """

    modes = ("RUNNING", "OUT", "STAGE_1", "STAGE_2")
    start = "RUNNING"
    flags = {"number": (0, 1, 2, 3), "groups": (3, 0, 1, 2)}  # noqa: RUF012

    V_drop = Parameter(
        0.55, "pu(V)", (0.2, 0.9), "contactors open below", "illustrative: between half and 70 % of nominal"
    )
    T_drop = Parameter(
        0.02, "s", (0.0, 1.0), "time below V_drop until they open", "illustrative: about a cycle"
    )
    V_pick = Parameter(0.88, "pu(V)", (0.3, 1.0), "groups may close above", "illustrative")
    T_off = Parameter(5.0, "s", (0.0, 3600.0), "healthy time until the first group closes", "illustrative")
    T_stage = Parameter(2.0, "s", (0.0, 600.0), "healthy time until the next group closes", "illustrative")

    v = Input("pu(V)", "voltage that holds the contactors")
    demand = Output("pu(S)", "cooling power with every contactor closed")
    mode = Output("1", "number of the mode, from 0")

    def transitions(self, s: Any) -> tuple[Go, ...]:
        low, healthy = below(s.v, s.V_drop), above(s.v, s.V_pick)
        return (
            Go("RUNNING", "OUT", low, held=s.T_drop),
            Go("STAGE_1", "OUT", low, held=s.T_drop),
            Go("STAGE_2", "OUT", low, held=s.T_drop),
            Go("OUT", "STAGE_1", healthy, held=s.T_off),
            Go("STAGE_1", "STAGE_2", healthy, held=s.T_stage),
            Go("STAGE_2", "RUNNING", healthy, held=s.T_stage),
        )

    def equations(self, s: Any) -> Equations:
        plain = super().equations(s)
        demand = plain.out["p"]
        return Equations(der=plain.der, out=dict(p=s.groups / 3 * demand, demand=demand, mode=s.number))
