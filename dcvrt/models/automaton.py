"""Modes as a table: guards, rows, and the checks that a table must pass before anything runs.

A block that switches declares its modes, the flags that each mode sets, and a method `transitions` that
returns rows :class:`Go`, tried from top to bottom. The equations read the flags as numbers, so that they
hold no branch; everything discrete stays in the table, where it can be read, checked and drawn.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import casadi as ca

from dcvrt.dae import Gap
from dcvrt.errors import did_you_mean
from dcvrt.models.expressions import text_of
from dcvrt.models.phasor import Phasor, Scalar


@dataclass(frozen=True)
class Comparison:
    """`signal` strictly above (`side` = 1) or below (`side` = -1) `limit`."""

    signal: Scalar
    limit: Scalar
    side: int

    def __post_init__(self) -> None:
        for value in (self.signal, self.limit):
            if isinstance(value, Phasor):
                raise TypeError("a Phasor is neither above nor below a limit")

    @property
    def margin(self) -> Scalar:
        return self.side * (self.signal - self.limit)

    def __str__(self) -> str:
        return f"{text_of(self.signal)} {'>' if self.side > 0 else '<'} {text_of(self.limit)}"


@dataclass(frozen=True)
class Guard:
    """A condition in alternative form: true when in one of `cases` every comparison holds.

    Guards are joined with ``&`` and ``|``. `margin` is positive exactly while the guard is true.
    """

    cases: tuple[tuple[Comparison, ...], ...]

    @property
    def margin(self) -> Scalar:
        """Largest over the cases of the smallest margin in each; 1 for a guard that is always true."""
        worst_in_case = []
        for case in self.cases:
            worst: Scalar = 1.0
            for k, comparison in enumerate(case):
                worst = comparison.margin if k == 0 else ca.fmin(worst, comparison.margin)
            worst_in_case.append(worst)
        best = worst_in_case[0]
        for margin in worst_in_case[1:]:
            best = ca.fmax(best, margin)
        return best

    def __or__(self, other: Guard) -> Guard:
        return Guard(self.cases + other.cases)

    def __and__(self, other: Guard) -> Guard:
        return Guard(tuple(mine + yours for mine, yours in itertools.product(self.cases, other.cases)))

    def __bool__(self) -> bool:
        raise TypeError("a guard is neither true nor false while the table is written")

    def __str__(self) -> str:
        return " or ".join(" and ".join(map(str, case)) if case else "always" for case in self.cases)


def below(signal: Scalar, limit: Scalar) -> Guard:
    """True while signal < limit."""
    return Guard(((Comparison(signal, limit, -1),),))


def above(signal: Scalar, limit: Scalar) -> Guard:
    """True while signal > limit."""
    return Guard(((Comparison(signal, limit, 1),),))


def within(signal: Scalar, low: Scalar, high: Scalar) -> Guard:
    """True while low < signal < high."""
    return above(signal, low) & below(signal, high)


def outside(signal: Scalar, low: Scalar, high: Scalar) -> Guard:
    """True while signal < low or signal > high."""
    return below(signal, low) | above(signal, high)


def always() -> Guard:
    """True at all times: with `held`, a timer that starts on entry of the mode."""
    return Guard(((),))


@dataclass(frozen=True)
class Go:
    """Row of a table: from `source` to `target` once `when` has been true for longer than `held` (s).

    `reset` gives states of the block the value they jump to; all others are continuous. `settles` says, in
    words, why the row and its opposite cannot chatter where their limits leave no gap, as those of a limiter
    whose output is continuous over the limit.
    """

    source: str
    target: str
    when: Guard
    held: Scalar = 0
    reset: Mapping[str, Scalar] = field(default_factory=dict)
    settles: str = ""

    def __post_init__(self) -> None:
        if not isinstance(self.when, Guard):
            raise TypeError(f"{self.source} -> {self.target}: {self.when} is no guard")

    def __str__(self) -> str:
        timed = "" if text_of(self.held) == "0" else f" held {text_of(self.held)}"
        return f"{self.source} -> {self.target}: {self.when}{timed}"


def check_table(modes: Sequence[str], start: str, rows: Sequence[Go]) -> list[str]:
    """Problems of a table of modes: unknown, unreachable and dead-end modes."""
    if not isinstance(rows, tuple | list) or not all(isinstance(row, Go) for row in rows):
        return ["transitions() must return a tuple of rows: (Go('OFF', 'ON', guard), ...)."]
    if start not in modes:
        return [f"the start mode {start!r} is not one of its modes.{did_you_mean(start, modes)}"]
    problems = [
        f"{row.source} -> {row.target}: there is no mode {mode!r}.{did_you_mean(mode, modes)}"
        for row in rows
        for mode in (row.source, row.target)
        if mode not in modes
    ]
    if problems:
        return problems
    reached, front = {start}, [start]
    while front:
        here = front.pop()
        new = {row.target for row in rows if row.source == here} - reached
        reached |= new
        front += sorted(new)
    unreached = [mode for mode in modes if mode not in reached]
    stuck = [mode for mode in modes if not any(row.source == mode for row in rows)]
    if unreached:
        problems.append(
            f"mode(s) never entered from {start}: {', '.join(unreached)}. "
            "Add a row that leads there or drop the mode."
        )
    if stuck:
        problems.append(f"mode(s) without a way out: {', '.join(stuck)}. Add a row that leaves them.")
    return problems


def gaps(
    rows: Sequence[Go], settle: Callable[[Scalar], ca.SX | None], states: Mapping[str, ca.SX] | None = None
) -> list[Gap]:
    """Pairs of rows A -> B and B -> A, with the distance that their limits must keep for them not to chatter.

    In every combination of their cases some signal must not be able to satisfy both. Timers (a guard that is
    always true) are left out: their dwell time separates the jumps. `settle` puts an expression in terms of
    the parameters, or gives None where it varies in time: such a distance cannot be told before a run, and is
    left to the guard against chatter in the run.

    Two kinds of pairs need no distance: those of which both rows say why they settle, and those in which a
    reset sets a signal of a guard to its own limit, as a state that is put on the limit it ran into: the
    guard is then false, and stays so unless the state moves outwards again.
    """
    found = []
    symbols = states or {}

    def undone(case: tuple[Comparison, ...], row: Go) -> bool:
        """Whether a guard is false once the states of a row have been reset."""
        known = [key for key in row.reset if key in symbols]
        if not known:
            return False
        own, values = ca.vertcat(*[symbols[k] for k in known]), ca.vertcat(*[row.reset[k] for k in known])
        margins = [ca.substitute(ca.SX(c.margin), own, ca.SX(values)) for c in case]
        return any(bool(ca.simplify(margin).is_zero()) for margin in margins)

    for there, back in itertools.combinations(rows, 2):
        opposite = (there.source, there.target) == (back.target, back.source)
        if not opposite or () in there.when.cases + back.when.cases:
            continue
        if there.settles and back.settles:
            continue
        for one, other in itertools.product(there.when.cases, back.when.cases):
            if any(undone(case, row) for case in (one, other) for row in (there, back)):
                continue
            against = [
                (a, b)
                for a, b in itertools.product(one, other)
                if str(a.signal) == str(b.signal) and a.side != b.side
            ]
            distances = [settle(a.side * (a.limit - b.limit)) for a, b in against]
            known = [distance for distance in distances if distance is not None]
            if len(known) < len(distances):
                continue
            width = ca.SX(-1)  # for guards on different signals, which can be true together
            for k, distance in enumerate(known):
                width = ca.fmax(width, distance) if k else distance
            involved = [c for pair in against for c in pair] or [*one, *other]
            limits = {text_of(c.limit): settled for c in involved if (settled := settle(c.limit)) is not None}
            found.append(Gap((str(there), str(back)), width, tuple(limits.items())))
    return found
