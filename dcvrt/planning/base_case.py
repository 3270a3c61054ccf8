"""Why nothing can be hosted: the hours of the base case without a dispatch, where, and by how much."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dcvrt.planning.certificate import Hours
from dcvrt.planning.hour import INTACT, Dispatched, LineWeight
from dcvrt.planning.profiles import in_ranges

Integers = npt.NDArray[np.int64]

PROGRAMMES = 300
"""Dispatch programmes spent on finding the hours that are short, and as many on finding the worst of them."""
NAMED = 4
"""Branches of the worst hour that are named, and of the other hours."""


@dataclass(frozen=True, eq=False)
class ShortHours:
    """Hours without a dispatch with nothing hosted.

    Attributes
    ----------
    at : positions of the hours, ascending.
    all_seen : whether every hour was looked at; if not, there may be more.
    solved : the dispatch of those that were solved one by one, the worst first.
    worst_known : whether the worst hour is among them for certain.
    """

    at: Integers
    all_seen: bool
    solved: dict[int, Dispatched]
    worst_known: bool


def short_hours(hours: Hours) -> ShortHours:
    """Find the hours without a dispatch, and the worst of them.

    The dual of one short hour proves others short, and the dispatch of one that is not serves others. How
    much is short is convex in the parameters of the hour, so that the worst hour is a corner of their hull.
    """
    every = hours.all_hours()
    nothing = np.zeros(len(hours.sites))
    demand = -every.fixed.sum(axis=0)
    todo = np.argsort(-demand, kind="stable")
    least = np.zeros(len(hours.year))
    solved: dict[int, Dispatched] = {}
    spent = 0
    while len(todo) and spent < PROGRAMMES:
        at, todo = int(todo[0]), todo[1:]
        found = every.dispatch(nothing, at)
        spent += 1
        if found.cut is not None and found.shortfall > every.tolerance:
            solved[at], least[at] = found, found.shortfall
            least[todo] = np.maximum(least[todo], every.shortfall(found.cut, todo))
            todo = todo[least[todo] <= every.tolerance]
        else:
            todo = todo[~every.served_like(found, at, todo)]
    short = np.flatnonzero(least > every.tolerance)
    rest = np.setdiff1d(np.intersect1d(short, hours.corners), list(solved))
    rest = rest[np.argsort(-least[rest], kind="stable")]
    solved |= {at: every.dispatch(nothing, at) for at in rest[:PROGRAMMES].tolist()}
    ranked = sorted(solved, key=lambda at: -solved[at].shortfall)
    return ShortHours(
        short,
        not len(todo),
        {at: solved[at] for at in ranked},
        not len(todo) and len(rest) <= PROGRAMMES,
    )


def base_case(hours: Hours, rating_scale: float) -> str:
    """Say which hours have no dispatch with nothing hosted, where, and by how much."""
    network, year = hours.network, hours.year
    short = short_hours(hours)
    at, worst = next(iter(short.solved.items()))
    assert worst.cut is not None
    count = f"{'' if short.all_seen else 'at least '}{len(short.at)} of {len(year)} hours"
    ways = []
    if worst.cut.lines:
        named = sorted(worst.cut.lines, key=lambda line: -line.weight)[:NAMED]
        cause = f"branches are overloaded by {worst.shortfall:.4g} MW whatever the dispatch: " + ", ".join(
            _rated(hours, line) for line in named
        )
        ways.append(f"a larger rating_scale (now {rating_scale:g})")
        rule = hours.outages.rule
        if rule is not None and any(line.outage != INTACT for line in named):
            ways.append(f"a larger factor on ratings after an outage (now {rule.emergency:g})")
        ways.append("more generation behind these branches")
    else:
        low, high = hours.unit_limits(at)
        demand = -hours.fixed[:, at].sum()
        cause = (
            f"units that give {low.sum():.5g} to {high.sum():.5g} MW cannot meet a net load "
            f"of {demand:.5g} MW ({worst.shortfall:.4g} MW off)"
        )
        ways.append("more units, or other limits of theirs")
    lead = "Worst hour" if short.worst_known else f"Worst of {len(short.solved)} hours solved, hour"
    return (
        f"{network.name}: the base case has no dispatch in {count} "
        f"(hours {in_ranges(year.hours[short.at])}) with nothing hosted.\n"
        f"  {lead} {int(year.hours[at])}: {cause}.\n{_elsewhere(hours, short)}"
        f"Ways out: {', or '.join([', '.join(ways[:-1]), ways[-1]] if ways[:-1] else ways)}, "
        "or leave these hours out."
    )


def _rated(hours: Hours, line: LineWeight) -> str:
    """A branch with what it may carry, and after which outage."""
    lines = hours.network.branches
    after = "" if line.outage == INTACT else f" after the outage of {lines.label(line.outage)}"
    return f"{lines.label(line.branch)} (rated {hours.limit(line):.4g} MVA{after})"


def _elsewhere(hours: Hours, short: ShortHours) -> str:
    """Branches that are short in other hours than the worst, each with the hour in which they are most."""
    label, year = hours.network.branches.label, hours.year
    worst, *others = short.solved.items()
    named = {line.branch for line in worst[1].cut.lines} if worst[1].cut is not None else set()
    said: dict[int, str] = {}
    for at, found in others:
        for line in () if found.cut is None else found.cut.lines:
            if line.branch not in named:
                text = (
                    f"{label(line.branch)} (with others by {found.shortfall:.4g} MW in hour {year.hours[at]})"
                )
                said.setdefault(line.branch, text)
    if not said:
        return ""
    more = f", and {len(said) - NAMED} more" if len(said) > NAMED else ""
    return f"  In other hours: {', '.join(list(said.values())[:NAMED])}{more}.\n"
