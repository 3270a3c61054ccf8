"""Networks, power flow and fault simulation: where POI waveforms come from."""

from dcvrt.grid.faults import BusFault
from dcvrt.grid.grid import FaultRun, Grid
from dcvrt.grid.network import Network
from dcvrt.grid.period import Period

__all__ = ["BusFault", "FaultRun", "Grid", "Network", "Period"]
