"""What stands in a unit for a control that it does not have: a constant."""

from __future__ import annotations

from typing import Any

from dcvrt.models.block import Equations, Output, Parameter
from dcvrt.models.machines.parts import UnitBlock


class FixedField(UnitBlock):
    r"""No exciter: the field voltage, or the internal voltage of a classical machine, is a set-point.

    .. math::
        V_f = V_{f0}

    Equilibrium: any value; the initialisation finds the one that belongs to the power flow.
    """

    v_f0 = Parameter(
        1.0, "pu(V)", (-100.0, 100.0), "field voltage: the set-point", "found by the initialisation"
    )

    v_f = Output("pu(V)", "field voltage")

    def equations(self, s: Any) -> Equations:
        return Equations(out=dict(v_f=s.v_f0))


class FixedPower(UnitBlock):
    r"""No governor: the mechanical torque is a set-point.

    .. math::
        T_m = P_{ref}

    Equilibrium: any value; the initialisation finds the one that belongs to the power flow.
    """

    p_ref = Parameter(
        0.0, "pu(S)", (-1e4, 1e4), "mechanical torque: the set-point", "found by the initialisation"
    )

    t_m = Output("pu(S)", "mechanical torque")
    p_set = Output("pu(S)", "the set-point")

    def equations(self, s: Any) -> Equations:
        return Equations(out=dict(t_m=s.p_ref, p_set=s.p_ref))


class NoStabiliser(UnitBlock):
    r"""No stabiliser: nothing is added to the input of the exciter.

    .. math::
        V_s = 0

    Equilibrium: always.
    """

    v_s = Output("pu(V)", "signal for the exciter")

    def equations(self, s: Any) -> Equations:
        return Equations(out=dict(v_s=0.0))
