"""What grid-forming controls have in common: a voltage behind an impedance, and a command it can meet."""

from __future__ import annotations

import casadi as ca

from dcvrt.models import smooth
from dcvrt.models.phasor import Phasor, Scalar


def virtual_current(v_dq: Phasor, E: Scalar, H: Scalar, Z_v: Phasor) -> Phasor:
    """Import from `v_dq` to the internal voltage `E` on the d axis, through the impedance `Z_v` on base H."""
    return (v_dq - Phasor(E, 0.0)) * H / Z_v


def effective_command(p_c: Scalar, p: Scalar, shortfall: Scalar, resync: Scalar, width: Scalar) -> Scalar:
    """Active-power command that the control works with: `p_c`, or the power `p` where it has to give way.

    It is `p` while resynchronising (`resync` = 1), and where more active current is asked for than the limit
    grants (`shortfall` > 0) it falls to `p` if that is less than `p_c`. Paper: eq. (gfm_power_matching).
    """
    limited = smooth.step(shortfall, width)
    unmet = smooth.pos(p_c - p, width)
    return p_c + resync * (p - p_c) - (1 - resync) * limited * unmet


def internal_voltage_at_rest(
    v: Phasor, p: Scalar, q: Scalar, H: Scalar, Z_v: Phasor
) -> tuple[Scalar, Scalar]:
    """Magnitude and angle of the internal voltage at which the current draws `p` and `q` from `v`."""
    i = (Phasor(p, q) / v).conj()
    internal = v - i * Z_v / H
    return ca.sqrt(internal.abs2()), internal.angle()
