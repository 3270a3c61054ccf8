"""Line-interactive UPS: its control, the voltage conditioner, the converter beside the line."""

from __future__ import annotations

from typing import Any

from dcvrt.models import smooth
from dcvrt.models.automaton import Go, below
from dcvrt.models.block import Block, Equations, Input, Output, Parameter, State
from dcvrt.models.command import given
from dcvrt.models.phasor import Phasor
from dcvrt.models.standby_control import StandbyControl

QUALIFY = "3, 10 or 30 s can be set at a Prolink PRO; the default of 3 s there"


class LineInteractiveControl(StandbyControl):
    """Decides whether the line or the battery carries the load.

    | mode | meaning |
    |---|---|
    | LINE | on the line, voltage conditioned, battery recharging |
    | BATTERY | switched off the line: inverter and battery carry the load |
    | SYNCHRONISE | line healthy again: the inverter turns onto it and the time of qualification runs |
    | RETURN | on the line; load is walked in from battery to line |
    | DOWN | battery empty: the load is dropped until the line is back |

    LINE is left as soon as the measured voltage is outside V_low to V_high. The line qualifies when it has
    been within V_back to V_calm, and the inverter within e_sync of it, for T_qualify without a break.
    Differs: not in the paper, whose UPS is coupled through a rectifier.
    """

    modes = ("LINE", "BATTERY", "SYNCHRONISE", "RETURN", "DOWN")
    start = "LINE"
    flags = {  # noqa: RUF012
        "number":     (0, 1, 2, 3, 4),
        "away":       (0, 1, 1, 0, 1),
        "handed":     (1, 0, 0, 0, 0),
        "handing":    (0, 0, 0, 1, 0),
        "charging":   (1, 0, 0, 0, 0),
        "following":  (1, 0, 1, 1, 1),
        "living":     (1, 1, 1, 1, 0),
    }  # fmt: skip

    T_qualify = Parameter(3.0, "s", (0.0, 3600.0), "healthy and synchronous time before return", QUALIFY)

    def transitions(self, s: Any) -> tuple[Go, ...]:
        unfit, healthy, empty = self.unfit(s), self.healthy(s), below(s.soc, s.soc_min)
        return (
            Go("LINE", "BATTERY", unfit),
            Go("BATTERY", "DOWN", empty),
            Go("BATTERY", "SYNCHRONISE", healthy),
            Go("SYNCHRONISE", "DOWN", empty),
            Go("SYNCHRONISE", "BATTERY", unfit),
            Go("SYNCHRONISE", "RETURN", healthy & self.synchronous(s), held=s.T_qualify),
            Go("RETURN", "BATTERY", unfit),
            Go("RETURN", "LINE", given(s.done)),
            Go("DOWN", "LINE", healthy, held=s.T_qualify),
        )

    def equations(self, s: Any) -> Equations:
        return Equations(out=self.says(s))


class LineConditioner(Block):
    r"""Ideal voltage conditioner in the line: buck and boost by a ratio that follows the voltage.

    .. math::
        V^{out} = a V, \qquad I = a I^{out}, \qquad
        T_a \dot a = \operatorname{sat}_{[1-k,\, 1+k]}(V_{set}/V_f) - a

    An autotransformer whose taps move, or a series converter in phase with the line that draws its power
    behind the switch (delta conversion); both keep the power. k = 0: a unit that only switches, such as the
    ABB PCS100 UPS-I. Equilibrium: V_out = V_set as far as k reaches.
    Differs: not in the paper. The taps of a real unit are steps; the ratio here is continuous and lags.
    """

    V_set = Parameter(1.0, "pu(V)", (0.9, 1.1), "voltage wanted", "nominal voltage")
    k = Parameter(0.12, "1", (0.0, 0.3), "reach of buck and boost", "illustrative: one tap of a small unit")
    T_a = Parameter(0.02, "s", (1e-3, 10.0), "lag of the ratio", "illustrative: about a cycle")
    eps = Parameter(1e-3, "1", (1e-6, 0.1), "smoothing width", "own choice: numerics")
    V_floor = Parameter(
        0.3, "pu(V)", (0.05, 0.8), "voltage below which the ratio asks for no more", "own choice: numerics"
    )

    v = Input("pu(V)", "line voltage, network frame", kind=Phasor)
    v_f = Input("pu(V)", "its measured magnitude")
    i_out = Input("pu(I)", "current behind the conditioner, network frame", kind=Phasor)
    v_out = Output("pu(V)", "voltage behind the conditioner, network frame", kind=Phasor)
    i = Output("pu(I)", "line current, network frame", kind=Phasor)

    a = State(1.0, "1", "ratio of the voltage behind to the voltage before")

    def target(self, s: Any) -> Any:
        """Ratio that would make the voltage behind V_set, within reach."""
        return smooth.sat(s.V_set / smooth.maximum(s.v_f, s.V_floor, s.eps), 1 - s.k, 1 + s.k, s.eps)

    def equations(self, s: Any) -> Equations:
        return Equations(
            der=dict(a=(self.target(s) - s.a) / s.T_a),
            out=dict(v_out=s.v * s.a, i=s.i_out * s.a),
        )

    def rest(self, s: Any) -> dict[str, Any]:
        return dict(a=self.target(s))


class ParallelConverter(Block):
    r"""Converter beside the line: leaves to the line its share of the load and adds the charging current.

    .. math::
        I^{line} = g \left( r I + \frac{P^{ask} V}{\max(|V|, V_z)^2} \right)

    g: the switch is closed; r: share of the load that the line carries; I: current of the loads. The rest,
    (1 - r) I, comes from the converter in phase with it. Algebraic.
    Differs: not in the paper.
    """

    V_z = Parameter(0.85, "pu(V)", (0.3, 1.0), "voltage below which charging fades", "illustrative")
    eps = Parameter(1e-3, "pu(V)2", (1e-6, 0.1), "smoothing width", "own choice: numerics")

    v = Input("pu(V)", "voltage of the bus, network frame", kind=Phasor)
    i = Input("pu(I)", "current of the loads, network frame", kind=Phasor)
    on_grid = Input("1", "1 while the switch is closed")
    share = Input("1", "share of the load that the line carries")
    ask = Input("pu(S)", "power wanted for charging")
    i_line = Output("pu(I)", "current through the switch, network frame", kind=Phasor)

    def equations(self, s: Any) -> Equations:
        charging = s.v * (s.ask / smooth.maximum(s.v.abs2(), s.V_z**2, s.eps))
        return Equations(out=dict(i_line=(s.i * s.share + charging) * s.on_grid))
