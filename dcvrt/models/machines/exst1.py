"""Static exciter with limits that fall with the field current."""

from __future__ import annotations

from typing import Any

from dcvrt.models.automaton import Go
from dcvrt.models.block import Equations, Input, Output, Parameter, State
from dcvrt.models.machines.parts import (
    PAIRS,
    Flags,
    UnitBlock,
    clip_rows,
    lead_lag,
    limited,
    magnitude,
    pair_flags,
    product,
)
from dcvrt.models.phasor import Phasor

ANDES = "default of ANDES's EXST1"


class Exst1(UnitBlock):
    r"""Static excitation system fed from the terminals, EXST1.

    .. math::
        T_R \dot v_m = |v| - v_m, \qquad
        u = \operatorname{sat}_{[V_{Imin}, V_{Imax}]}
            \Bigl(V_{ref} + V_s - v_m - \frac{K_F}{T_F} (v_r - w)\Bigr)

    .. math::
        T_B \dot x = u - x, \qquad
        T_A \dot v_r = K_A \Bigl(x + \frac{T_C}{T_B} (u - x)\Bigr) - v_r, \qquad T_F \dot w = v_r - w

    .. math::
        V_f = \operatorname{sat}_{[V_{Rmin} - K_C X_{ad} i_f,\; V_{Rmax} - K_C X_{ad} i_f]} v_r

    A mode is a pair: FREE, UPPER or LOWER for the input, and the same for the output, which follows its
    signal or is on a limit. Neither limiter has hysteresis; they cannot chatter, since what they give is
    continuous.
    Time constants of 0: the voltage is taken as it is (T_R), the lead-lag passes (T_B), no lag (T_A).
    Valid for rectifiers whose ceiling does not depend on the voltage.
    Equilibrium: v_m = |v|, v_r = w = V_f, x = V_f / K_A, V_ref = |v| + x.
    Source: PSS/E's EXST1 as in ANDES. ANDES decides by the signal of the rate feedback whether the output is
    on a limit; here the output itself is cut off, as the model is defined.
    """

    modes = PAIRS
    start = "FREE_FREE"
    flags = pair_flags("in_", "out_")
    ordered = (("V_Imin", "V_Imax"), ("V_Rmin", "V_Rmax"))

    v_ref = Parameter(
        1.0, "pu(V)", (-100.0, 100.0), "voltage set-point, with the offset of the gain", "found by the "
        "initialisation"
    )  # fmt: skip
    T_R = Parameter(0.01, "s", (0.0, 10.0), "lag of the measurement", ANDES)
    V_Imin = Parameter(-0.2, "pu(V)", (-1e5, 1e5), "lowest input", "illustrative")
    V_Imax = Parameter(0.2, "pu(V)", (-1e5, 1e5), "highest input", ANDES)
    T_C = Parameter(1.0, "s", (0.0, 100.0), "lead time constant", ANDES)
    T_B = Parameter(1.0, "s", (0.0, 100.0), "lag time constant", ANDES)
    K_A = Parameter(80.0, "1", (1e-3, 1e5), "gain of the regulator", ANDES)
    T_A = Parameter(0.05, "s", (0.0, 100.0), "lag of the regulator", ANDES)
    V_Rmin = Parameter(-3.0, "pu(V)", (-1e5, 1e5), "lowest field voltage without current", ANDES)
    V_Rmax = Parameter(8.0, "pu(V)", (-1e5, 1e5), "highest field voltage without current", ANDES)
    K_C = Parameter(0.2, "1", (0.0, 100.0), "loss of ceiling with the field current", ANDES)
    K_F = Parameter(0.1, "s", (0.0, 100.0), "gain of the rate feedback", ANDES)
    T_F = Parameter(1.0, "s", (1e-3, 100.0), "lag of the rate feedback", ANDES)

    v = Input("pu(V)", "terminal voltage, network frame", kind=Phasor)
    i_f = Input("pu(V)", "field current times X_ad")
    v_s = Input("pu(V)", "signal of the stabiliser")
    v_f = Output("pu(V)", "field voltage")

    v_m = State(1.0, "pu(V)", "measured voltage", time="T_R")
    x = State(0.0, "pu(V)", "state of the lead-lag", time="T_B")
    v_r = State(1.0, "pu(V)", "output of the regulator", time="T_A")
    w = State(1.0, "pu(V)", "state of the rate feedback", time="T_F")

    def _error(self, s: Any) -> Any:
        """Input before its limits."""
        return s.v_ref + s.v_s - s.v_m - s.K_F / s.T_F * (s.v_r - s.w)

    def _ceiling(self, s: Any) -> tuple[Any, Any]:
        """Limits of the field voltage, lower one first."""
        return s.V_Rmin - s.K_C * s.i_f, s.V_Rmax - s.K_C * s.i_f

    def equations(self, s: Any) -> Equations:
        u = limited(Flags(s, "in_"), self._error(s), s.V_Imin, s.V_Imax)
        asked = s.K_A * lead_lag(u, s.x, s.T_C, s.T_B, self.is_off("T_B"))
        return Equations(
            der=dict(v_m=magnitude(s.v) - s.v_m, x=u - s.x, v_r=asked - s.v_r, w=s.v_r - s.w),
            out=dict(v_f=limited(Flags(s, "out_"), s.v_r, *self._ceiling(s))),
        )

    def transitions(self, s: Any) -> tuple[Go, ...]:
        return product(clip_rows(self._error(s), s.V_Imin, s.V_Imax), clip_rows(s.v_r, *self._ceiling(s)))

    def rest(self, s: Any) -> dict[str, Any]:
        u = s.v_ref + s.v_s - magnitude(s.v)
        return dict(v_m=magnitude(s.v), x=u, v_r=s.K_A * u, w=s.K_A * u)
