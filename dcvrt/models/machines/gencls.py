"""Classical synchronous machine: a constant voltage behind the transient reactance."""

from __future__ import annotations

from math import pi
from typing import Any

from dcvrt.models.block import Equations, Input, Output, Parameter, State
from dcvrt.models.machines.parts import UnitBlock
from dcvrt.models.phasor import Phasor


class GenCls(UnitBlock):
    r"""Synchronous machine of second order, GENCLS: an internal voltage that turns with the rotor.

    .. math::
        \dot\delta = 2\pi f_B (\omega - 1), \qquad M \dot\omega = T_m - T_e - D (\omega - 1)

    .. math::
        i = \frac{V_f e^{j\delta} - v}{r_a + j x'_d}, \qquad T_e = \operatorname{Re}\{(v + r_a i)\, i^*\}

    `delta` is the angle of the internal voltage V_f to the network frame, which turns at :math:`\omega_0`.
    The current is positive into the network: generator convention, opposite to the loads of a facility.
    Valid for the first swing, while the flux of the field is nearly constant, at speeds near 1.
    Equilibrium: omega = 1, :math:`V_f e^{j\delta} = v + (r_a + j x'_d) i`, T_m = T_e. On an infinite bus it
    swings with :math:`\sqrt{2\pi f_B K / M}`, K the slope of T_e over delta.
    Source: P. Kundur, Power System Stability and Control, ch. 12; ANDES's GENCLS.
    """

    M = Parameter(8.0, "s", (1e-3, 1e9), "start-up time, 2H, on the common base", "illustrative: H = 4 s")
    D = Parameter(0.0, "1", (0.0, 1e9), "damping: torque over speed", "default of ANDES's GENCLS")
    f_B = Parameter(60.0, "Hz", (45.0, 65.0), "nominal frequency", "North American grid")
    r_a = Parameter(
        0.0, "pu(V)/pu(I)", (0.0, 100.0), "resistance of the armature", "default of ANDES's GENCLS"
    )
    x_d1 = Parameter(
        0.302, "pu(V)/pu(I)", (1e-12, 100.0), "transient reactance x_d'", "default of ANDES's GENCLS"
    )

    v = Input("pu(V)", "terminal voltage, network frame", kind=Phasor)
    v_f = Input("pu(V)", "magnitude of the internal voltage")
    t_m = Input("pu(S)", "mechanical torque")
    i = Output("pu(I)", "current into the network, network frame", kind=Phasor)
    t_e = Output("pu(S)", "electrical torque")
    i_f = Output("pu(V)", "field current times X_ad, as far as this machine knows one")

    delta = State(0.5, "rad", "angle of the internal voltage")
    omega = State(1.0, "1", "speed over the nominal one")

    def equations(self, s: Any) -> Equations:
        i = (Phasor.polar(s.v_f, s.delta) - s.v) / Phasor(s.r_a, s.x_d1)
        t_e = ((s.v + i * s.r_a) * i.conj()).re
        return Equations(
            der=dict(
                delta=2 * pi * s.f_B * (s.omega - 1),
                omega=(s.t_m - t_e - s.D * (s.omega - 1)) / s.M,
            ),
            out=dict(i=i, t_e=t_e, i_f=s.v_f),
        )

    def rest(self, s: Any) -> dict[str, Any]:
        return dict(omega=1.0)
