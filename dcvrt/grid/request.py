"""What a fault simulation is asked for, and everything that is wrong with it, at once."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from dcvrt.dae import Dae
from dcvrt.errors import InputError, did_you_mean, raise_all
from dcvrt.grid.faults import BusFault, Fault, FaultSequence, LineTrip, branch
from dcvrt.grid.native.engine import RATING, thetas
from dcvrt.grid.period import Period
from dcvrt.models import Diagram

if TYPE_CHECKING:
    from dcvrt.grid.grid import Grid

ENGINES = ("native", "andes")


@dataclass(frozen=True, eq=False)
class Request:
    """Faults of one operating point of a grid; the fields are the arguments of `Grid.waveforms_of`."""

    hosting: Mapping[int, float]
    period: Period
    faults: Sequence[Fault]
    until: float
    engine: str
    step: float
    wrt: Sequence[str]
    facilities: Mapping[int, Diagram | Dae]
    values: Mapping[str, float]

    def check(self, grid: Grid) -> None:
        """Raise `InputError` with everything that is wrong, before anything runs."""
        of_engine = self._of_andes(grid) if self.engine == "andes" else self._of_native(grid)
        problems = [
            *self._of_numbers(),
            *of_engine,
            *self._of_facilities(grid),
            *self._of_hosting(grid),
            *self._of_faults(grid),
        ]
        raise_all(problems, grid.name)

    def _of_numbers(self) -> list[str]:
        problems = []
        if self.engine not in ENGINES:
            problems.append(f"engine = {self.engine!r} is not known.{did_you_mean(self.engine, ENGINES)}")
        if not np.isfinite(self.until):
            problems.append(f"until = {self.until} s is not a finite number.")
        if not 0 < self.step <= 0.05:
            problems.append(f"step = {self.step} s must be above 0 and at most 0.05 s.")
        return problems

    def _of_andes(self, grid: Grid) -> list[str]:
        """What ANDES cannot do."""
        problems = []
        if self.wrt:
            problems.append("wrt: ANDES gives no derivatives. Way out: engine='native'.")
        if self.facilities:
            problems.append("facilities: ANDES has no model of them. Way out: engine='native'.")
        if grid.load_model or grid.wind_model:
            problems.append(
                "load_model, wind_model: engine='andes' has loads and wind as impedances. Way out: "
                "engine='native'."
            )
        return problems

    def _of_native(self, grid: Grid) -> list[str]:
        return _problems(grid, thetas, self.wrt, grid.sites, grid.network)

    def _of_facilities(self, grid: Grid) -> list[str]:
        problems = [
            f"facilities: bus {bus} is not a candidate site.{did_you_mean(bus, grid.sites)}"
            for bus in self.facilities
            if bus not in grid.sites
        ]
        problems += [
            f"facilities: {type(one).__name__} at bus {bus} is no diagram. Way out: facility.gfl() and "
            "its like."
            for bus, one in self.facilities.items()
            if self.engine == "native" and not isinstance(one, Diagram | Dae)
        ]
        if not self.facilities:
            problems += [f"values: {path!r}: there are no facilities." for path in self.values]
            if RATING in self.wrt:
                problems.append(f"wrt: {RATING!r}: there are no facilities that it could rate.")
        return problems

    def _of_hosting(self, grid: Grid) -> list[str]:
        problems = []
        for bus, mw in self.hosting.items():
            if bus not in grid.sites:
                problems.append(f"hosting at bus {bus}: not a candidate site.{did_you_mean(bus, grid.sites)}")
            if not np.isfinite(mw) or mw < 0:
                problems.append(f"hosting at bus {bus} = {mw} MW must be a number of at least 0.")
        return problems + [f"wind: {line}" for line in grid.unknown(list(self.period.wind))]

    def _of_faults(self, grid: Grid) -> list[str]:
        problems = [] if self.faults else ["faults is empty: at least one fault is needed."]
        for fault in dict.fromkeys(self.faults):
            events = fault.events if isinstance(fault, FaultSequence) else (fault,)
            found = [line for event in events for line in self._of_event(grid, event)]
            if isinstance(fault, FaultSequence) and not found:
                found += _problems(grid, fault.stages, grid.network)
            problems += found
            if self.until <= fault.cleared_at:
                problems.append(
                    f"fault at {fault.label}: until = {self.until:g} s ends before it is cleared at "
                    f"{fault.cleared_at:g} s."
                )
        return problems

    @staticmethod
    def _of_event(grid: Grid, event: BusFault | LineTrip) -> list[str]:
        if isinstance(event, LineTrip):
            return _problems(grid, branch, grid.network, event.from_bus, event.to_bus)
        problems = [f"fault: {line}" for line in grid.unknown([event.bus])]
        if event.opens is not None:
            problems += _problems(grid, branch, grid.network, *event.opens)
        if event.bus in grid.sites:
            problems.append(
                f"fault at bus {event.bus}: it is a candidate site, and no site rides through a fault at "
                "its own bus. Way out: a fault at a neighbouring bus."
            )
        return problems


def _problems(grid: Grid, check: Callable[..., object], *given: object) -> list[str]:
    """What a check that raises `InputError` says, as a list without the name of the grid."""
    try:
        check(*given)
    except InputError as error:
        first, *others = str(error).splitlines()
        return [line.strip() for line in others] or [first.removeprefix(f"{grid.network.name}: ")]
    return []
