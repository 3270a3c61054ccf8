"""Rotating exciter whose output follows the speed."""

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
    lag_value,
    lead_lag,
    magnitude,
    saturation,
)
from dcvrt.models.phasor import Phasor

ANDES = "default of ANDES's EXDC2"


class Exdc2(UnitBlock):
    r"""Excitation system with a direct-current exciter, EXDC2.

    .. math::
        T_R \dot v_m = |v| - v_m, \qquad u = V_{ref} + V_s - v_m - \frac{K_F}{T_F} (e_f - w), \qquad
        T_B \dot x = u - x

    .. math::
        T_A \dot v_r = K_A \Bigl(x + \frac{T_C}{T_B} (u - x)\Bigr) - v_r, \qquad
        V_{Rmin} \le v_r \le V_{Rmax}

    .. math::
        T_E \dot e_f = v_r - K_E e_f - S_B [e_f - S_A]_+^2, \qquad T_F \dot w = e_f - w, \qquad
        V_f = \omega e_f

    | mode | v_r |
    |---|---|
    | FREE | follows the lag |
    | UPPER | rests on the upper limit while more is asked for |
    | LOWER | rests on the lower limit while less is asked for |

    With T_R = 0 the voltage is taken as it is; with T_B = 0 the lead-lag passes its input; with T_A = 0 the
    regulator has no lag and is cut off at its limits.
    The saturation begins at e_f = S_A; ANDES looks at V_f for that, which is the same at nominal speed.
    Valid for direct-current exciters on the shaft of the machine.
    Equilibrium: omega = 1, v_m = |v|, w = V_f, v_r = K_E V_f + S_B [V_f - S_A]^2, x = v_r / K_A,
    V_ref = |v| + x.
    Source: PSS/E's EXDC2 as in ANDES; IEEE Std 421.5, type DC2A.
    """

    modes = LIMITED
    start = "FREE"
    flags = LIMIT_FLAGS
    optional = ("S_B",)
    ordered = (("V_Rmin", "V_Rmax"),)

    v_ref = Parameter(
        1.0, "pu(V)", (-100.0, 100.0), "voltage set-point, with the offset of the gain", "found by the "
        "initialisation"
    )  # fmt: skip
    T_R = Parameter(0.01, "s", (0.0, 10.0), "lag of the measurement", ANDES)
    T_C = Parameter(1.0, "s", (0.0, 100.0), "lead time constant", ANDES)
    T_B = Parameter(1.0, "s", (0.0, 100.0), "lag time constant", ANDES)
    K_A = Parameter(40.0, "1", (1e-3, 1e5), "gain of the regulator", ANDES)
    T_A = Parameter(0.04, "s", (0.0, 100.0), "lag of the regulator", ANDES)
    V_Rmin = Parameter(-7.3, "pu(V)", (-1e5, 1e5), "lowest output of the regulator", ANDES)
    V_Rmax = Parameter(7.3, "pu(V)", (-1e5, 1e5), "highest output of the regulator", ANDES)
    K_E = Parameter(1.0, "1", (-10.0, 100.0), "constant of the exciter, of its own field", ANDES)
    T_E = Parameter(0.8, "s", (1e-3, 100.0), "time constant of the exciter", ANDES)
    K_F = Parameter(0.03, "s", (0.0, 100.0), "gain of the rate feedback", ANDES)
    T_F = Parameter(1.0, "s", (1e-3, 100.0), "lag of the rate feedback", ANDES)
    S_A = Parameter(3.0, "pu(V)", (-1e3, 1e3), "field voltage at which saturation begins", "illustrative")
    S_B = Parameter(0.0, "1/pu(V)", (0.0, 1e4), "gain of the saturation; 0 for none", "none by default")

    v = Input("pu(V)", "terminal voltage, network frame", kind=Phasor)
    omega = Input("1", "speed over the nominal one")
    v_s = Input("pu(V)", "signal of the stabiliser")
    v_f = Output("pu(V)", "field voltage")

    v_m = State(1.0, "pu(V)", "measured voltage", time="T_R")
    x = State(0.0, "pu(V)", "state of the lead-lag", time="T_B")
    v_r = State(1.0, "pu(V)", "output of the regulator", time="T_A")
    e_f = State(1.0, "pu(V)", "voltage of the exciter at nominal speed", time="T_E")
    w = State(1.0, "pu(V)", "state of the rate feedback", time="T_F")

    def limits(self, s: Any) -> tuple[Any, Any]:
        """Limits of the regulator, lower one first."""
        return s.V_Rmin, s.V_Rmax

    def output_of_regulator(self, s: Any) -> Any:
        """What the regulator gives."""
        return s.v_r

    def field(self, s: Any) -> Any:
        """Field voltage of the machine."""
        return s.omega * s.e_f

    def _asked(self, s: Any) -> tuple[Any, Any]:
        """Input of the regulator, and the output that is asked of it."""
        u = s.v_ref + s.v_s - s.v_m - s.K_F / s.T_F * (s.e_f - s.w)
        return u, s.K_A * lead_lag(u, s.x, s.T_C, s.T_B, self.is_off("T_B"))

    def equations(self, s: Any) -> Equations:
        u, asked = self._asked(s)
        side = lag_side(s, s.v_r, asked, *self.limits(s), self.is_off("T_A"))
        loss = s.K_E * s.e_f
        if not self.is_off("S_B"):
            loss = loss + saturation(s.e_f, s.S_A, s.S_B)
        return Equations(
            der=dict(
                v_m=magnitude(s.v) - s.v_m,
                x=u - s.x,
                v_r=side,
                e_f=self.output_of_regulator(s) - loss,
                w=s.e_f - s.w,
            ),
            out=dict(v_f=self.field(s)),
        )

    def transitions(self, s: Any) -> tuple[Go, ...]:
        _, asked = self._asked(s)
        return lag_rows("v_r", s.v_r, asked, *self.limits(s), self.is_off("T_A"))

    def rest(self, s: Any) -> dict[str, Any]:
        return dict(v_m=magnitude(s.v), w=s.e_f, x=s.v_ref + s.v_s - magnitude(s.v))


