"""Stabiliser with two inputs and three lead-lags."""

from __future__ import annotations

from typing import Any

from dcvrt.errors import InputError
from dcvrt.models.automaton import Go
from dcvrt.models.block import Equations, Input, Output, Parameter, State
from dcvrt.models.machines.ieeest import FREQUENCY, SIGNALS, refuse_signal, signal_of
from dcvrt.models.machines.parts import LIMIT_FLAGS, LIMITED, UnitBlock, clip_rows, lead_lag, limited
from dcvrt.models.phasor import Phasor

ILLUSTRATIVE = "illustrative"


class St2Cut(UnitBlock):
    r"""Power-system stabiliser with two inputs, ST2CUT.

    .. math::
        T_1 \dot y_1 = K_1 u_1 - y_1, \qquad T_2 \dot y_2 = K_2 u_2 - y_2

    .. math::
        y = \frac{T_3 s}{1 + T_4 s}\, \frac{1 + T_5 s}{1 + T_6 s}\, \frac{1 + T_7 s}{1 + T_8 s}\,
            \frac{1 + T_9 s}{1 + T_{10} s}\, (y_1 + y_2), \qquad
        V_s = \operatorname{sat}_{[L_{min}, L_{max}]} y

    The inputs are numbered as those of IEEEST.

    | mode | V_s |
    |---|---|
    | FREE | y |
    | UPPER | L_max while y is above |
    | LOWER | L_min while y is below |

    A lead-lag whose lag is 0 passes its input, a transducer with T = 0 has no lag; with T_3 = 0 the washout
    is a lag. The limiter has no hysteresis and cannot chatter: its output is continuous.
    The window of the terminal voltage, which ANDES counts from the voltage at the start, is left out.
    Equilibrium: V_s = 0, the washout has forgotten its input; with T_3 = 0, K_1 u_1 + K_2 u_2 = 0.
    Source: PSS/E's ST2CUT as in ANDES.
    """

    modes = LIMITED
    start = "FREE"
    flags = LIMIT_FLAGS
    optional = ("T_3",)
    switches = ("signal_1", "signal_2")
    ordered = (("L_min", "L_max"),)

    signal_1 = Parameter(1.0, "1", (0.0, 6.0), f"first input. {SIGNALS}", "default: the speed")
    signal_2 = Parameter(0.0, "1", (0.0, 6.0), f"second input. {SIGNALS}", "default: none")
    share = Parameter(
        1.0, "1", (1e-6, 1e6), "rating of the machine over the common base", "1: the rating is the base"
    )
    K_1 = Parameter(1.0, "1", (-1e4, 1e4), "gain of the first transducer", ILLUSTRATIVE)
    K_2 = Parameter(1.0, "1", (-1e4, 1e4), "gain of the second transducer", ILLUSTRATIVE)
    T_1 = Parameter(0.02, "s", (0.0, 100.0), "lag of the first transducer", ILLUSTRATIVE)
    T_2 = Parameter(0.02, "s", (0.0, 100.0), "lag of the second transducer", ILLUSTRATIVE)
    T_3 = Parameter(3.0, "s", (0.0, 100.0), "washout, numerator", ILLUSTRATIVE)
    T_4 = Parameter(3.0, "s", (0.0, 100.0), "washout, denominator", ILLUSTRATIVE)
    T_5 = Parameter(0.15, "s", (-100.0, 100.0), "first lead", ILLUSTRATIVE)
    T_6 = Parameter(0.05, "s", (0.0, 100.0), "first lag", ILLUSTRATIVE)
    T_7 = Parameter(0.15, "s", (-100.0, 100.0), "second lead", ILLUSTRATIVE)
    T_8 = Parameter(0.05, "s", (0.0, 100.0), "second lag", ILLUSTRATIVE)
    T_9 = Parameter(0.15, "s", (-100.0, 100.0), "third lead", ILLUSTRATIVE)
    T_10 = Parameter(0.05, "s", (0.0, 100.0), "third lag", ILLUSTRATIVE)
    L_min = Parameter(-0.05, "pu(V)", (-1e3, 1e3), "lowest output", ILLUSTRATIVE)
    L_max = Parameter(0.05, "pu(V)", (-1e3, 1e3), "highest output", ILLUSTRATIVE)

    omega = Input("1", "speed over the nominal one")
    f = Input("1", "frequency of the terminal over the nominal one")
    t_e = Input("pu(S)", "electrical torque")
    t_m = Input("pu(S)", "mechanical torque")
    p_set = Input("pu(S)", "mechanical torque at the start")
    v = Input("pu(V)", "terminal voltage, network frame", kind=Phasor)
    v_s = Output("pu(V)", "signal for the exciter")

    y_1 = State(0.0, "pu(V)", "output of the first transducer", time="T_1")
    y_2 = State(0.0, "pu(V)", "output of the second transducer", time="T_2")
    x_0 = State(0.0, "pu(V)", "state of the washout", time="T_4")
    x_1 = State(0.0, "pu(V)", "state of the first lead-lag", time="T_6")
    x_2 = State(0.0, "pu(V)", "state of the second lead-lag", time="T_8")
    x_3 = State(0.0, "pu(V)", "state of the third lead-lag", time="T_10")

    def __init__(self, **values: float) -> None:
        super().__init__(**values)
        for name in self.switches:
            refuse_signal(self.values[name], name, type(self).__name__)
        if self.is_off("T_4") and not self.is_off("T_3"):
            raise InputError(
                f"{type(self).__name__}: T_4 = 0 with T_3 = {self.values['T_3']:g} s makes the washout a "
                "pure derivative. Give T_4 a value above 0 s, or set T_3 = 0 as well."
            )

    @property
    def needs_frequency(self) -> bool:
        """Whether it reads the frequency of the terminal."""
        return FREQUENCY in (self.values["signal_1"], self.values["signal_2"])

    def _signals(self, s: Any) -> tuple[dict[str, Any], Any]:
        """Right sides, and the output before its limits."""
        der = dict(
            y_1=s.K_1 * signal_of(s, self.values["signal_1"]) - s.y_1,
            y_2=s.K_2 * signal_of(s, self.values["signal_2"]) - s.y_2,
        )
        y = s.y_1 + s.y_2
        der["x_0"] = y - s.x_0
        y = s.x_0 if self.is_off("T_3") else s.T_3 / s.T_4 * (y - s.x_0)
        for x, lead, lag in (("x_1", "T_5", "T_6"), ("x_2", "T_7", "T_8"), ("x_3", "T_9", "T_10")):
            der[x] = y - getattr(s, x)
            y = lead_lag(y, getattr(s, x), getattr(s, lead), getattr(s, lag), self.is_off(lag))
        return der, y

    def equations(self, s: Any) -> Equations:
        der, y = self._signals(s)
        return Equations(der=der, out=dict(v_s=limited(s, y, s.L_min, s.L_max)))

    def transitions(self, s: Any) -> tuple[Go, ...]:
        _, y = self._signals(s)
        return clip_rows(y, s.L_min, s.L_max)

    def rest(self, s: Any) -> dict[str, Any]:
        one = s.K_1 * signal_of(s, self.values["signal_1"])
        two = s.K_2 * signal_of(s, self.values["signal_2"])
        return dict(y_1=one, y_2=two, x_0=one + two, x_1=0.0, x_2=0.0, x_3=0.0)
