"""Round-rotor synchronous machine with a field, a damper in each axis and a second one in the q-axis."""

from __future__ import annotations

from math import pi
from typing import Any

import casadi as ca

from dcvrt.errors import InputError, raise_all
from dcvrt.models.block import Equations, Input, Output, Parameter, State
from dcvrt.models.machines.parts import UnitBlock, saturation
from dcvrt.models.phasor import Phasor

ANDES = "default of ANDES's GENROU"


class GenRou(UnitBlock):
    r"""Synchronous machine of sixth order, GENROU: two rotor circuits in each axis.

    .. math::
        \dot\delta = 2\pi f_B (\omega - 1), \qquad M \dot\omega = T_m - T_e - D (\omega - 1)

    .. math::
        \psi''_d = \gamma_{d1} e'_q + (1 - \gamma_{d1})\, e''_d, \qquad
        \psi''_q = \gamma_{q1} e'_d + (1 - \gamma_{q1})\, e''_q

    .. math::
        \gamma_{d1} = \frac{x''_d - x_l}{x'_d - x_l}, \qquad \gamma_{q1} = \frac{x''_q - x_l}{x'_q - x_l}

    .. math::
        v_q = \psi''_d - x''_d i_d - r_a i_q, \qquad v_d = \psi''_q + x''_q i_q - r_a i_d

    .. math::
        T'_{d0} \dot e'_q = V_f - X_{ad} i_f, \qquad
        X_{ad} i_f = e'_q + (x_d - x'_d) (\gamma_{d1} i_d + \gamma_{d2} (e'_q - e''_d)) + S \psi''_d

    .. math::
        T'_{q0} \dot e'_d = -e'_d - (x_q - x'_q) (\gamma_{q2} (e'_d - e''_q) - \gamma_{q1} i_q)
            - S \gamma_{qd} \psi''_q

    .. math::
        T''_{d0} \dot e''_d = e'_q - e''_d - (x'_d - x_l)\, i_d, \qquad
        T''_{q0} \dot e''_q = e'_d - e''_q + (x'_q - x_l)\, i_q

    .. math::
        \gamma_{d2} = \frac{x'_d - x''_d}{(x'_d - x_l)^2}, \qquad
        \gamma_{q2} = \frac{x'_q - x''_q}{(x'_q - x_l)^2}, \qquad \gamma_{qd} = \frac{x_q - x_l}{x_d - x_l}

    .. math::
        S = \frac{S_B\, [\psi'' - S_A]_+^2}{\psi''}, \qquad \psi'' = |\psi''_d + j \psi''_q|

    .. math::
        T_e = (v_q + r_a i_q)\, i_q + (v_d + r_a i_d)\, i_d

    `delta` is the angle of the q-axis to the network frame, which turns at :math:`\omega_0`:
    :math:`v e^{-j\delta} = v_q - j v_d`, and the same for the current. The current is positive into the
    network: generator convention, opposite to the loads of a facility.

    Where x_d'' and x_q'' are equal when the block is made, the machine is a source behind one impedance,
    :math:`i = ((\psi''_d - j \psi''_q) e^{j\delta} - v) / (r_a + j x''_d)`, and is written so: di/dv is then
    constant. Such a compiled machine takes x_q'' for its rotor only: set both to the same value. Without
    saturation (S_B = 0) its terms are left out.
    Valid at speeds near 1: stator transients and the effect of speed on the stator voltages are neglected.
    Equilibrium: omega = 1, :math:`\delta = \arg\{(1 + S \gamma_{qd}) \psi'' + j (x_q - x''_q) i\}`, with
    :math:`\psi'' = v + (r_a + j x''_q) i` a phasor; V_f = X_ad i_f.
    Source: the equations of PSS/E's GENROU as in ANDES; P. Kundur, Power System Stability and Control, ch. 5.
    """

    optional = ("S_B",)

    M = Parameter(8.0, "s", (1e-3, 1e9), "start-up time, 2H, on the common base", "illustrative: H = 4 s")
    D = Parameter(0.0, "1", (0.0, 1e9), "damping: torque over speed", ANDES)
    f_B = Parameter(60.0, "Hz", (45.0, 65.0), "nominal frequency", "North American grid")
    r_a = Parameter(0.0, "pu(V)/pu(I)", (0.0, 100.0), "resistance of the armature", ANDES)
    x_l = Parameter(0.15, "pu(V)/pu(I)", (0.0, 100.0), "leakage reactance", "illustrative")
    x_d = Parameter(1.9, "pu(V)/pu(I)", (1e-12, 100.0), "synchronous reactance, d-axis", ANDES)
    x_q = Parameter(1.7, "pu(V)/pu(I)", (1e-12, 100.0), "synchronous reactance, q-axis", ANDES)
    x_d1 = Parameter(0.302, "pu(V)/pu(I)", (1e-12, 100.0), "transient reactance x_d', d-axis", ANDES)
    x_q1 = Parameter(0.5, "pu(V)/pu(I)", (1e-12, 100.0), "transient reactance x_q', q-axis", ANDES)
    x_d2 = Parameter(0.25, "pu(V)/pu(I)", (1e-12, 100.0), "subtransient reactance x_d''", "illustrative")
    x_q2 = Parameter(0.25, "pu(V)/pu(I)", (1e-12, 100.0), "subtransient reactance x_q''", "illustrative")
    T_d1 = Parameter(8.0, "s", (1e-3, 100.0), "open-circuit transient time constant T_d0'", ANDES)
    T_q1 = Parameter(0.8, "s", (1e-3, 100.0), "open-circuit transient time constant T_q0'", ANDES)
    T_d2 = Parameter(0.04, "s", (1e-3, 10.0), "open-circuit subtransient time constant T_d0''", ANDES)
    T_q2 = Parameter(0.02, "s", (1e-3, 10.0), "open-circuit subtransient time constant T_q0''", ANDES)
    S_A = Parameter(0.8, "pu(V)", (-100.0, 100.0), "flux at which saturation begins", "illustrative")
    S_B = Parameter(0.0, "1/pu(V)", (0.0, 1e3), "gain of the saturation; 0 for none", "none by default")

    v = Input("pu(V)", "terminal voltage, network frame", kind=Phasor)
    v_f = Input("pu(V)", "field voltage")
    t_m = Input("pu(S)", "mechanical torque")
    i = Output("pu(I)", "current into the network, network frame", kind=Phasor)
    t_e = Output("pu(S)", "electrical torque")
    i_f = Output("pu(V)", "field current times X_ad")

    delta = State(0.5, "rad", "angle of the q-axis")
    omega = State(1.0, "1", "speed over the nominal one")
    e_q1 = State(1.0, "pu(V)", "transient voltage e_q'")
    e_d1 = State(0.0, "pu(V)", "transient voltage e_d'")
    e_d2 = State(1.0, "pu(V)", "subtransient voltage e_d''")
    e_q2 = State(0.0, "pu(V)", "subtransient voltage e_q''")

    def __init__(self, **values: float) -> None:
        super().__init__(**values)
        equal = [
            f"{name} and x_l are both {self.values['x_l']:g}. The equations divide by their difference: "
            "make x_l smaller."
            for name in ("x_d", "x_d1", "x_q1")
            if self.values[name] == self.values["x_l"]
        ]
        raise_all(equal, type(self).__name__, InputError)

    @property
    def salient(self) -> bool:
        """Whether the subtransient reactances of the axes differ."""
        return self.values["x_d2"] != self.values["x_q2"]

    def traits(self) -> tuple[Any, ...]:
        return ("salient",) if self.salient else ()

    def equations(self, s: Any) -> Equations:
        g_d1, g_q1 = (s.x_d2 - s.x_l) / (s.x_d1 - s.x_l), (s.x_q2 - s.x_l) / (s.x_q1 - s.x_l)
        g_d2 = (s.x_d1 - s.x_d2) / (s.x_d1 - s.x_l) ** 2
        g_q2 = (s.x_q1 - s.x_q2) / (s.x_q1 - s.x_l) ** 2
        psi_d = g_d1 * s.e_q1 + (1 - g_d1) * s.e_d2
        psi_q = g_q1 * s.e_d1 + (1 - g_q1) * s.e_q2
        seen = s.v.turn(-s.delta)
        v_q, v_d = seen.re, -seen.im
        if self.salient:
            a, b = psi_d - v_q, psi_q - v_d
            det = s.r_a**2 + s.x_d2 * s.x_q2
            i_q, i_d = (s.r_a * a - s.x_d2 * b) / det, (s.x_q2 * a + s.r_a * b) / det
            i = Phasor(i_q, -i_d).turn(s.delta)
        else:
            i = (Phasor(psi_d, -psi_q).turn(s.delta) - s.v) / Phasor(s.r_a, s.x_d2)
            own = i.turn(-s.delta)
            i_q, i_d = own.re, -own.im
        i_f = s.e_q1 + (s.x_d - s.x_d1) * (g_d1 * i_d + g_d2 * (s.e_q1 - s.e_d2))
        damper = s.e_d1 + (s.x_q - s.x_q1) * (g_q2 * (s.e_d1 - s.e_q2) - g_q1 * i_q)
        if not self.is_off("S_B"):
            psi = ca.sqrt(psi_d * psi_d + psi_q * psi_q)
            share = saturation(psi, s.S_A, s.S_B) / psi
            i_f = i_f + share * psi_d
            damper = damper + share * psi_q * (s.x_q - s.x_l) / (s.x_d - s.x_l)
        t_e = (v_q + s.r_a * i_q) * i_q + (v_d + s.r_a * i_d) * i_d
        return Equations(
            der=dict(
                delta=2 * pi * s.f_B * (s.omega - 1),
                omega=(s.t_m - t_e - s.D * (s.omega - 1)) / s.M,
                e_q1=(s.v_f - i_f) / s.T_d1,
                e_d1=-damper / s.T_q1,
                e_d2=(s.e_q1 - s.e_d2 - (s.x_d1 - s.x_l) * i_d) / s.T_d2,
                e_q2=(s.e_d1 - s.e_q2 + (s.x_q1 - s.x_l) * i_q) / s.T_q2,
            ),
            out=dict(i=i, t_e=t_e, i_f=i_f),
        )

    def rest(self, s: Any) -> dict[str, Any]:
        return dict(omega=1.0)
