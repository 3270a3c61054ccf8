"""Stabiliser with one input and two lead-lags."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from dcvrt.errors import InputError
from dcvrt.models.automaton import Go, outside, within
from dcvrt.models.block import Equations, Input, Output, Parameter, State
from dcvrt.models.machines.parts import (
    LIMIT_FLAGS,
    LIMITED,
    UnitBlock,
    clip_rows,
    lead_lag,
    limited,
    magnitude,
)
from dcvrt.models.phasor import Phasor

ILLUSTRATIVE = "illustrative"
SIGNALS = "0: none, 1: speed, 2: bus frequency, 3: electrical power, 4: accelerating power, 5: voltage"
FREQUENCY = 2.0
WINDOW = (
    "the voltage answers to the signal through the lags of exciter and field, so that a finite time passes "
    "between two crossings"
)


def signal_of(s: Any, kind: float) -> Any:
    """Input of a stabiliser, by its number."""
    choices = {
        0.0: lambda: 0.0,
        1.0: lambda: s.omega - 1,
        2.0: lambda: s.f - 1,
        3.0: lambda: s.t_e / s.share,
        4.0: lambda: s.t_m - s.p_set,
        5.0: lambda: magnitude(s.v),
    }
    return choices[kind]()


def refuse_signal(kind: float, name: str, where: str) -> None:
    """Refuse a number that is not one of an input."""
    if kind not in (0.0, 1.0, 2.0, 3.0, 4.0, 5.0):
        what = "the derivative of the voltage, which has none at a fault" if kind == 6 else "not an input"
        raise InputError(f"{where}: {name} = {kind:g} is {what}. Choose among {SIGNALS}.")


class Ieeest(UnitBlock):
    r"""Power-system stabiliser with one input, IEEEST.

    .. math::
        y_1 = \frac{1}{1 + A_1 s + A_2 s^2}\, u, \qquad
        y_2 = \frac{1 + A_5 s + A_6 s^2}{1 + A_3 s + A_4 s^2}\, y_1

    .. math::
        y_4 = K_S\, \frac{1 + T_1 s}{1 + T_2 s}\, \frac{1 + T_3 s}{1 + T_4 s}\, y_2, \qquad
        y_5 = \frac{T_5 s}{1 + T_6 s}\, y_4, \qquad V_s = \operatorname{sat}_{[L_{min}, L_{max}]} y_5

    | input | u |
    |---|---|
    | 0 | 0 |
    | 1 | omega - 1 |
    | 2 | f - 1, f the frequency of the terminal |
    | 3 | T_e on the rating of the machine |
    | 4 | T_m less its value at the start |
    | 5 | the terminal voltage |

    | mode | V_s |
    |---|---|
    | FREE | y_5 |
    | UPPER | L_max while y_5 is above |
    | LOWER | L_min while y_5 is below |

    A lead-lag with T_2 = 0, or T_4 = 0, passes its input, and the second filter with A_4 = 0 as well,
    whatever its other constants, as in ANDES. With T_5 = 0 the washout is a lag. The limiter has no
    hysteresis and cannot chatter: its output is continuous.
    Equilibrium: V_s = 0, the washout has forgotten its input; with T_5 = 0, u = 0.
    Source: PSS/E's IEEEST as in ANDES. The derivative of the voltage as an input is left out.
    """

    modes: ClassVar[tuple[str, ...]] = LIMITED
    start = "FREE"
    flags: ClassVar[Mapping[str, tuple[float, ...]]] = LIMIT_FLAGS
    optional = ("A_1", "A_2", "A_4", "T_5")
    switches = ("signal",)
    ordered: ClassVar[tuple[tuple[str, str], ...]] = (("L_min", "L_max"),)

    signal = Parameter(1.0, "1", (0.0, 6.0), f"the input. {SIGNALS}", "default: the speed")
    share = Parameter(
        1.0, "1", (1e-6, 1e6), "rating of the machine over the common base", "1: the rating is the base"
    )
    A_1 = Parameter(0.0, "s", (0.0, 100.0), "first filter, denominator, s", ILLUSTRATIVE)
    A_2 = Parameter(0.0, "s2", (0.0, 100.0), "first filter, denominator, s^2", ILLUSTRATIVE)
    A_3 = Parameter(0.0, "s", (0.0, 100.0), "second filter, denominator, s", ILLUSTRATIVE)
    A_4 = Parameter(0.0, "s2", (0.0, 100.0), "second filter, denominator, s^2", ILLUSTRATIVE)
    A_5 = Parameter(0.0, "s", (-100.0, 100.0), "second filter, numerator, s", ILLUSTRATIVE)
    A_6 = Parameter(0.0, "s2", (-100.0, 100.0), "second filter, numerator, s^2", ILLUSTRATIVE)
    T_1 = Parameter(0.2, "s", (-100.0, 100.0), "first lead", ILLUSTRATIVE)
    T_2 = Parameter(0.02, "s", (0.0, 100.0), "first lag", ILLUSTRATIVE)
    T_3 = Parameter(0.2, "s", (-100.0, 100.0), "second lead", ILLUSTRATIVE)
    T_4 = Parameter(0.02, "s", (0.0, 100.0), "second lag", ILLUSTRATIVE)
    T_5 = Parameter(5.0, "s", (0.0, 100.0), "washout, numerator", ILLUSTRATIVE)
    T_6 = Parameter(5.0, "s", (0.0, 100.0), "washout, denominator", ILLUSTRATIVE)
    K_S = Parameter(10.0, "pu(V)", (-1e4, 1e4), "gain, per unit of the input", ILLUSTRATIVE)
    L_min = Parameter(-0.1, "pu(V)", (-1e3, 1e3), "lowest output", ILLUSTRATIVE)
    L_max = Parameter(0.1, "pu(V)", (-1e3, 1e3), "highest output", ILLUSTRATIVE)

    omega = Input("1", "speed over the nominal one")
    f = Input("1", "frequency of the terminal over the nominal one")
    t_e = Input("pu(S)", "electrical torque")
    t_m = Input("pu(S)", "mechanical torque")
    p_set = Input("pu(S)", "mechanical torque at the start")
    v = Input("pu(V)", "terminal voltage, network frame", kind=Phasor)
    v_s = Output("pu(V)", "signal for the exciter")

    r_1 = State(0.0, "1", "first filter: derivative of the output, s times its unit")
    y_1 = State(0.0, "1", "first filter: output")
    r_2 = State(0.0, "1", "second filter: derivative of the inner output, s times its unit")
    y_2 = State(0.0, "1", "second filter: inner output")
    x_1 = State(0.0, "1", "state of the first lead-lag", time="T_2")
    x_2 = State(0.0, "1", "state of the second lead-lag", time="T_4")
    x_3 = State(0.0, "pu(V)", "state of the washout", time="T_6")

    def __init__(self, **values: float) -> None:
        super().__init__(**values)
        refuse_signal(self.values["signal"], "signal", type(self).__name__)
        if self.is_off("T_6") and not self.is_off("T_5"):
            raise InputError(
                f"{type(self).__name__}: T_6 = 0 with T_5 = {self.values['T_5']:g} s makes the washout a "
                "pure derivative. Give T_6 a value above 0 s, or set T_5 = 0 as well."
            )

    @property
    def needs_frequency(self) -> bool:
        """Whether it reads the frequency of the terminal."""
        return self.values["signal"] == FREQUENCY

    def lagless(self) -> tuple[str, ...]:
        gone: tuple[str, ...] = ("r_1",) if self.is_off("A_2") else ()
        gone += ("y_1",) if self.is_off("A_2") and self.is_off("A_1") else ()
        gone += ("r_2", "y_2") if self.is_off("A_4") else ()
        return (*gone, *super().lagless())

    def _signals(self, s: Any) -> tuple[dict[str, Any], Any]:
        """Right sides, and the output before its limits."""
        u = signal_of(s, self.values["signal"])
        y = u if "y_1" in self.lagless() else s.y_1
        if not self.is_off("A_2"):
            der = dict(r_1=(u - s.y_1 - s.A_1 * s.r_1) / s.A_2, y_1=s.r_1)
        else:
            der = dict(r_1=-s.r_1, y_1=u - s.y_1 if self.is_off("A_1") else (u - s.y_1) / s.A_1)
        if self.is_off("A_4"):
            der |= dict(r_2=-s.r_2, y_2=-s.y_2)
        else:
            bend = (y - s.y_2 - s.A_3 * s.r_2) / s.A_4
            der |= dict(r_2=bend, y_2=s.r_2)
            y = s.y_2 + s.A_5 * s.r_2 + s.A_6 * bend
        der["x_1"] = y - s.x_1
        y = lead_lag(y, s.x_1, s.T_1, s.T_2, self.is_off("T_2"))
        der["x_2"] = y - s.x_2
        y = s.K_S * lead_lag(y, s.x_2, s.T_3, s.T_4, self.is_off("T_4"))
        der["x_3"] = y - s.x_3
        return der, s.x_3 if self.is_off("T_5") else s.T_5 / s.T_6 * (y - s.x_3)

    def equations(self, s: Any) -> Equations:
        der, y = self._signals(s)
        return Equations(der=der, out=dict(v_s=limited(s, y, s.L_min, s.L_max)))

    def transitions(self, s: Any) -> tuple[Go, ...]:
        _, y = self._signals(s)
        return clip_rows(y, s.L_min, s.L_max)

    def rest(self, s: Any) -> dict[str, Any]:
        u = signal_of(s, self.values["signal"])
        return dict(r_1=0.0, y_1=u, r_2=0.0, y_2=s.y_1, x_1=s.y_1, x_2=s.y_1, x_3=s.K_S * s.y_1)


class IeeestWithWindow(Ieeest):
    r"""IEEEST that is cut out while the terminal voltage is outside a window.

    .. math::
        V_s = 0 \quad\text{unless}\quad V_{CL} < |v| < V_{CU}

    | mode | V_s |
    |---|---|
    | FREE, UPPER, LOWER | as IEEEST |
    | OUT | 0 while the voltage is outside |

    All else is as in IEEEST, whose states go on while the output is cut out. The window has no hysteresis
    either: the voltage answers to the output through the lags of exciter and field, so that a finite time
    passes between two crossings.
    Valid as IEEEST. Equilibrium: as IEEEST, with the voltage in the window.
    Source: PSS/E's IEEEST as in ANDES, where limits of 0 stand for no window.
    """

    modes = (*LIMITED, "OUT")
    start = "FREE"
    flags = {name: (*column, 0) for name, column in LIMIT_FLAGS.items()}  # noqa: RUF012
    ordered = (*Ieeest.ordered, ("V_CL", "V_CU"))

    V_CL = Parameter(0.5, "pu(V)", (-1e3, 1e3), "cut out below", ILLUSTRATIVE)
    V_CU = Parameter(1.5, "pu(V)", (-1e3, 1e3), "cut out above", ILLUSTRATIVE)

    def transitions(self, s: Any) -> tuple[Go, ...]:
        size = magnitude(s.v)
        out = outside(size, s.V_CL, s.V_CU)
        return (
            *(Go(mode, "OUT", out, settles=WINDOW) for mode in LIMITED),
            Go("OUT", "FREE", within(size, s.V_CL, s.V_CU), settles=WINDOW),
            *super().transitions(s),
        )
