"""Faults that a grid is simulated under."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.sparse.csgraph import connected_components

from dcvrt.errors import InputError, raise_all
from dcvrt.grid.network import Network


@dataclass(frozen=True, eq=False)
class Stage:
    """A network that holds from one change to the next.

    Parameters
    ----------
    begin : float
        s.
    shunts : mapping of bus number to complex
        Admittance of faults, pu on the system base.
    out : frozenset of int
        Positions of open branches.
    """

    begin: float
    shunts: Mapping[int, complex] = field(default_factory=dict)
    out: frozenset[int] = frozenset()


@dataclass(frozen=True)
class BusFault:
    """Three-phase fault at a bus, cleared by itself or by opening a branch.

    Parameters
    ----------
    bus : int
        Bus number.
    start : float
        Inception, s; after 0.
    clear : float
        Time from inception to clearing, s.
    x_f, r_f : float
        Reactance and resistance to ground, pu on the system base.
    opens : (int, int), optional
        Ends of the branch that opens when the fault is cleared, and stays open; of parallel branches the
        first that is in service. None: the network is the same before and after.

    Raises
    ------
    InputError
        With every fault of the values at once.

    Examples
    --------
    >>> BusFault(23, start=1.0, clear=0.1).cleared_at
    1.1
    >>> BusFault(23, start=1.0, clear=0.1, opens=(23, 24)).label
    'bus 23, 100 ms, opens 23-24'
    """

    bus: int
    start: float = 0.1
    clear: float = 0.1
    x_f: float = 1e-4
    r_f: float = 0.0
    opens: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        problems = [
            f"{name} = {value} is not a finite number."
            for name, value in (
                ("start", self.start),
                ("clear", self.clear),
                ("x_f", self.x_f),
                ("r_f", self.r_f),
            )
            if not np.isfinite(value)
        ]
        if not problems:
            if self.start <= 0:
                problems.append(
                    f"start = {self.start:g} s must be after 0 s, where the simulation begins before the "
                    "fault."
                )
            if self.clear <= 0:
                problems.append(
                    f"clear = {self.clear:g} s: the fault would be cleared before it starts. `clear` is the "
                    "time from inception to clearing and must be positive."
                )
            if self.x_f < 0 or self.r_f < 0:
                problems.append(f"x_f = {self.x_f:g}, r_f = {self.r_f:g} pu: neither may be negative.")
            if self.x_f == 0 and self.r_f == 0:
                problems.append(
                    "x_f and r_f are both 0: the power balance at the bus has no solution in voltage "
                    "magnitude and angle. Way out: x_f = 1e-4 pu is a bolted fault for every purpose."
                )
        raise_all(problems, f"fault at bus {self.bus}")

    @property
    def cleared_at(self) -> float:
        """Time of clearing, s."""
        return self.start + self.clear

    def stages(self, network: Network, out: frozenset[int] = frozenset()) -> tuple[Stage, ...]:
        """The network before, in and after the fault, of which the branches `out` are open already.

        Raises
        ------
        InputError
            When no branch in service joins the two buses of `opens`.
        """
        shunt = {self.bus: 1.0 / complex(self.r_f, self.x_f)}
        opened = frozenset() if self.opens is None else frozenset({branch(network, *self.opens, out)})
        return Stage(0.0), Stage(self.start, shunt), Stage(self.cleared_at, {}, opened)

    @property
    def label(self) -> str:
        """What tables call it."""
        opened = "" if self.opens is None else f", opens {self.opens[0]}-{self.opens[1]}"
        return f"bus {self.bus}, {1e3 * self.clear:g} ms{opened}"


@dataclass(frozen=True)
class LineTrip:
    """A branch that opens without a fault, and closes again where a time is given.

    Parameters
    ----------
    from_bus, to_bus : int
        Its ends; of parallel branches the first that is in service opens.
    start : float
        s; after 0.
    reclose : float, optional
        Time from opening to closing, s.

    Raises
    ------
    InputError
        With every fault of the values at once.

    Examples
    --------
    >>> LineTrip(23, 24, start=1.0, reclose=0.5).label
    'line 23-24, 500 ms'
    """

    from_bus: int
    to_bus: int
    start: float = 0.1
    reclose: float | None = None

    def __post_init__(self) -> None:
        problems = []
        if not np.isfinite(self.start) or self.start <= 0:
            problems.append(f"start = {self.start} s must be after 0 s.")
        if self.reclose is not None and not 0 < self.reclose < np.inf:
            problems.append(f"reclose = {self.reclose} s is the time from opening to closing: above 0.")
        raise_all(problems, f"trip of line {self.from_bus}-{self.to_bus}")

    @property
    def bus(self) -> int:
        """The end that it is named by."""
        return self.from_bus

    @property
    def cleared_at(self) -> float:
        """Time of the last change, s."""
        return self.start + (self.reclose or 0.0)

    @property
    def label(self) -> str:
        """What tables call it."""
        name = f"line {self.from_bus}-{self.to_bus}"
        return name if self.reclose is None else f"{name}, {1e3 * self.reclose:g} ms"

    def stages(self, network: Network, out: frozenset[int] = frozenset()) -> tuple[Stage, ...]:
        """The network before and after, of which the branches `out` are open already.

        Raises
        ------
        InputError
            When no branch in service joins the two buses.
        """
        opened = Stage(self.start, {}, frozenset({branch(network, self.from_bus, self.to_bus, out)}))
        closed = () if self.reclose is None else (Stage(self.cleared_at),)
        return Stage(0.0), opened, *closed


@dataclass(frozen=True)
class FaultSequence:
    """Faults and line trips one after another: unsuccessful reclosing, a series of sags.

    Parameters
    ----------
    events : tuple of BusFault or LineTrip
        In the order of time, none starting before the one before it is cleared. A branch that is
        opened for good stays open.

    Raises
    ------
    InputError
        When two overlap, or there is none.

    Examples
    --------
    >>> shots = FaultSequence((BusFault(23, 0.1, 0.1), BusFault(23, 0.6, 0.1)))
    >>> shots.cleared_at
    0.7
    """

    events: tuple[BusFault | LineTrip, ...]

    def __post_init__(self) -> None:
        if not self.events:
            raise InputError("a sequence needs at least one fault.")
        problems = [
            f"{later.label} starts at {later.start:g} s, before {earlier.label} ends at "
            f"{earlier.cleared_at:g} s."
            for earlier, later in zip(self.events, self.events[1:], strict=False)
            if later.start <= earlier.cleared_at
        ]
        raise_all(problems, "sequence of faults")

    @property
    def bus(self) -> int:
        """The bus that the first is named by."""
        return self.events[0].bus

    @property
    def start(self) -> float:
        """Time of the first, s."""
        return self.events[0].start

    @property
    def cleared_at(self) -> float:
        """Time of the last change, s."""
        return self.events[-1].cleared_at

    @property
    def label(self) -> str:
        """What tables call it."""
        return " then ".join(event.label for event in self.events)

    def stages(self, network: Network) -> tuple[Stage, ...]:
        """The network from change to change."""
        found, out = [Stage(0.0)], frozenset[int]()
        for event in self.events:
            _, *own = event.stages(network, out)
            found += [Stage(stage.begin, stage.shunts, stage.out | out) for stage in own]
            out = found[-1].out
        return tuple(found)


Fault = BusFault | LineTrip | FaultSequence


def branch(network: Network, from_bus: int, to_bus: int, out: frozenset[int] = frozenset()) -> int:
    """Position of the first branch between two buses, in either direction, that is not among `out`.

    Raises
    ------
    InputError
        When there is none.
    """
    lines = network.branches
    ends = {from_bus, to_bus}
    for k in range(len(lines)):
        if k not in out and {int(lines.from_bus[k]), int(lines.to_bus[k])} == ends:
            return k
    if any({int(lines.from_bus[k]), int(lines.to_bus[k])} == ends for k in out):
        raise InputError(
            f"{network.name}: every branch that joins buses {from_bus} and {to_bus} is open already."
        )
    near = [
        lines.label(k) for k in range(len(lines)) if ends & {int(lines.from_bus[k]), int(lines.to_bus[k])}
    ]
    raise InputError(
        f"{network.name}: no branch joins buses {from_bus} and {to_bus}. Those at either end: "
        f"{', '.join(near) or 'none; check the bus numbers'}."
    )


def islands(network: Network, out: Sequence[int]) -> list[int]:
    """Buses that lose their path to the slack bus when branches are open."""
    keep = np.setdiff1d(np.arange(len(network.branches)), np.array(list(out), dtype=int))
    incidence = network.incidence[keep]
    _, island = connected_components(abs(incidence.T) @ abs(incidence), directed=False)
    return [int(b) for b in network.bus[island != island[network.slack]]]


def islanding(network: Network, stages: Sequence[Stage]) -> str:
    """What a stage cuts off by its open branches, as a sentence; empty when nothing."""
    for stage in stages:
        cut = islands(network, sorted(stage.out)) if stage.out else []
        if cut:
            lines = ", ".join(network.branches.label(k) for k in sorted(stage.out))
            shown = ", ".join(map(str, cut[:8])) + (", ..." if len(cut) > 8 else "")
            return f"with {lines} open, {len(cut)} bus(es) are islanded: {shown}. Islands are not simulated."
    return ""
