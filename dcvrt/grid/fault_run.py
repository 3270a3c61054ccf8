"""What one fault at one operating point gave."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from dcvrt.errors import SimulationError
from dcvrt.grid.faults import Fault
from dcvrt.waveform import Waveform


@dataclass(frozen=True, eq=False)
class FaultRun(Mapping[int, Waveform]):
    """One fault at one operating point: bus -> waveform, or the sentence on why there is none.

    Parameters
    ----------
    fault : BusFault, LineTrip or FaultSequence
    waveforms : mapping of bus to Waveform
        Empty when the simulation did not reach its end.
    status : str
        How it ended.
    """

    fault: Fault
    waveforms: Mapping[int, Waveform]
    status: str

    @property
    def completed(self) -> bool:
        """Whether the simulation reached its end."""
        return bool(self.waveforms)

    def require(self) -> FaultRun:
        """Return itself, or raise `SimulationError` with `status`."""
        if not self.completed:
            raise SimulationError(self.status)
        return self

    def __getitem__(self, bus: int) -> Waveform:
        return self.require().waveforms[bus]

    def __iter__(self) -> Iterator[int]:
        return iter(self.waveforms)

    def __len__(self) -> int:
        return len(self.waveforms)
