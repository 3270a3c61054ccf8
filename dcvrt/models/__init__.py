"""The model kit and the blocks of the facility: one file per role, equations in the docstrings."""

from dcvrt.models.ac_load import AcBus, AcLoad
from dcvrt.models.automaton import Go, above, always, below, outside, within
from dcvrt.models.bess import Bess, BessWithLosses
from dcvrt.models.block import Algebraic, Block, Equations, Input, Output, Parameter, State
from dcvrt.models.command import given, withdrawn
from dcvrt.models.cooling import Cooling
from dcvrt.models.cooling_contactor import ContactorCooling
from dcvrt.models.cooling_drive import DriveCooling
from dcvrt.models.cooling_split import SplitCooling
from dcvrt.models.current_lag import CurrentLag
from dcvrt.models.current_reference import CurrentReference
from dcvrt.models.dc_energy_loop import DcEnergyLoop
from dcvrt.models.dc_link import DcLink
from dcvrt.models.diagram import Diagram
from dcvrt.models.droop import Droop
from dcvrt.models.eco_mode import EcoModeControl, Rectifier
from dcvrt.models.feeder import Feeder
from dcvrt.models.hold_up_supply import HoldUpSupply
from dcvrt.models.ledger import EnergyLedger, StandbyLedger, SupplyLedger, UpsAndDriveLedger, UpsLedger
from dcvrt.models.limiter import ActivePriorityLimiter, ReactivePriorityLimiter
from dcvrt.models.line_interactive import LineConditioner, LineInteractiveControl, ParallelConverter
from dcvrt.models.loads import AuxiliaryLoad, FacilityLoad, ItLoad, ServerSupply, SplitFacilityLoad
from dcvrt.models.phasor import Phasor
from dcvrt.models.pll import Pll
from dcvrt.models.poi import Poi, SharedPoi, VoltageFilter
from dcvrt.models.protected_bus import ProtectedBus
from dcvrt.models.reactive_support import ReactiveSupport
from dcvrt.models.sag_counter import SagCounter
from dcvrt.models.static_switch import StaticSwitch
from dcvrt.models.supervisor import Supervisor, SupervisorWithLockout
from dcvrt.models.training_load import TrainingLoad
from dcvrt.models.ups_battery import NoBattery, UpsBattery
from dcvrt.models.ups_inverter import UpsInverter
from dcvrt.models.vsm import Vsm
from dcvrt.models.walk_in import WalkIn

__all__ = [
    "AcBus",
    "AcLoad",
    "ActivePriorityLimiter",
    "Algebraic",
    "AuxiliaryLoad",
    "Bess",
    "BessWithLosses",
    "Block",
    "ContactorCooling",
    "Cooling",
    "CurrentLag",
    "CurrentReference",
    "DcEnergyLoop",
    "DcLink",
    "Diagram",
    "DriveCooling",
    "Droop",
    "EcoModeControl",
    "EnergyLedger",
    "Equations",
    "FacilityLoad",
    "Feeder",
    "Go",
    "HoldUpSupply",
    "Input",
    "ItLoad",
    "LineConditioner",
    "LineInteractiveControl",
    "NoBattery",
    "Output",
    "ParallelConverter",
    "Parameter",
    "Phasor",
    "Pll",
    "Poi",
    "ProtectedBus",
    "ReactivePriorityLimiter",
    "ReactiveSupport",
    "Rectifier",
    "SagCounter",
    "ServerSupply",
    "SharedPoi",
    "SplitCooling",
    "SplitFacilityLoad",
    "StandbyLedger",
    "State",
    "StaticSwitch",
    "Supervisor",
    "SupervisorWithLockout",
    "SupplyLedger",
    "TrainingLoad",
    "UpsAndDriveLedger",
    "UpsBattery",
    "UpsInverter",
    "UpsLedger",
    "VoltageFilter",
    "Vsm",
    "WalkIn",
    "above",
    "always",
    "below",
    "given",
    "outside",
    "withdrawn",
    "within",
]
