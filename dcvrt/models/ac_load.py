"""Loads on an AC bus: what is neither server nor UPS, and the bus that adds currents."""

from __future__ import annotations

from typing import Any

from dcvrt.models import smooth
from dcvrt.models.block import Block, Equations, Input, Output, Parameter
from dcvrt.models.phasor import Phasor


class AcLoad(Block):
    r"""Cooling and auxiliaries on an AC bus: constant power, below a voltage constant admittance.

    .. math::
        P = \sigma(V)\, P^{dem}, \qquad \sigma(V) = \min(1, |V|/V_z)^2, \qquad
        I = \frac{P - jQ}{V^{*}}, \qquad Q = P \tan\varphi

    Import positive; the same law as that of the static server supply. Algebraic.
    Valid for drives and motors that stay connected; contactors drop out earlier, see the cooling blocks.
    Differs: the paper feeds these loads from the protected bus at any voltage.
    """

    pf = Parameter(0.98, "1", (0.8, 1.0), "power factor, lagging", "illustrative")
    V_z = Parameter(0.85, "pu(V)", (0.3, 1.0), "constant admittance below", "illustrative")
    eps = Parameter(1e-3, "pu(V)2", (1e-6, 0.1), "smoothing width", "own choice: numerics")

    v = Input("pu(V)", "voltage of the bus, network frame", kind=Phasor)
    cooling_demand = Input("pu(S)", "power that the cooling asks for")
    auxiliary_demand = Input("pu(S)", "power that the auxiliaries ask for")
    i = Output("pu(I)", "current drawn, network frame", kind=Phasor)
    cooling = Output("pu(S)", "power that the cooling gets")
    auxiliary = Output("pu(S)", "power that the auxiliaries get")

    def equations(self, s: Any) -> Equations:
        per_power = 1 / smooth.maximum(s.v.abs2(), s.V_z**2, s.eps)
        served = s.v.abs2() * per_power
        demand = s.cooling_demand + s.auxiliary_demand
        lagging = Phasor(1.0, -smooth.root(1 / s.pf**2 - 1, 1e-6))
        return Equations(
            out=dict(
                i=s.v * (demand * per_power) * lagging,
                cooling=served * s.cooling_demand,
                auxiliary=served * s.auxiliary_demand,
            )
        )


class AcBus(Block):
    r"""Bus of the loads: currents add.

    .. math::
        I = I_{servers} + I_{others}, \qquad P = \operatorname{Re}\{V I^{*}\}, \qquad I_{max} = \beta H

    Algebraic. I_max is the rating of what feeds the bus; nothing here enforces it.
    """

    H = Parameter(1.0, "pu(S)", (1e-6, 1e3), "hosted capacity", "decision of the planner")
    beta = Parameter(1.15, "1", (0.5, 3.0), "rating of the feed over hosted capacity", "illustrative")

    v = Input("pu(V)", "voltage of the bus, network frame", kind=Phasor)
    servers = Input("pu(I)", "current of the server supplies, network frame", kind=Phasor)
    others = Input("pu(I)", "current of the other loads, network frame", kind=Phasor)
    i = Output("pu(I)", "current of all loads, network frame", kind=Phasor)
    p = Output("pu(S)", "active power of all loads")
    i_max = Output("pu(I)", "rated current of the feed")

    def equations(self, s: Any) -> Equations:
        i = s.servers + s.others
        return Equations(out=dict(i=i, p=(s.v * i.conj()).re, i_max=s.beta * s.H))
