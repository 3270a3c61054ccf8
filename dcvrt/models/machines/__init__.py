"""Generating units: synchronous machines, exciters, governors, stabilisers, one file per model."""

from dcvrt.models.machines.converter import CurrentConverter
from dcvrt.models.machines.esst3a import CompoundSource, Esst3aField, Esst3aRegulator, esst3a
from dcvrt.models.machines.exdc2 import Exdc2, Ieeex1, Ieeex1BusFed
from dcvrt.models.machines.exst1 import Exst1
from dcvrt.models.machines.fixed import FixedField, FixedPower, NoStabiliser
from dcvrt.models.machines.frequency import BusFrequency
from dcvrt.models.machines.gencls import GenCls
from dcvrt.models.machines.genrou import GenRou
from dcvrt.models.machines.ieeeg1 import Ieeeg1
from dcvrt.models.machines.ieeest import Ieeest, IeeestWithWindow
from dcvrt.models.machines.ieeet1 import Ieeet1
from dcvrt.models.machines.parts import UNLIMITED, UnitBlock, quadratic
from dcvrt.models.machines.sexs import Sexs
from dcvrt.models.machines.st2cut import St2Cut
from dcvrt.models.machines.static_load import ExponentialLoad, StaticLoad, ZipLoad
from dcvrt.models.machines.tgov1 import Tgov1, Tgov1N
from dcvrt.models.machines.unit import alone, setpoints, structure, unit

__all__ = [
    "UNLIMITED",
    "BusFrequency",
    "CompoundSource",
    "CurrentConverter",
    "Esst3aField",
    "Esst3aRegulator",
    "Exdc2",
    "ExponentialLoad",
    "Exst1",
    "FixedField",
    "FixedPower",
    "GenCls",
    "GenRou",
    "Ieeeg1",
    "Ieeest",
    "IeeestWithWindow",
    "Ieeet1",
    "Ieeex1",
    "Ieeex1BusFed",
    "NoStabiliser",
    "Sexs",
    "St2Cut",
    "StaticLoad",
    "Tgov1",
    "Tgov1N",
    "UnitBlock",
    "ZipLoad",
    "alone",
    "esst3a",
    "quadratic",
    "setpoints",
    "structure",
    "unit",
]
