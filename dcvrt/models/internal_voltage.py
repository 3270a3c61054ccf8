"""What grid-forming controls have in common: a voltage behind an impedance, and a command it can meet."""

from __future__ import annotations

import casadi as ca

from dcvrt.models import smooth
from dcvrt.models.block import Block, Input, Output, Parameter
from dcvrt.models.phasor import Phasor, Scalar


class GridForming(Block):
    """Voltage source behind a virtual impedance; its subclasses say how the voltage moves."""

    H = Parameter(
        1.0, "pu(S)", (1e-6, 1e3), "hosted capacity, the base of the impedance", "decision of the planner"
    )
    R_v = Parameter(0.02, "pu(V)/pu(I)", (0.0, 0.5), "virtual resistance on H", "illustrative")
    X_v = Parameter(
        0.2, "pu(V)/pu(I)", (0.02, 1.0), "virtual reactance on H", "PSID test data; ANDES REGF1 xf"
    )
    f_B = Parameter(60.0, "Hz", (45.0, 65.0), "nominal frequency", "North American grid")
    E_min = Parameter(0.7, "pu(V)", (0.0, 1.0), "lowest internal voltage", "illustrative")
    E_max = Parameter(1.25, "pu(V)", (1.0, 2.0), "highest internal voltage", "illustrative")
    T_0 = Parameter(
        5.0, "s", (0.1, 600.0), "trim of the set point, per pu(S)/pu(V)",
        "own choice: far slower than a fault",
    )  # fmt: skip
    K_s = Parameter(30.0, "rad/s/pu(V)", (0.0, 500.0), "gain of the resynchronisation", "illustrative")
    eps = Parameter(2e-3, "1", (1e-6, 0.1), "width of the blends, over H", "own choice: numerics")

    v = Input("pu(V)", "POI voltage, network frame", kind=Phasor)
    p_c = Input("pu(S)", "active-power command")
    q_c = Input("pu(S)", "reactive-power command")
    p_g = Input("pu(S)", "active import achieved")
    q_g = Input("pu(S)", "reactive import achieved")
    shortfall = Input("pu(I)", "active current asked for beyond the limit")
    resync = Input("1", "1: align with the grid voltage, unloaded")
    trim = Input("1", "1: trim the voltage set point")
    i = Output("pu(I)", "current asked for, dq frame", kind=Phasor)
    v_dq = Output("pu(V)", "POI voltage, dq frame", kind=Phasor)
    error = Output("pu(V)", "voltage across the frame: 0 when aligned without load")


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
