"""Current reference of the grid-following UPS."""

from __future__ import annotations

from typing import Any

from dcvrt.models import smooth
from dcvrt.models.block import Block, Equations, Input, Output, Parameter
from dcvrt.models.phasor import Phasor


class CurrentReference(Block):
    r"""Current that would draw the commanded power at the present voltage, in the PLL frame.

    .. math::
        I^u_{dq} = \left(\frac{P^c + jQ^c}{V_{dq,\epsilon}}\right)^{*}, \qquad
        \frac{1}{V_{dq,\epsilon}} = \frac{V_{dq}^*}{\max(|V|^2, V_\epsilon^2)}, \qquad
        V_{dq} = V e^{-j\delta}

    Paper: eqs. (gfl_pll_error), (gfl_current_reference); the limiter is a block of its own.
    Import positive. Below the floor the reference falls with |V| instead of growing without bound.
    Differs: the paper names the lower voltage bound without giving it; here |V|^2 is held above V_eps^2.
    """

    V_eps = Parameter(0.1, "pu(V)", (1e-3, 0.5), "voltage floor of the division", "illustrative")
    eps = Parameter(1e-3, "pu(V)", (1e-6, 0.1), "smoothing width of the floor", "own choice: numerics")

    v = Input("pu(V)", "POI voltage, network frame", kind=Phasor)
    delta = Input("rad", "angle of the dq frame")
    p_c = Input("pu(S)", "active-power command")
    q_c = Input("pu(S)", "reactive-power command")
    i = Output("pu(I)", "current asked for, dq frame", kind=Phasor)
    v_dq = Output("pu(V)", "POI voltage, dq frame", kind=Phasor)

    def equations(self, s: Any) -> Equations:
        v_dq = s.v.turn(-s.delta)
        square = s.V_eps**2 + smooth.pos(s.v.abs2() - s.V_eps**2, s.eps * s.V_eps)
        i = (Phasor(s.p_c, s.q_c) * v_dq.conj() / square).conj()
        return Equations(out=dict(i=i, v_dq=v_dq))
