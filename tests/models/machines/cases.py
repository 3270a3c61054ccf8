"""Blocks of units in the forms that their values give them, and the phasor diagram of a machine."""

from __future__ import annotations

from math import sqrt

import numpy as np

from dcvrt.models.machines import (
    BusFrequency,
    CompoundSource,
    CurrentConverter,
    Esst3aField,
    Esst3aRegulator,
    Exdc2,
    ExponentialLoad,
    Exst1,
    FixedField,
    FixedPower,
    GenCls,
    GenRou,
    Ieeeg1,
    Ieeest,
    IeeestWithWindow,
    Ieeet1,
    Ieeex1,
    Ieeex1BusFed,
    NoStabiliser,
    Sexs,
    St2Cut,
    StaticLoad,
    Tgov1,
    Tgov1N,
    ZipLoad,
)

FORMS = [
    (GenRou, {}),
    (GenRou, dict(r_a=0.01, S_A=0.7, S_B=0.4)),
    (GenRou, dict(r_a=0.01, x_q2=0.3)),
    (GenRou, dict(x_q2=0.3, S_A=0.7, S_B=0.4)),
    (GenCls, dict(r_a=0.02)),
    (StaticLoad, dict(p_0=0.9, q_0=0.4)),
    (ExponentialLoad, dict(p_0=0.9, q_0=0.4, alpha=1.3, beta=2.4)),
    (ZipLoad, dict(p_0=0.9, q_0=0.4, a_z=0.3, a_i=0.3, b_z=0.5, b_i=0.1)),
    (CurrentConverter, dict(p_0=0.8, q_0=-0.2)),
    (FixedField, {}),
    (FixedPower, {}),
    (NoStabiliser, {}),
    (BusFrequency, {}),
    (BusFrequency, dict(T_f=0.0)),
    (Sexs, {}),
    (Sexs, dict(T_B=0.0, T_E=0.0)),
    (Ieeet1, dict(S_A=0.5, S_B=0.2)),
    (Ieeet1, dict(T_R=0.0, T_A=0.0)),
    (Exdc2, dict(S_A=0.5, S_B=0.2)),
    (Exdc2, dict(T_R=0.0, T_B=0.0, T_A=0.0)),
    (Ieeex1, dict(S_A=0.5, S_B=0.2)),
    (Ieeex1BusFed, dict(S_A=0.5, S_B=0.2)),
    (Ieeex1BusFed, dict(T_A=0.0)),
    (Exst1, {}),
    (Exst1, dict(T_R=0.0, T_B=0.0, T_A=0.0, K_C=0.0)),
    (Esst3aRegulator, {}),
    (Esst3aRegulator, dict(T_A=0.0, T_B=0.0)),
    (CompoundSource, dict(theta_P=0.1)),
    (CompoundSource, dict(K_C=0.0)),
    (Esst3aField, dict(K_M=8.0)),
    (Esst3aField, dict(K_M=8.0, T_M=0.0)),
    (Tgov1, dict(D_t=0.3)),
    (Tgov1, dict(T_1=0.0, T_3=0.0)),
    (Tgov1N, {}),
    (Ieeeg1, {}),
    (Ieeeg1, dict(T_1=0.0, T_5=0.0, T_6=0.0)),
    *[(Ieeest, dict(signal=float(k), share=9.0)) for k in range(6)],
    (Ieeest, dict(A_1=0.1, A_2=0.02, A_3=0.1, A_4=0.02, A_5=0.2, A_6=0.01)),
    (Ieeest, dict(A_1=0.1, T_2=0.0, T_4=0.0, T_5=0.0)),
    (IeeestWithWindow, {}),
    (St2Cut, dict(signal_2=3.0)),
    (St2Cut, dict(T_1=0.0, T_2=0.0, T_10=0.0, T_3=0.0)),
]


def named(form):
    kind, values = form
    return f"{kind.__name__}-{'-'.join(f'{k}={v:g}' for k, v in values.items()) or 'default'}"


def phasor_diagram(m, v, i):
    """States, field voltage and torque of a GENROU at rest, from the phasors of its terminal.

    The q-axis lies along (1 + S g) psi'' + j (x_q - x_q'') i; all windings but the field carry no current.
    """
    psi = v + complex(m.r_a, m.x_q2) * i if not m.salient else None
    assert psi is not None, "with saliency the axis is found from x_q alone, without saturation"
    beyond = max(abs(psi) - m.S_A, 0.0)
    share = m.S_B * beyond**2 / abs(psi)
    g = (m.x_q - m.x_l) / (m.x_d - m.x_l)
    axis = psi * (1 + share * g) + 1j * (m.x_q - m.x_q2) * i
    delta = np.angle(axis)
    turned = np.exp(-1j * delta)
    v_q, v_d = (v * turned).real, -(v * turned).imag
    i_q, i_d = (i * turned).real, -(i * turned).imag
    psi_d, psi_q = (psi * turned).real, -(psi * turned).imag
    v_f = (1 + share) * psi_d + (m.x_d - m.x_d2) * i_d
    states = dict(
        delta=delta,
        omega=1.0,
        e_q1=v_f - (m.x_d - m.x_d1) * i_d - share * psi_d,
        e_d1=(m.x_q - m.x_q1) * i_q - share * g * psi_q,
        e_d2=v_f - (m.x_d - m.x_l) * i_d - share * psi_d,
        e_q2=(m.x_q - m.x_l) * i_q - share * g * psi_q,
    )
    t_m = ((v + m.r_a * i) * np.conj(i)).real
    assert abs(v_q**2 + v_d**2 - abs(v) ** 2) < 1e-12
    return states, v_f, t_m


def magnitude(v):
    return sqrt(v.re**2 + v.im**2)
