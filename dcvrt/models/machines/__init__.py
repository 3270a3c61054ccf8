"""Generating units: synchronous machines, exciters, governors, stabilisers, one file per model."""

from dcvrt.models.machines.fixed import FixedField, FixedPower, NoStabiliser
from dcvrt.models.machines.gencls import GenCls
from dcvrt.models.machines.genrou import GenRou
from dcvrt.models.machines.parts import UnitBlock, quadratic
from dcvrt.models.machines.sexs import Sexs
from dcvrt.models.machines.tgov1 import Tgov1
from dcvrt.models.machines.unit import setpoints, structure, unit

__all__ = [
    "FixedField",
    "FixedPower",
    "GenCls",
    "GenRou",
    "NoStabiliser",
    "Sexs",
    "Tgov1",
    "UnitBlock",
    "quadratic",
    "setpoints",
    "structure",
    "unit",
]
