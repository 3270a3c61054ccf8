"""Static exciter with a compound source and an inner field regulator: three blocks and their diagram."""

from __future__ import annotations

from math import sqrt
from typing import Any

import casadi as ca

from dcvrt.errors import InputError, did_you_mean, raise_all
from dcvrt.models.automaton import Go, above, below
from dcvrt.models.block import Equations, Input, Output, Parameter, State
from dcvrt.models.diagram import Diagram
from dcvrt.models.machines.parts import (
    CLIPPED,
    LIMITED,
    PAIRS,
    Flags,
    UnitBlock,
    clip_rows,
    lag_rows,
    lag_side,
    lead_lag,
    limited,
    magnitude,
    pair_flags,
    product,
)
from dcvrt.models.phasor import Phasor

ANDES = "default of ANDES's ESST3A"


class Esst3aRegulator(UnitBlock):
    r"""Voltage regulator of ESST3A.

    .. math::
        T_R \dot v_m = |v| - v_m, \qquad
        u = \operatorname{sat}_{[V_{Imin}, V_{Imax}]} (V_{ref} + V_s - v_m)

    .. math::
        T_B \dot x = u - x, \qquad
        T_A \dot v_r = K_A \Bigl(x + \frac{T_C}{T_B} (u - x)\Bigr) - v_r, \qquad
        V_{Rmin} \le v_r \le V_{Rmax}

    A mode is a pair: of the input, and of the output v_r, each FREE or on a limit.
    Time constants of 0: the voltage is taken as it is (T_R), the lead-lag passes (T_B), no lag (T_A).
    Valid without limiters of over- and underexcitation.
    Equilibrium: v_m = |v|, x = v_r / K_A, V_ref = |v| + x.
    Source: IEEE Std 421.5, type ST3A; ANDES's ESST3A.
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
    V_Imin = Parameter(-0.1, "pu(V)", (-1e5, 1e5), "lowest input", ANDES)
    V_Imax = Parameter(0.8, "pu(V)", (-1e5, 1e5), "highest input", ANDES)
    T_C = Parameter(3.0, "s", (0.0, 100.0), "lead time constant", ANDES)
    T_B = Parameter(15.0, "s", (0.0, 100.0), "lag time constant", ANDES)
    K_A = Parameter(50.0, "1", (1e-3, 1e5), "gain", ANDES)
    T_A = Parameter(0.1, "s", (0.0, 100.0), "lag of the regulator", ANDES)
    V_Rmin = Parameter(0.0, "pu(V)", (-1e5, 1e5), "lowest output", ANDES)
    V_Rmax = Parameter(8.0, "pu(V)", (-1e5, 1e5), "highest output", ANDES)

    v = Input("pu(V)", "terminal voltage, network frame", kind=Phasor)
    v_s = Input("pu(V)", "signal of the stabiliser")
    v_a = Output("pu(V)", "output of the regulator")

    v_m = State(1.0, "pu(V)", "measured voltage", time="T_R")
    x = State(0.0, "pu(V)", "state of the lead-lag", time="T_B")
    v_r = State(1.0, "pu(V)", "output of the regulator", time="T_A")

    def _asked(self, s: Any) -> tuple[Any, Any]:
        """Limited input, and the output that is asked for."""
        u = limited(Flags(s, "in_"), s.v_ref + s.v_s - s.v_m, s.V_Imin, s.V_Imax)
        return u, s.K_A * lead_lag(u, s.x, s.T_C, s.T_B, self.is_off("T_B"))

    def equations(self, s: Any) -> Equations:
        u, asked = self._asked(s)
        side = lag_side(Flags(s, "out_"), s.v_r, asked, s.V_Rmin, s.V_Rmax, self.is_off("T_A"))
        return Equations(der=dict(v_m=magnitude(s.v) - s.v_m, x=u - s.x, v_r=side), out=dict(v_a=s.v_r))

    def transitions(self, s: Any) -> tuple[Go, ...]:
        _, asked = self._asked(s)
        return product(
            clip_rows(s.v_ref + s.v_s - s.v_m, s.V_Imin, s.V_Imax),
            lag_rows("v_r", s.v_r, asked, s.V_Rmin, s.V_Rmax, self.is_off("T_A")),
        )

    def rest(self, s: Any) -> dict[str, Any]:
        u = s.v_ref + s.v_s - magnitude(s.v)
        return dict(v_m=magnitude(s.v), x=u, v_r=s.K_A * u)


class CompoundSource(UnitBlock):
    r"""Source of ESST3A: a rectifier fed by the voltage and the current of the terminal.

    .. math::
        V_E = \bigl| \bar K_P v + j (K_I + \bar K_P X_L)\, i \bigr|, \qquad \bar K_P = K_P e^{j\theta_P},
        \qquad I_N = K_C \frac{X_{ad} i_f}{V_E}

    .. math::
        V_B = \min(V_E F(I_N), V_{Bmax})

    F falls from 1 with commutation: by 0.577 for every I_N up to 0.433, then as sqrt(0.75 - I_N^2) up to
    0.75, then by 1.732 for every I_N to 0. The printed pieces meet to four digits only; here they are
    continued where they end. With K_C = 0, F is 1. At I_N = 0 and 1 F has a corner.

    | mode | V_B |
    |---|---|
    | FREE | V_E F |
    | UPPER | V_Bmax while V_E F is above |

    Valid while neither voltage nor current vanish at once. Equilibrium: none of its own, it has no state.
    Source: IEEE Std 421.5, type ST3A and annex D; ANDES's ESST3A.
    """

    modes = ("FREE", "UPPER")
    start = "FREE"
    flags = {"free": (1, 0), "upper": (0, 1)}  # noqa: RUF012
    optional = ("K_C",)

    K_P = Parameter(4.0, "1", (0.0, 1e3), "gain of the voltage", ANDES)
    theta_P = Parameter(0.0, "rad", (-3.2, 3.2), "angle of the gain of the voltage", ANDES)
    K_I = Parameter(0.1, "pu(V)/pu(I)", (0.0, 1e3), "gain of the current", ANDES)
    X_L = Parameter(0.01, "pu(V)/pu(I)", (0.0, 1e3), "reactance of the source", ANDES)
    K_C = Parameter(0.1, "1", (0.0, 1e3), "commutating reactance of the rectifier", ANDES)
    V_Bmax = Parameter(18.0, "pu(V)", (0.0, 1e5), "highest voltage of the source", ANDES)

    v = Input("pu(V)", "terminal voltage, network frame", kind=Phasor)
    i = Input("pu(I)", "current into the network, network frame", kind=Phasor)
    i_f = Input("pu(V)", "field current times X_ad")
    v_b = Output("pu(V)", "voltage of the source")

    def _open(self, s: Any) -> Any:
        """Voltage before its limit."""
        gain = Phasor.polar(s.K_P, s.theta_P)
        through = gain * s.X_L + Phasor(s.K_I, 0.0)
        v_e = magnitude(gain * s.v + Phasor(-through.im, through.re) * s.i)
        return v_e if self.is_off("K_C") else v_e * rectifier(s.K_C * s.i_f / v_e)

    def equations(self, s: Any) -> Equations:
        return Equations(out=dict(v_b=s.free * self._open(s) + s.upper * s.V_Bmax))

    def transitions(self, s: Any) -> tuple[Go, ...]:
        v_b = self._open(s)
        return (
            Go("FREE", "UPPER", above(v_b, s.V_Bmax), settles=CLIPPED),
            Go("UPPER", "FREE", below(v_b, s.V_Bmax), settles=CLIPPED),
        )


def rectifier(load: Any) -> Any:
    """Output of a rectifier over its voltage, as its normalised current grows.

    >>> [round(float(rectifier(load)), 3) for load in (-0.1, 0.2, 0.6, 0.9, 1.2)]
    [1.0, 0.885, 0.625, 0.173, 0.0]
    """
    first, second = 0.433, 0.75
    slow = ca.fmin(ca.fmax(load, 0.0), first)
    bent = ca.fmin(ca.fmax(load, first), second)
    fast = ca.fmax(load, second) - second
    fallen = 1 - 0.577 * slow + ca.sqrt(0.75 - bent * bent) - sqrt(0.75 - first**2) - 1.732 * fast
    return ca.fmax(fallen, 0.0)


class Esst3aField(UnitBlock):
    r"""Inner field regulator of ESST3A.

    .. math::
        T_M \dot v_k = K_M (v_a - V_G) - v_k, \qquad V_{Mmin} \le v_k \le V_{Mmax}, \qquad
        V_G = \min(K_G V_f, V_{Gmax}), \qquad V_f = V_B v_k

    A mode is a pair: FREE or UPPER of the feedback V_G, and FREE, UPPER or LOWER of v_k. With T_M = 0 the
    inner loop is solved at once.
    Valid for a rectifier that follows its firing signal at once.
    Equilibrium: v_k = V_f / V_B, v_a = v_k / K_M + K_G V_f.
    Source: IEEE Std 421.5, type ST3A; ANDES's ESST3A.
    """

    modes = tuple(f"{one}_{other}" for one in ("FREE", "UPPER") for other in LIMITED)
    start = "FREE_FREE"
    flags = {  # noqa: RUF012
        "back_free": (1, 1, 1, 0, 0, 0),
        "back_upper": (0, 0, 0, 1, 1, 1),
        "out_free": (1, 0, 0, 1, 0, 0),
        "out_upper": (0, 1, 0, 0, 1, 0),
        "out_lower": (0, 0, 1, 0, 0, 1),
    }
    ordered = (("V_Mmin", "V_Mmax"),)

    K_M = Parameter(500.0, "1", (1e-3, 1e5), "gain of the inner regulator", ANDES)
    T_M = Parameter(0.1, "s", (0.0, 100.0), "lag of the inner regulator", ANDES)
    V_Mmin = Parameter(0.1, "1", (-1e5, 1e5), "lowest firing signal", ANDES)
    V_Mmax = Parameter(1.0, "1", (-1e5, 1e5), "highest firing signal", ANDES)
    K_G = Parameter(1.0, "1", (0.0, 100.0), "gain of the feedback", ANDES)
    V_Gmax = Parameter(4.0, "pu(V)", (0.0, 1e5), "highest feedback", ANDES)

    v_a = Input("pu(V)", "output of the voltage regulator")
    v_b = Input("pu(V)", "voltage of the source")
    v_f = Output("pu(V)", "field voltage")

    v_k = State(0.5, "1", "firing signal", time="T_M")

    def _asked(self, s: Any) -> Any:
        """Firing signal that is asked for."""
        back = s.back_free * s.K_G * s.v_b * s.v_k + s.back_upper * s.V_Gmax
        return s.K_M * (s.v_a - back)

    def equations(self, s: Any) -> Equations:
        at_once = self.is_off("T_M")
        side = lag_side(Flags(s, "out_"), s.v_k, self._asked(s), s.V_Mmin, s.V_Mmax, at_once)
        return Equations(der=dict(v_k=side), out=dict(v_f=s.v_b * s.v_k))

    def transitions(self, s: Any) -> tuple[Go, ...]:
        back = s.K_G * s.v_b * s.v_k
        feedback = (
            Go("FREE", "UPPER", above(back, s.V_Gmax), settles=CLIPPED),
            Go("UPPER", "FREE", below(back, s.V_Gmax), settles=CLIPPED),
        )
        signal = lag_rows("v_k", s.v_k, self._asked(s), s.V_Mmin, s.V_Mmax, self.is_off("T_M"))
        return product(feedback, signal, of_first=("FREE", "UPPER"))


PARTS = {"regulator": Esst3aRegulator, "source": CompoundSource, "field": Esst3aField}


def esst3a(**values: float) -> Diagram:
    """Static excitation system ESST3A: `regulator`, `source` and `field` in one diagram.

    Parameters
    ----------
    values : parameters of the three blocks, by name; no name stands in two of them.

    >>> sorted(esst3a(K_A=20.0, K_M=8.0).blocks)
    ['field', 'regulator', 'source']
    """
    names = {part: kind.declared(Parameter) for part, kind in PARTS.items()}
    known = [name for declared in names.values() for name in declared]
    unknown = [f"there is no parameter {k!r}.{did_you_mean(k, known)}" for k in values if k not in known]
    raise_all(unknown, "esst3a", InputError)
    d = Diagram("Esst3a", "Static excitation system ESST3A: compound source, inner field regulator.")
    v = d.input("v", "pu(V)", Phasor, doc="terminal voltage, network frame")
    i = d.input("i", "pu(I)", Phasor, rest=0.0, doc="current into the network, network frame")
    i_f = d.input("i_f", "pu(V)", doc="field current times X_ad")
    v_s = d.input("v_s", "pu(V)", doc="signal of the stabiliser")
    regulator, source, field = (
        d.add(part, kind(**{k: value for k, value in values.items() if k in names[part]}))
        for part, kind in PARTS.items()
    )
    d.connect(v, regulator.v, source.v)
    d.connect(i, source.i)
    d.connect(i_f, source.i_f)
    d.connect(v_s, regulator.v_s)
    d.connect(regulator.v_a, field.v_a)
    d.connect(source.v_b, field.v_b)
    d.output("v_f", field.v_f)
    return d
