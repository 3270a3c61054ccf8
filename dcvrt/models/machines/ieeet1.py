"""Rotating exciter with a regulator of type 1."""

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
    magnitude,
    saturation,
)
from dcvrt.models.phasor import Phasor

ANDES = "default of ANDES's IEEET1"


class Ieeet1(UnitBlock):
    r"""IEEE type 1 excitation system, IEEET1: regulator, exciter with saturation, rate feedback.

    .. math::
        T_R \dot v_m = |v| - v_m, \qquad u = V_{ref} + V_s - v_m - \frac{K_F}{T_F} (V_f - w)

    .. math::
        T_A \dot v_r = K_A u - v_r, \qquad V_{Rmin} \le v_r \le V_{Rmax}

    .. math::
        T_E \dot V_f = v_r - K_E V_f - S_B [V_f - S_A]_+^2, \qquad T_F \dot w = V_f - w

    | mode | v_r |
    |---|---|
    | FREE | follows the lag |
    | UPPER | rests on V_Rmax while K_A u > V_Rmax |
    | LOWER | rests on V_Rmin while K_A u < V_Rmin |

    With T_R = 0 the voltage is taken as it is; with T_A = 0 it is v_r = K_A u, cut off at the limits.
    The saturation is S_E V_f = S_B [V_f - S_A]^2 above S_A, S_A and S_B from two points by `quadratic`.
    Valid for direct-current exciters at speeds near 1.
    Equilibrium: v_m = |v|, w = V_f, v_r = K_E V_f + S_B [V_f - S_A]^2, V_ref = |v| + v_r / K_A.
    Source: IEEE Trans. PAS-87 (1968), Computer representation of excitation systems; ANDES's IEEET1.
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
    T_R = Parameter(0.02, "s", (0.0, 10.0), "lag of the measurement", ANDES)
    K_A = Parameter(5.0, "1", (1e-3, 1e5), "gain of the regulator", ANDES)
    T_A = Parameter(0.04, "s", (0.0, 100.0), "lag of the regulator", ANDES)
    V_Rmin = Parameter(-7.3, "pu(V)", (-1e5, 1e5), "lowest output of the regulator", ANDES)
    V_Rmax = Parameter(7.3, "pu(V)", (-1e5, 1e5), "highest output of the regulator", ANDES)
    K_E = Parameter(1.0, "1", (-10.0, 100.0), "constant of the exciter, of its own field", ANDES)
    T_E = Parameter(0.8, "s", (1e-3, 100.0), "time constant of the exciter", ANDES)
    K_F = Parameter(0.1, "s", (0.0, 100.0), "gain of the rate feedback", ANDES)
    T_F = Parameter(1.0, "s", (1e-3, 100.0), "lag of the rate feedback", ANDES)
    S_A = Parameter(3.0, "pu(V)", (-1e3, 1e3), "field voltage at which saturation begins", "illustrative")
    S_B = Parameter(0.0, "1/pu(V)", (0.0, 1e4), "gain of the saturation; 0 for none", "none by default")

    v = Input("pu(V)", "terminal voltage, network frame", kind=Phasor)
    v_s = Input("pu(V)", "signal of the stabiliser")
    v_f = Output("pu(V)", "field voltage")

    v_m = State(1.0, "pu(V)", "measured voltage", time="T_R")
    v_r = State(1.0, "pu(V)", "output of the regulator", time="T_A")
    e_f = State(1.0, "pu(V)", "field voltage", time="T_E")
    w = State(1.0, "pu(V)", "state of the rate feedback", time="T_F")

    def _asked(self, s: Any) -> Any:
        """Output that is asked of the regulator."""
        return s.K_A * (s.v_ref + s.v_s - s.v_m - s.K_F / s.T_F * (s.e_f - s.w))

    def equations(self, s: Any) -> Equations:
        side = lag_side(s, s.v_r, self._asked(s), s.V_Rmin, s.V_Rmax, self.is_off("T_A"))
        loss = s.K_E * s.e_f
        if not self.is_off("S_B"):
            loss = loss + saturation(s.e_f, s.S_A, s.S_B)
        return Equations(
            der=dict(v_m=magnitude(s.v) - s.v_m, v_r=side, e_f=s.v_r - loss, w=s.e_f - s.w),
            out=dict(v_f=s.e_f),
        )

    def transitions(self, s: Any) -> tuple[Go, ...]:
        return lag_rows("v_r", s.v_r, self._asked(s), s.V_Rmin, s.V_Rmax, self.is_off("T_A"))

    def rest(self, s: Any) -> dict[str, Any]:
        return dict(v_m=magnitude(s.v), w=s.e_f)
