"""Loads without memory that depend on the voltage: exponential and ZIP."""

from __future__ import annotations

from typing import Any

import casadi as ca

from dcvrt.models.block import Equations, Input, Output, Parameter
from dcvrt.models.machines.parts import UnitBlock, magnitude
from dcvrt.models.phasor import Phasor, Scalar

OWN = "own choice"


class StaticLoad(UnitBlock):
    """Load without memory: an impedance here, other dependences on the voltage in what derives from it.

    Equilibrium: none of its own, it has no state.
    """

    p_0 = Parameter(0.0, "pu(S)", (-1e4, 1e4), "active power at 1 pu", "found by the initialisation")
    q_0 = Parameter(0.0, "pu(S)", (-1e4, 1e4), "reactive power at 1 pu", "found by the initialisation")
    v_low = Parameter(
        0.7,
        "pu(V)",
        (0.05, 1.0),
        "below it the load is an impedance",
        "common practice of stability programs",
    )

    v = Input("pu(V)", "terminal voltage, network frame", kind=Phasor)
    i = Output("pu(I)", "current INTO the network, generator convention", kind=Phasor)

    def shapes(self, s: Any, m: Scalar) -> tuple[Scalar, Scalar]:
        """Active and reactive power at a voltage m, over those at 1 pu: of an impedance."""
        return m * m, m * m

    def equations(self, s: Any) -> Equations:
        m = magnitude(s.v)
        above = ca.fmax(m, s.v_low)
        p, q = self.shapes(s, above)
        return Equations(out=dict(i=s.v * Phasor(-s.p_0 * p, s.q_0 * q) / (above * above)))


class ExponentialLoad(StaticLoad):
    r"""Load whose powers are powers of the voltage.

    .. math::
        P = P_0\, m^{\alpha}, \qquad Q = Q_0\, m^{\beta}, \qquad m = |v|

    Below v_low it is the impedance that it is there: :math:`P = P_0\, v_{low}^{\alpha} (m / v_{low})^2`.
    Exponent 2 is an impedance, 1 a current, 0 a power. Generator convention: the current is negative.
    Equilibrium: none of its own, it has no state.
    Source: IEEE Task Force on Load Representation, IEEE Trans. Power Syst. 10 (1995) 1302-1313.
    """

    alpha = Parameter(2.0, "1", (0.0, 4.0), "exponent of the active power", OWN)
    beta = Parameter(2.0, "1", (0.0, 6.0), "exponent of the reactive power", OWN)

    def shapes(self, s: Any, m: Scalar) -> tuple[Scalar, Scalar]:
        return m**s.alpha, m**s.beta


class ZipLoad(StaticLoad):
    r"""Load in parts of impedance, current and power; the parts are those at 1 pu.

    .. math::
        P = P_0 (a_z m^2 + a_i m + 1 - a_z - a_i), \qquad Q = Q_0 (b_z m^2 + b_i m + 1 - b_z - b_i),
        \qquad m = |v|

    Below v_low it is the impedance that it is there. Generator convention: the current is negative.
    Equilibrium: none of its own, it has no state.
    Source: IEEE Task Force on Load Representation, IEEE Trans. Power Syst. 10 (1995) 1302-1313.
    """

    a_z = Parameter(1.0, "1", (0.0, 1.0), "active power, part of an impedance", OWN)
    a_i = Parameter(0.0, "1", (0.0, 1.0), "active power, part of a current", OWN)
    b_z = Parameter(1.0, "1", (0.0, 1.0), "reactive power, part of an impedance", OWN)
    b_i = Parameter(0.0, "1", (0.0, 1.0), "reactive power, part of a current", OWN)

    def shapes(self, s: Any, m: Scalar) -> tuple[Scalar, Scalar]:
        p = s.a_z * m * m + s.a_i * m + 1 - s.a_z - s.a_i
        return p, s.b_z * m * m + s.b_i * m + 1 - s.b_z - s.b_i
