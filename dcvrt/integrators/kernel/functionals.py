"""Functionals as the driver takes them, and its results as outcomes; the layout is that of functionals.h."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dcvrt.functionals import (
    Functional,
    Initial,
    Integral,
    Maximum,
    Minimum,
    Outcome,
    RecoveryTime,
    SustainedMaximum,
    SustainedMinimum,
    TimeAbove,
    TimeBelow,
)

Array = NDArray[np.float64]

KINDS: dict[type[Functional], int] = {
    Initial: 0,
    Minimum: 1,
    Maximum: 2,
    SustainedMinimum: 3,
    SustainedMaximum: 4,
    TimeBelow: 5,
    TimeAbove: 6,
    Integral: 7,
    RecoveryTime: 9,
}
POSITIVE_INTEGRAL = 8
PLACES = ("extremum", "event", "jump", "end", "window", "")
"""What makes a result active, by the driver's `enum place`."""
ROW = np.dtype(
    [(name, "i4") for name in ("kind", "signal", "per", "relative", "value_only")] + [("constant", "f8")],
    align=True,
)
"""`struct functional`."""


def watched(functionals: Mapping[str, Functional]) -> tuple[str, ...]:
    """Outputs that functionals read, each once."""
    return tuple(dict.fromkeys(signal for f in functionals.values() for signal in f.signals))


def row_of(
    functional: Functional, signals: Sequence[str], value_only: bool
) -> tuple[int, int, int, int, bool, float]:
    """One functional over these watched outputs, as a `struct functional`."""
    kind, constant, relative = KINDS[type(functional)], 0.0, False
    if isinstance(functional, SustainedMinimum):
        constant = functional.window
    elif isinstance(functional, TimeBelow):
        relative = functional.share is not None
        given = functional.share if relative else functional.level
        constant = float(given if given is not None else np.nan)
    elif isinstance(functional, Integral) and functional.positive:
        kind = POSITIVE_INTEGRAL
    per = signals.index(functional.per) if functional.per is not None else -1
    return kind, signals.index(functional.signal), per, int(relative), value_only, constant


@dataclass(frozen=True, eq=False)
class Table:
    """Functionals in the order in which the driver computes them: neighbours share a signal.

    Attributes
    ----------
    names : of the functionals.
    signals : watched outputs, whose positions `rows` refers to.
    rows : one `struct functional` each, of dtype `ROW`.
    """

    names: tuple[str, ...]
    signals: tuple[str, ...]
    rows: NDArray[np.void]

    @classmethod
    def of(
        cls,
        functionals: Mapping[str, Functional],
        signals: Sequence[str] | None = None,
        values_only: Collection[str] = (),
    ) -> Table:
        """Table over watched outputs: those that the functionals read unless given.

        `values_only` names the functionals whose gradient is not wanted.
        """
        signals = watched(functionals) if signals is None else tuple(signals)
        names = sorted(
            functionals, key=lambda n: (functionals[n].signal, functionals[n].per or "", functionals[n].sign)
        )
        rows = np.array([row_of(functionals[n], signals, n in values_only) for n in names], dtype=ROW)
        return cls(tuple(names), signals, rows)

    def __len__(self) -> int:
        return len(self.names)

    def results(self, cases: int, nw: int) -> Results:
        """Room for the results of a number of cases."""
        n = len(self)
        return Results(
            np.full((cases, n), np.nan),
            np.full((cases, n), np.nan),
            np.full((cases, n, nw), np.nan),
            np.full((cases, n), len(PLACES) - 1, dtype=np.uint8),
            np.zeros((cases, n), dtype=np.uint8),
        )


@dataclass(frozen=True, eq=False)
class Results:
    """What the driver writes: (cases, functionals) each, gradients with a last axis of thetas times scale.

    The five are, in this order, the members of `struct functional_results`, one case after the other.
    """

    value: Array
    time: Array
    gradient: Array
    place: NDArray[np.uint8]
    tie: NDArray[np.uint8]

    def outcomes(self, table: Table, wrt: Sequence[str], scale: Array) -> Iterator[dict[str, Outcome]]:
        """Functionals of every case by name, derivatives by the thetas themselves."""
        places = np.array(PLACES, dtype=object)[self.place]
        columns = (self.value, self.time, places, self.tie.astype(bool))
        gradients = (self.gradient / scale).tolist() if len(wrt) else itertools.repeat([()] * len(table))
        rows = zip(*(column.tolist() for column in columns), gradients, strict=False)
        for values, times, kinds, ties, slopes in rows:
            grads = [dict(zip(wrt, slope, strict=True)) if wrt else {} for slope in slopes]
            outcomes = map(Outcome, values, grads, times, kinds, ties)
            yield dict(zip(table.names, outcomes, strict=True))
