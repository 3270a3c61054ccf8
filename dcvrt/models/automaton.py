"""Modes as a table: guards, rows, and the checks that a table must pass before anything runs.

A block that switches declares its modes, the flags that each mode sets, and a method `transitions` that
returns rows :class:`Go`, tried from top to bottom. The equations read the flags as numbers, so that they
hold no branch; everything discrete stays in the table, where it can be read, checked and drawn.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from math import inf

import casadi as ca

from dcvrt.errors import did_you_mean
from dcvrt.models.phasor import Scalar


@dataclass(frozen=True)
class Comparison:
    """`signal` strictly above (`side` = 1) or below (`side` = -1) `limit`."""

    signal: Scalar
    limit: Scalar
    side: int

    @property
    def margin(self) -> Scalar:
        return self.side * (self.signal - self.limit)

    def __str__(self) -> str:
        return f"{self.signal} {'>' if self.side > 0 else '<'} {self.limit}"


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

    `reset` gives states of the block the value they jump to; all others are continuous.
    """

    source: str
    target: str
    when: Guard
    held: Scalar = 0
    reset: Mapping[str, Scalar] = field(default_factory=dict)

    def __str__(self) -> str:
        timed = "" if str(self.held) == "0" else f" held {self.held}"
        return f"{self.source} -> {self.target}: {self.when}{timed}"


def check_table(modes: Sequence[str], start: str, rows: Sequence[Go]) -> list[str]:
    """Problems of a table of modes: unknown, unreachable and dead-end modes."""
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


Box = dict[str, tuple[float, float]]


def check_hysteresis(rows: Sequence[Go], value: Callable[[Scalar], float]) -> list[str]:
    """Problems of pairs of rows A -> B and B -> A whose guards can be true, or touch, at the same values.

    Such a pair chatters. `value` gives the number of a limit at the parameters' present values. Timers
    (a guard that is always true) are left out: their dwell time separates the jumps.
    """

    def boxes(guard: Guard) -> list[Box]:
        found = []
        for case in guard.cases:
            box: Box = {}
            for c in case:
                low, high = box.get(str(c.signal), (-inf, inf))
                limit = value(c.limit)
                box[str(c.signal)] = (max(low, limit), high) if c.side > 0 else (low, min(high, limit))
            found.append(box)
        return found

    def apart(one: Box, other: Box) -> bool:
        return any(
            one[signal][0] > other[signal][1] or other[signal][0] > one[signal][1]
            for signal in one.keys() & other.keys()
        )

    problems = []
    for there, back in itertools.combinations(rows, 2):
        if (there.source, there.target) != (
            back.target,
            back.source,
        ) or () in there.when.cases + back.when.cases:
            continue
        if not all(apart(a, b) for a in boxes(there.when) for b in boxes(back.when)):
            limits = {
                str(c.limit): value(c.limit) for row in (there, back) for case in row.when.cases for c in case
            }
            values = ", ".join(f"{name} = {number:g}" for name, number in limits.items())
            problems.append(
                f"'{there}' and '{back}' leave no gap between them ({values}): the modes would chatter. "
                "Set the limit of the way back beyond that of the way out."
            )
    return problems
