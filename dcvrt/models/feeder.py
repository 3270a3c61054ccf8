"""The grid as a facility engineer knows it: a source behind an impedance."""

from __future__ import annotations

from typing import Any

from dcvrt.models.block import Block, Equations, Input, Output, Parameter
from dcvrt.models.phasor import Phasor


class Feeder(Block):
    r"""Source voltage behind a series impedance: the POI voltage falls with the current drawn.

    .. math::
        V = E - \frac{R + jX}{H} I

    Import positive, network frame. The impedance is on the base of the facility, so that its short-circuit
    ratio is :math:`1/\sqrt{R^2 + X^2}`. Algebraic: the network has no states at this time scale.
    Valid at nominal frequency; a current that needs more than E/|Z| has no voltage left to drive it. Largest
    active power at unity power factor and R = 0: E^2 H/(2X), drawn at I = E H/(sqrt(2) X).
    """

    H = Parameter(1.0, "pu(S)", (1e-6, 1e3), "base of the impedance", "decision of the planner")
    R = Parameter(0.0, "pu(V)/pu(I)", (0.0, 2.0), "resistance on H", "illustrative: purely inductive")
    X = Parameter(0.1, "pu(V)/pu(I)", (0.0, 2.0), "reactance on H", "illustrative: short-circuit ratio 10")

    e = Input("pu(V)", "source voltage, network frame", kind=Phasor)
    i = Input("pu(I)", "current drawn, network frame", kind=Phasor)
    v = Output("pu(V)", "POI voltage, network frame", kind=Phasor)

    def equations(self, s: Any) -> Equations:
        return Equations(out=dict(v=s.e - s.i * Phasor(s.R / s.H, s.X / s.H)))
