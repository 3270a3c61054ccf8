"""Steam turbine and governor with one lag and a lead-lag."""

from __future__ import annotations

from typing import Any

from dcvrt.models.automaton import Go
from dcvrt.models.block import Equations, Input, Output, Parameter, State
from dcvrt.models.machines.parts import (
    LIMIT_FLAGS,
    LIMITED,
    UnitBlock,
    lag_rows,
    lag_side,
    lead_lag,
)

ANDES = "default of ANDES's TGOV1"


class Tgov1(UnitBlock):
    r"""Droop, a valve with limits, and the reheat of a steam turbine, TGOV1.

    .. math::
        P_d = P_{ref} - \frac{\omega - 1}{R}, \qquad T_1 \dot g = P_d - g, \qquad V_{min} \le g \le V_{max}

    .. math::
        T_3 \dot x = g - x, \qquad T_m = x + \frac{T_2}{T_3} (g - x) - D_t (\omega - 1)

    | mode | valve g |
    |---|---|
    | FREE | follows the lag |
    | UPPER | rests on V_max while P_d > V_max |
    | LOWER | rests on V_min while P_d < V_min |

    With T_1 = 0 the valve is P_d, cut off at its limits; with T_3 = 0 the valve passes to the torque.
    P_ref is the set-point in power: PSS/E's reference over R.
    Valid for steam units while the boiler holds its pressure.
    Equilibrium: omega = 1, g = x = T_m = P_ref.
    Source: PSS/E's TGOV1 as in ANDES.
    """

    modes = LIMITED
    start = "FREE"
    flags = LIMIT_FLAGS
    ordered = (("V_min", "V_max"),)

    p_ref = Parameter(0.0, "pu(S)", (-1e4, 1e4), "power set-point", "found by the initialisation")
    R = Parameter(0.05, "1/pu(S)", (1e-7, 1e3), "droop: speed over power on the common base", ANDES)
    V_min = Parameter(0.0, "pu(S)", (-1e4, 1e4), "lowest position of the valve", ANDES)
    V_max = Parameter(1.2, "pu(S)", (-1e4, 1e4), "highest position of the valve", ANDES)
    T_1 = Parameter(0.1, "s", (0.0, 1e2), "lag of the valve", ANDES)
    T_2 = Parameter(0.2, "s", (0.0, 1e3), "lead time constant", ANDES)
    T_3 = Parameter(10.0, "s", (0.0, 1e3), "lag time constant, of the reheat", ANDES)
    D_t = Parameter(0.0, "pu(S)", (0.0, 1e4), "damping of the turbine: torque over speed", ANDES)

    omega = Input("1", "speed over the nominal one")
    t_m = Output("pu(S)", "mechanical torque")
    p_set = Output("pu(S)", "the set-point")

    g = State(0.0, "pu(S)", "position of the valve", time="T_1")
    x = State(0.0, "pu(S)", "state of the lead-lag", time="T_3")

    def equations(self, s: Any) -> Equations:
        asked = s.p_ref - (s.omega - 1) / s.R
        side = lag_side(s, s.g, asked, s.V_min, s.V_max, self.is_off("T_1"))
        t_m = lead_lag(s.g, s.x, s.T_2, s.T_3, self.is_off("T_3")) - s.D_t * (s.omega - 1)
        return Equations(der=dict(g=side, x=s.g - s.x), out=dict(t_m=t_m, p_set=s.p_ref))

    def transitions(self, s: Any) -> tuple[Go, ...]:
        asked = s.p_ref - (s.omega - 1) / s.R
        return lag_rows("g", s.g, asked, s.V_min, s.V_max, self.is_off("T_1"))

    def rest(self, s: Any) -> dict[str, Any]:
        return dict(g=s.p_ref, x=s.p_ref)
