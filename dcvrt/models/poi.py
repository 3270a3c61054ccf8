"""What the grid sees at the point of interconnection."""

from __future__ import annotations

from typing import Any

from dcvrt.models import smooth
from dcvrt.models.block import Block, Equations, Input, Output, Parameter, State
from dcvrt.models.phasor import Phasor


class Poi(Block):
    r"""Power that the facility draws.

    .. math::
        P^g + jQ^g = V I^{*}

    Paper: eq. (ups_complex_power), with S_B = 1 in per unit. Import positive. Algebraic.
    """

    eps = Parameter(1e-6, "pu(I)", (1e-9, 1e-2), "rounding of |i| at 0", "own choice: numerics")

    v = Input("pu(V)", "POI voltage, network frame", kind=Phasor)
    i = Input("pu(I)", "current drawn, network frame", kind=Phasor)
    p = Output("pu(S)", "active-power import")
    q = Output("pu(S)", "reactive-power import")
    i_mag = Output("pu(I)", "magnitude of the current")
    drawn = Output("pu(I)", "current drawn, network frame", kind=Phasor)

    def equations(self, s: Any) -> Equations:
        power = s.v * s.i.conj()
        return Equations(out=dict(p=power.re, q=power.im, i_mag=smooth.mag(s.i, s.eps), drawn=s.i))


class SharedPoi(Block):
    r"""Point of interconnection that feeds a UPS and, beside it, loads of their own.

    .. math::
        P^g + jQ^g = V (I_{ups} + I_{direct})^{*}, \qquad I_{max} = I_{max,ups} + I_{max,direct}

    Import positive. Algebraic. I_max bounds the current of the site, not of one converter.
    Differs: the paper has no load beside the UPS.
    """

    eps = Parameter(1e-6, "pu(I)", (1e-9, 1e-2), "rounding of |i| at 0", "own choice: numerics")

    v = Input("pu(V)", "POI voltage, network frame", kind=Phasor)
    ups = Input("pu(I)", "current of the UPS, network frame", kind=Phasor)
    direct = Input("pu(I)", "current of the loads beside it, network frame", kind=Phasor)
    ups_max = Input("pu(I)", "largest current of the UPS")
    direct_max = Input("pu(I)", "largest current of the loads beside it")
    p = Output("pu(S)", "active-power import")
    q = Output("pu(S)", "reactive-power import")
    i_mag = Output("pu(I)", "magnitude of the current")
    i_max = Output("pu(I)", "largest current of the site")
    drawn = Output("pu(I)", "current drawn, network frame", kind=Phasor)

    def equations(self, s: Any) -> Equations:
        i = s.ups + s.direct
        power = s.v * i.conj()
        out = dict(
            p=power.re, q=power.im, i_mag=smooth.mag(i, s.eps), i_max=s.ups_max + s.direct_max, drawn=i
        )
        return Equations(out=out)


class VoltageFilter(Block):
    r"""Measured magnitude of the POI voltage.

    .. math::
        T_m \dot V_f = |V| - V_f

    Equilibrium: V_f = |V|. The supervisor and the protected bus act on V_f, never on the raw voltage.
    Differs: the paper's supervisor has no measurement; a lag stands for the RMS window.
    """

    T = Parameter(5e-3, "s", (1e-4, 0.1), "time constant of the measurement", "illustrative")
    eps = Parameter(1e-4, "pu(V)", (1e-9, 1e-2), "rounding of |V| at 0", "own choice: numerics")

    v = Input("pu(V)", "POI voltage, network frame", kind=Phasor)
    v_f = State(1.0, "pu(V)", "measured voltage magnitude")

    def equations(self, s: Any) -> Equations:
        return Equations(der=dict(v_f=(smooth.mag(s.v, s.eps) - s.v_f) / s.T))

    def rest(self, s: Any) -> dict[str, Any]:
        return dict(v_f=smooth.mag(s.v, s.eps))
