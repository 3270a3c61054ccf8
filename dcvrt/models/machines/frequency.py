"""Frequency of a bus, as a stabiliser measures it."""

from __future__ import annotations

from math import pi
from typing import Any

from dcvrt.models.block import Equations, Input, Output, Parameter, State
from dcvrt.models.machines.parts import UnitBlock
from dcvrt.models.phasor import Phasor


class BusFrequency(UnitBlock):
    r"""Filtered derivative of the angle of a voltage, ANDES's BusFreq.

    .. math::
        T_f \dot\theta = \arg\{v e^{-j\theta}\}, \qquad T_w \dot x = \theta - x, \qquad
        f = 1 + \frac{\theta - x}{2\pi f_B T_w}

    theta follows the angle of v, both seen from the network frame, which turns at :math:`\omega_0`. The
    argument is taken from theta on, so that nothing jumps when the angle passes pi.
    Valid while the angle is less than half a turn from its filtered value, and v is not 0.
    Equilibrium: theta = x = arg v, f = 1.
    Source: ANDES's BusFreq.
    """

    f_B = Parameter(60.0, "Hz", (45.0, 65.0), "nominal frequency", "North American grid")
    T_f = Parameter(0.02, "s", (0.0, 10.0), "lag of the filter", "default of ANDES's BusFreq")
    T_w = Parameter(0.1, "s", (1e-4, 10.0), "time constant of the derivative", "default of ANDES's BusFreq")

    v = Input("pu(V)", "voltage, network frame", kind=Phasor)
    f = Output("1", "frequency over the nominal one")

    theta = State(0.0, "rad", "filtered angle", time="T_f")
    x = State(0.0, "rad", "state of the derivative", time="T_w")

    def equations(self, s: Any) -> Equations:
        # without the filter theta is the angle itself, counted on from x
        base = s.x if self.is_off("T_f") else s.theta
        ahead = base + s.v.turn(-base).angle() - s.theta
        return Equations(
            der=dict(theta=ahead, x=s.theta - s.x),
            out=dict(f=1 + (s.theta - s.x) / (2 * pi * s.f_B * s.T_w)),
        )

    def rest(self, s: Any) -> dict[str, Any]:
        return dict(theta=s.v.angle(), x=s.v.angle())
