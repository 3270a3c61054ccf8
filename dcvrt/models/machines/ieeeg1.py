"""Governor with a rate-limited valve and a steam turbine of four stages."""

from __future__ import annotations

from typing import Any

from dcvrt.models.automaton import Go, above, below
from dcvrt.models.block import Equations, Input, Output, Parameter, State
from dcvrt.models.machines.parts import CLIPPED, RELEASE, UnitBlock, lead_lag

ANDES = "default of ANDES's IEEEG1"


class Ieeeg1(UnitBlock):
    r"""IEEE governor of type 1, IEEEG1, on one shaft.

    .. math::
        T_1 \dot x = 1 - \omega - x, \qquad
        r = \frac{1}{T_3} \Bigl(P_{ref} + K x + K \frac{T_2}{T_1} (1 - \omega - x) - g\Bigr)

    .. math::
        \dot g = \operatorname{sat}_{[U_c, U_o]} r, \qquad P_{min} \le g \le P_{max}

    .. math::
        T_4 \dot y_4 = g - y_4, \quad T_5 \dot y_5 = y_4 - y_5, \quad T_6 \dot y_6 = y_5 - y_6, \quad
        T_7 \dot y_7 = y_6 - y_7

    .. math::
        T_m = K_1 y_4 + K_3 y_5 + K_5 y_6 + K_7 y_7

    | mode | valve |
    |---|---|
    | FREE | moves as it is told to |
    | OPENING | as fast as it can |
    | CLOSING | as fast as it can |
    | FULL | rests on P_max while it is told to open |
    | SHUT | rests on P_min while it is told to close |

    A stage with a time constant of 0 passes its input; with T_1 = 0 the speed is taken as it is, times K.
    K_1 to K_7 are the shares of the stages that drive this shaft; they should add up to 1.
    Valid for steam units while the boiler holds its pressure.
    Equilibrium: omega = 1, g = P_ref, T_m = P_ref times the sum of the shares.
    Source: IEEE Committee report, Dynamic models for steam and hydro turbines (1973); ANDES's IEEEG1.
    """

    modes = ("FREE", "OPENING", "CLOSING", "FULL", "SHUT")
    start = "FREE"
    flags = {"free": (1, 0, 0, 0, 0), "opening": (0, 1, 0, 0, 0), "closing": (0, 0, 1, 0, 0)}  # noqa: RUF012
    ordered = (("U_c", "U_o"), ("P_min", "P_max"))

    p_ref = Parameter(0.0, "pu(S)", (-1e4, 1e4), "power set-point", "found by the initialisation")
    K = Parameter(20.0, "pu(S)", (0.0, 1e6), "gain: power on the common base over speed", ANDES)
    T_1 = Parameter(1.0, "s", (0.0, 100.0), "lag of the governor", ANDES)
    T_2 = Parameter(1.0, "s", (0.0, 100.0), "lead of the governor", ANDES)
    T_3 = Parameter(0.1, "s", (1e-3, 100.0), "time constant of the valve", ANDES)
    U_o = Parameter(0.1, "pu(S)/s", (0.0, 1e6), "fastest opening of the valve", ANDES)
    U_c = Parameter(-0.1, "pu(S)/s", (-1e6, 0.0), "fastest closing of the valve", ANDES)
    P_min = Parameter(0.0, "pu(S)", (-1e4, 1e4), "lowest position of the valve", ANDES)
    P_max = Parameter(5.0, "pu(S)", (-1e4, 1e4), "highest position of the valve", ANDES)
    T_4 = Parameter(0.4, "s", (0.0, 100.0), "inlet piping", ANDES)
    T_5 = Parameter(8.0, "s", (0.0, 100.0), "second pass of the boiler", ANDES)
    T_6 = Parameter(0.5, "s", (0.0, 100.0), "third pass of the boiler", ANDES)
    T_7 = Parameter(0.05, "s", (0.0, 100.0), "fourth pass of the boiler", ANDES)
    K_1 = Parameter(0.5, "1", (0.0, 1.0), "share of the first stage", ANDES)
    K_3 = Parameter(0.5, "1", (0.0, 1.0), "share of the second stage", ANDES)
    K_5 = Parameter(0.0, "1", (0.0, 1.0), "share of the third stage", ANDES)
    K_7 = Parameter(0.0, "1", (0.0, 1.0), "share of the fourth stage", ANDES)

    omega = Input("1", "speed over the nominal one")
    t_m = Output("pu(S)", "mechanical torque")
    p_set = Output("pu(S)", "the set-point")

    x = State(0.0, "1", "state of the governor", time="T_1")
    g = State(0.0, "pu(S)", "position of the valve")
    y_4 = State(0.0, "pu(S)", "output of the first stage", time="T_4")
    y_5 = State(0.0, "pu(S)", "output of the second stage", time="T_5")
    y_6 = State(0.0, "pu(S)", "output of the third stage", time="T_6")
    y_7 = State(0.0, "pu(S)", "output of the fourth stage", time="T_7")

    def _rate(self, s: Any) -> Any:
        """Rate that the valve is told to move at."""
        told = lead_lag(1 - s.omega, s.x, s.T_2, s.T_1, self.is_off("T_1"))
        return (s.p_ref + s.K * told - s.g) / s.T_3

    def equations(self, s: Any) -> Equations:
        rate = s.free * self._rate(s) + s.opening * s.U_o + s.closing * s.U_c
        t_m = s.K_1 * s.y_4 + s.K_3 * s.y_5 + s.K_5 * s.y_6 + s.K_7 * s.y_7
        return Equations(
            der=dict(
                x=1 - s.omega - s.x,
                g=rate,
                y_4=s.g - s.y_4,
                y_5=s.y_4 - s.y_5,
                y_6=s.y_5 - s.y_6,
                y_7=s.y_6 - s.y_7,
            ),
            out=dict(t_m=t_m, p_set=s.p_ref),
        )

    def transitions(self, s: Any) -> tuple[Go, ...]:
        rate = self._rate(s)
        full, shut = above(s.g, s.P_max) & above(rate, 0.0), below(s.g, s.P_min) & below(rate, 0.0)
        return (
            Go("FREE", "FULL", full, reset={"g": s.P_max}),
            Go("OPENING", "FULL", full, reset={"g": s.P_max}),
            Go("FREE", "SHUT", shut, reset={"g": s.P_min}),
            Go("CLOSING", "SHUT", shut, reset={"g": s.P_min}),
            Go("FREE", "OPENING", above(rate, s.U_o), settles=CLIPPED),
            Go("FREE", "CLOSING", below(rate, s.U_c), settles=CLIPPED),
            Go("OPENING", "FREE", below(rate, s.U_o), settles=CLIPPED),
            Go("CLOSING", "FREE", above(rate, s.U_c), settles=CLIPPED),
            Go("FULL", "FREE", below(rate, -RELEASE)),
            Go("SHUT", "FREE", above(rate, RELEASE)),
        )

    def rest(self, s: Any) -> dict[str, Any]:
        return dict(x=0.0, g=s.p_ref, y_4=s.g, y_5=s.y_4, y_6=s.y_5, y_7=s.y_6)
