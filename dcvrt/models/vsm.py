"""Virtual synchronous machine of the grid-forming UPS."""

from __future__ import annotations

from math import pi
from typing import Any

from dcvrt.models import smooth
from dcvrt.models.block import Equations, Parameter, State
from dcvrt.models.internal_voltage import (
    GridForming,
    effective_command,
    internal_voltage_at_rest,
    virtual_current,
)
from dcvrt.models.phasor import Phasor


class Vsm(GridForming):
    r"""Voltage source behind a virtual impedance whose angle obeys a swing equation.

    .. math::
        I^u = \frac{V - E e^{j\delta}}{Z_v}, \qquad Z_v = \frac{R_v + j X_v}{H}

    .. math::
        2 H_v \dot\omega = \frac{P^g - P^{eff}}{H} - D (\omega - 1), \qquad
        \dot\delta = \omega_B (\omega - 1) + u, \qquad
        u = s K_s \operatorname{Im}\{V e^{-j\delta}\}

    .. math::
        P^{eff} = P^c + s\,(P^g - P^c) - (1 - s)\, m\, [P^c - P^g]_+, \qquad
        m = \operatorname{step}(i_p^u - I_{max})

    .. math::
        \tau_E \dot E = \operatorname{sat}_{[E_{min}, E_{max}]}\!
            \left(E_0 + K_Q \frac{Q^g - Q^c}{H}\right) - E, \qquad
        T_0 \dot E_0 = h\, \frac{Q^u - Q^c}{H}

    Import positive, hence the sign of the swing equation. `delta` is the angle to the network frame at
    :math:`\omega_0`, the dq frame of the current. s is the supervisor's resync flag, m tells that more active
    current is asked for than the limit grants, h is 1 in NORMAL; Q^u is the reactive power of I^u.
    Paper: eqs. (gfm_internal_voltage)-(gfm_power_matching); the limiter and the current lag are blocks.
    Equilibrium: omega = 1, P_g = P_c, Q_u = Q_c: the state in which the grid-following mode rests as well.
    Differs: the paper's hard switch of power matching is a blend, and matches only a command that cannot be
    met (P_c > P_g at the limit); matching the other way would hold an import that nobody wants.
    Differs: u_sync is words in the paper; here it turns the source onto the grid voltage while uncoupled.
    Differs: the voltage set point E_0 is trimmed slowly to the reactive command in NORMAL, as an operator
    would set it; without it the two modes would start from different operating points.
    """

    H_v = Parameter(
        0.075, "s", (0.01, 10.0), "virtual inertia", "as a droop with a 5 ms power filter, ANDES REGF1"
    )
    D = Parameter(
        30.0, "1", (0.0, 500.0), "damping: power over frequency", "as a droop of 0.033, ANDES REGF1"
    )
    K_Q = Parameter(0.05, "pu(V)/pu(S)", (0.0, 1.0), "reactive droop over H", "ANDES REGF1: 0.045")
    tau_E = Parameter(0.05, "s", (1e-3, 1.0), "lag of the voltage magnitude", "illustrative")

    omega = State(1.0, "1", "internal frequency over the nominal one")
    delta = State(0.0, "rad", "angle of the internal voltage")
    E = State(1.0, "pu(V)", "magnitude of the internal voltage")
    E_0 = State(1.0, "pu(V)", "set point of the magnitude")

    def equations(self, s: Any) -> Equations:
        v_dq = s.v.turn(-s.delta)
        i = virtual_current(v_dq, s.E, s.H, Phasor(s.R_v, s.X_v))
        q_u = (v_dq * i.conj()).im
        p_eff = effective_command(s.p_c, s.p_g, s.shortfall, s.resync, s.eps * s.H)
        droop = s.E_0 + s.K_Q * (s.q_g - s.q_c) / s.H
        omega_B = 2 * pi * s.f_B
        return Equations(
            der=dict(
                omega=((s.p_g - p_eff) / s.H - s.D * (s.omega - 1)) / (2 * s.H_v),
                delta=omega_B * (s.omega - 1) + s.resync * s.K_s * v_dq.im,
                E=(smooth.sat(droop, s.E_min, s.E_max, s.eps) - s.E) / s.tau_E,
                E_0=s.trim * (q_u - s.q_c) / (s.H * s.T_0),
            ),
            out=dict(i=i, v_dq=v_dq, error=v_dq.im),
        )

    def rest(self, s: Any) -> dict[str, Any]:
        """Internal voltage at which the unlimited current draws the commanded power."""
        magnitude, angle = internal_voltage_at_rest(s.v, s.p_c, s.q_c, s.H, Phasor(s.R_v, s.X_v))
        return dict(omega=1.0, delta=angle, E=magnitude, E_0=magnitude)
