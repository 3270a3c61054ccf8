"""The model kit and the blocks of the facility: one file per role, equations in the docstrings."""

from dcvrt.models.automaton import Go, above, always, below, outside, within
from dcvrt.models.bess import Bess
from dcvrt.models.block import Algebraic, Block, Equations, Input, Output, Parameter, State
from dcvrt.models.cooling import Cooling
from dcvrt.models.current_lag import CurrentLag
from dcvrt.models.current_reference import CurrentReference
from dcvrt.models.dc_energy_loop import DcEnergyLoop
from dcvrt.models.dc_link import DcLink
from dcvrt.models.diagram import Diagram
from dcvrt.models.limiter import ActivePriorityLimiter
from dcvrt.models.loads import AuxiliaryLoad, FacilityLoad, ItLoad, ServerSupply
from dcvrt.models.phasor import Phasor
from dcvrt.models.pll import Pll
from dcvrt.models.poi import Poi, VoltageFilter
from dcvrt.models.protected_bus import ProtectedBus
from dcvrt.models.supervisor import Supervisor
from dcvrt.models.vsm import Vsm

__all__ = [
    "ActivePriorityLimiter",
    "Algebraic",
    "AuxiliaryLoad",
    "Bess",
    "Block",
    "Cooling",
    "CurrentLag",
    "CurrentReference",
    "DcEnergyLoop",
    "DcLink",
    "Diagram",
    "Equations",
    "FacilityLoad",
    "Go",
    "Input",
    "ItLoad",
    "Output",
    "Parameter",
    "Phasor",
    "Pll",
    "Poi",
    "ProtectedBus",
    "ServerSupply",
    "State",
    "Supervisor",
    "VoltageFilter",
    "Vsm",
    "above",
    "always",
    "below",
    "outside",
    "within",
]
