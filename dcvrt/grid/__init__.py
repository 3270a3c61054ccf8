"""Networks, power flow and fault simulation: where POI waveforms come from."""

from dcvrt.grid.fault_run import FaultRun
from dcvrt.grid.faults import BusFault, FaultSequence, LineTrip
from dcvrt.grid.grid import Grid
from dcvrt.grid.network import Network
from dcvrt.grid.period import Period
from dcvrt.grid.screening import FaultScreen, screen_faults

__all__ = [
    "BusFault",
    "FaultRun",
    "FaultScreen",
    "FaultSequence",
    "Grid",
    "LineTrip",
    "Network",
    "Period",
    "screen_faults",
]