class Ieeex1(Exdc2):
    r"""Excitation system of type 1 with a lead-lag, IEEEX1.

    .. math::
        T_R \dot v_m = |v| - v_m, \qquad u = V_{ref} + V_s - v_m - \frac{K_F}{T_F} (V_f - w), \qquad
        T_B \dot x = u - x

    .. math::
        T_A \dot v_r = K_A \Bigl(x + \frac{T_C}{T_B} (u - x)\Bigr) - v_r, \qquad
        V_{Rmin} \le v_r \le V_{Rmax}

    .. math::
        T_E \dot V_f = v_r - K_E V_f - S_B [V_f - S_A]_+^2, \qquad T_F \dot w = V_f - w

    Modes and time constants of 0 as in EXDC2, from which it differs in that V_f does not follow the speed.
    Valid for direct-current exciters whose regulator has a supply of its own.
    Equilibrium: v_m = |v|, w = V_f, v_r = K_E V_f + S_B [V_f - S_A]^2, x = v_r / K_A, V_ref = |v| + x.
    Source: PSS/E's IEEEX1, and ANDES's as it computes: it declares limits that move with the voltage, and
    runs with fixed ones. `Ieeex1BusFed` has those that move.
    """

    def field(self, s: Any) -> Any:
        return s.e_f


class Ieeex1BusFed(Ieeex1):
    r"""IEEEX1 whose limits are in proportion to the terminal voltage, which feeds its regulator.

    .. math::
        T_A \dot v_r = K_A \Bigl(x + \frac{T_C}{T_B} (u - x)\Bigr) - v_r, \qquad
        V_{Rmin} |v| \le v_r \le V_{Rmax} |v|

    | mode | output of the regulator |
    |---|---|
    | FREE | follows the lag |
    | UPPER | V_Rmax times the voltage, while more is asked for |
    | LOWER | V_Rmin times the voltage, while less is asked for |

    All else as in IEEEX1. On a limit the output moves with it, and the lag starts from where the limit is
    when it lets go; the state v_r means nothing meanwhile. A limit that rises at a stroke, as a fault is
    cleared, takes the output with it; a lag that had to catch up first would need a fraction of T_A, as long
    as what is asked for is far beyond the limit.
    Valid for direct-current exciters whose regulator is fed from the terminals.
    Equilibrium: as IEEEX1.
    Source: IEEE Std 421.5, the limits of type DC2A.
    """

    def limits(self, s: Any) -> tuple[Any, Any]:
        size = magnitude(s.v)
        return s.V_Rmin * size, s.V_Rmax * size

    def output_of_regulator(self, s: Any) -> Any:
        return lag_value(s, s.v_r, *self.limits(s), self.is_off("T_A"))
