"""Simplified excitation system."""

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
    magnitude,
)
from dcvrt.models.phasor import Phasor

ANDES = "default of ANDES's SEXS"


class Sexs(UnitBlock):
    r"""Transient gain reduction and a limited lag, SEXS.

    .. math::
        u = V_{ref} + V_s - |v|, \qquad T_B \dot x = u - x, \qquad w = x + \frac{T_A}{T_B} (u - x)

    .. math::
        T_E \dot V_f = K w - V_f, \qquad E_{min} \le V_f \le E_{max}

    | mode | V_f |
    |---|---|
    | FREE | follows the lag |
    | UPPER | rests on E_max while K w > E_max |
    | LOWER | rests on E_min while K w < E_min |

    With T_B = 0 the input passes, w = u; with T_E = 0 it is V_f = K w, cut off at the limits.
    Valid as a stand-in for any exciter of which little is known.
    Equilibrium: V_f = K (V_ref - |v|), x = V_ref - |v|.
    Source: PSS/E's SEXS as in ANDES; T_A there is given as the ratio T_A/T_B.
    """

    modes = LIMITED
    start = "FREE"
    flags = LIMIT_FLAGS
    ordered = (("E_min", "E_max"),)

    v_ref = Parameter(
        1.0, "pu(V)", (-100.0, 100.0), "voltage set-point, with the offset of the gain", "found by the "
        "initialisation"
    )  # fmt: skip
    K = Parameter(20.0, "1", (1e-3, 1e4), "gain", ANDES)
    T_A = Parameter(2.0, "s", (0.0, 1e3), "lead time constant", ANDES)
    T_B = Parameter(5.0, "s", (0.0, 1e3), "lag time constant", ANDES)
    T_E = Parameter(1.0, "s", (0.0, 1e2), "lag of the exciter", ANDES)
    E_min = Parameter(-99.0, "pu(V)", (-1e5, 1e5), "lowest field voltage", ANDES)
    E_max = Parameter(99.0, "pu(V)", (-1e5, 1e5), "highest field voltage", ANDES)

    v = Input("pu(V)", "terminal voltage, network frame", kind=Phasor)
    v_s = Input("pu(V)", "signal of the stabiliser")
    v_f = Output("pu(V)", "field voltage")

    x = State(0.0, "pu(V)", "state of the lead-lag", time="T_B")
    e_f = State(1.0, "pu(V)", "field voltage", time="T_E")

    def _asked(self, s: Any) -> tuple[Any, Any]:
        """Input, and the field voltage that is asked for."""
        u = s.v_ref + s.v_s - magnitude(s.v)
        return u, s.K * lead_lag(u, s.x, s.T_A, s.T_B, self.is_off("T_B"))

    def equations(self, s: Any) -> Equations:
        u, asked = self._asked(s)
        side = lag_side(s, s.e_f, asked, s.E_min, s.E_max, self.is_off("T_E"))
        return Equations(der=dict(x=u - s.x, e_f=side), out=dict(v_f=s.e_f))

    def transitions(self, s: Any) -> tuple[Go, ...]:
        _, asked = self._asked(s)
        return lag_rows("e_f", s.e_f, asked, s.E_min, s.E_max, self.is_off("T_E"))

    def rest(self, s: Any) -> dict[str, Any]:
        u = s.v_ref + s.v_s - magnitude(s.v)
        return dict(x=u, e_f=s.K * u)
