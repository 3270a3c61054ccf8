"""Droop control of the grid-forming UPS."""

from __future__ import annotations

from math import pi
from typing import Any

from dcvrt.models import smooth
from dcvrt.models.automaton import Go, above, below
from dcvrt.models.block import Equations, Input, Output, Parameter, State
from dcvrt.models.internal_voltage import (
    GridForming,
    effective_command,
    internal_voltage_at_rest,
    virtual_current,
)
from dcvrt.models.phasor import Phasor


class Droop(GridForming):
    r"""Voltage source behind a virtual impedance whose frequency and magnitude fall with measured powers.

    .. math::
        I^u = \frac{V - E e^{j\delta}}{Z_v}, \qquad Z_v = \frac{R_v + j X_v}{H}

    .. math::
        T_f \dot P_f = f\,(P^g - P_f), \qquad T_f \dot Q_f = f\,(Q^g - Q_f)

    .. math::
        \omega = 1 + m_p \frac{P_f - P^{eff}}{H}, \qquad
        \dot\delta = f\, \omega_B (\omega - 1) + u, \qquad
        u = s K_s \operatorname{Im}\{V e^{-j\delta}\}

    .. math::
        P^{eff} = P^c + s\,(P_f - P^c) - (1 - s)\, m\, [P^c - P_f]_+, \qquad
        m = \operatorname{step}(i_p^u - I_{max})

    .. math::
        E = \operatorname{sat}_{[E_{min}, E_{max}]}\!\left(E_0 + K_Q \frac{Q_f - Q^c}{H}\right), \qquad
        T_0 \dot E_0 = f h\, \frac{Q^u - Q^c}{H}

    Import positive: a facility that draws too much runs ahead, its angle advances and its import falls. Flags
    of the supervisor: s (resync), h (trim). f is 1 in FREE and 0 in FROZEN, the mode of a dip, in which
    measurements, angle and set point stand still.

    | mode | meaning |
    |---|---|
    | FREE | droop acts |
    | FROZEN | the measured voltage fell below V_freeze and has not come back above V_thaw |

    Structure and droops: ANDES REGF1, whose inner voltage and current loops are the lag of the current here.
    Equilibrium: omega = 1, P_f = P_g = P_c, Q_u = Q_c: where the virtual synchronous machine rests too.
    With P_c constant this is that machine with :math:`2 H_v = T_f/m_p`, :math:`D = 1/m_p`: eliminate P_f.
    A grid at another frequency draws :math:`P^g = P^c + H (\omega_{grid} - 1)/m_p`.
    Differs: not in the paper, whose grid-forming mode is a virtual synchronous machine. Power matching,
    resynchronisation and trim are the same functions, of the measured power.
    """

    modes = ("FREE", "FROZEN")
    start = "FREE"
    flags = {"free": (1, 0)}  # noqa: RUF012

    m_p = Parameter(0.033, "1", (1e-3, 0.2), "frequency droop: frequency over power", "ANDES REGF1: 0.033")
    K_Q = Parameter(0.045, "pu(V)/pu(S)", (0.0, 1.0), "reactive droop over H", "ANDES REGF1: 0.045")
    T_f = Parameter(5e-3, "s", (5e-4, 1.0), "time constant of the power measurement", "ANDES REGF1: 5 ms")
    V_freeze = Parameter(0.8, "pu(V)", (0.0, 1.0), "freeze below", "ANDES REGF1: Vdip 0.8")
    V_thaw = Parameter(0.85, "pu(V)", (0.0, 1.0), "free again above", "illustrative: hysteresis")

    v_f = Input("pu(V)", "measured POI voltage")
    omega = Output("1", "internal frequency over the nominal one")
    E = Output("pu(V)", "magnitude of the internal voltage")

    p_f = State(0.9, "pu(S)", "measured active import")
    q_f = State(0.2, "pu(S)", "measured reactive import")
    delta = State(0.0, "rad", "angle of the internal voltage")
    E_0 = State(1.0, "pu(V)", "set point of the magnitude")

    def transitions(self, s: Any) -> tuple[Go, ...]:
        return (
            Go("FREE", "FROZEN", below(s.v_f, s.V_freeze)),
            Go("FROZEN", "FREE", above(s.v_f, s.V_thaw)),
        )

    def equations(self, s: Any) -> Equations:
        v_dq = s.v.turn(-s.delta)
        E = smooth.sat(s.E_0 + s.K_Q * (s.q_f - s.q_c) / s.H, s.E_min, s.E_max, s.eps)
        i = virtual_current(v_dq, E, s.H, Phasor(s.R_v, s.X_v))
        q_u = (v_dq * i.conj()).im
        p_eff = effective_command(s.p_c, s.p_f, s.shortfall, s.resync, s.eps * s.H)
        slip = s.free * s.m_p * (s.p_f - p_eff) / s.H
        return Equations(
            der=dict(
                p_f=s.free * (s.p_g - s.p_f) / s.T_f,
                q_f=s.free * (s.q_g - s.q_f) / s.T_f,
                delta=2 * pi * s.f_B * slip + s.resync * s.K_s * v_dq.im,
                E_0=s.free * s.trim * (q_u - s.q_c) / (s.H * s.T_0),
            ),
            out=dict(i=i, v_dq=v_dq, error=v_dq.im, omega=1 + slip, E=E),
        )

    def rest(self, s: Any) -> dict[str, Any]:
        """Internal voltage at which the unlimited current draws the commanded power."""
        magnitude, angle = internal_voltage_at_rest(s.v, s.p_c, s.q_c, s.H, Phasor(s.R_v, s.X_v))
        return dict(p_f=s.p_c, q_f=s.q_c, delta=angle, E_0=magnitude)
