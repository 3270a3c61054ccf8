"""A generator behind a converter that controls its current, as a wind plant."""

from __future__ import annotations

from typing import Any

from dcvrt.models import smooth
from dcvrt.models.block import Equations, Input, Output, Parameter, State
from dcvrt.models.limiter import active_priority
from dcvrt.models.machines.parts import UnitBlock
from dcvrt.models.phasor import Phasor

OWN = "illustrative"


class CurrentConverter(UnitBlock):
    r"""Converter that feeds constant power through a lagged current with a limit.

    .. math::
        i^{*} = \overline{(P_0 + jQ_0)/\hat v}, \qquad \hat v = v\, \max(|v|, V_{floor}) / |v|, \qquad
        T_i\, \dot i = \operatorname{lim}_{I_{max}}(i^{*}) - i

    In the network frame: its synchronisation is taken as ideal. The limit, the largest current over the
    power at
    rest, keeps active before reactive current. Generator convention: power and current into the network.
    Valid for a plant whose control is faster than the voltage's recovery; no plant model of any maker.
    Equilibrium: v conj(i) = P_0 + j Q_0.
    """

    p_0 = Parameter(0.0, "pu(S)", (-1e4, 1e4), "active power fed in", "found by the initialisation")
    q_0 = Parameter(0.0, "pu(S)", (-1e4, 1e4), "reactive power fed in", "found by the initialisation")
    T_i = Parameter(0.02, "s", (1e-3, 1.0), "lag of the current control", OWN)
    k_max = Parameter(1.1, "1", (1.0, 3.0), "largest current over the power at rest", OWN)
    V_floor = Parameter(0.1, "pu(V)", (1e-3, 0.9), "least voltage that currents are computed with", OWN)
    eps = Parameter(1e-4, "pu(I)", (1e-12, 1e-2), "rounding of limits", "own choice: numerics")

    v = Input("pu(V)", "terminal voltage, network frame", kind=Phasor)
    i = Output("pu(I)", "current INTO the network, generator convention", kind=Phasor)

    i_re = State(0.0, "pu(I)", "current, real part")
    i_im = State(0.0, "pu(I)", "current, imaginary part")

    def equations(self, s: Any) -> Equations:
        size = smooth.mag(s.v, s.eps)
        asked = Phasor(s.p_0, -s.q_0) * s.v / (size * smooth.maximum(size, s.V_floor, s.eps))
        i_max = s.k_max * smooth.mag(Phasor(s.p_0, s.q_0), s.eps)
        granted = active_priority(asked, s.v, i_max, (-i_max, i_max), s.eps, s.eps)
        return Equations(
            der=dict(i_re=(granted.re - s.i_re) / s.T_i, i_im=(granted.im - s.i_im) / s.T_i),
            out=dict(i=Phasor(s.i_re, s.i_im)),
        )
