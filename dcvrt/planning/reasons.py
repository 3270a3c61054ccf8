"""Why a site is closed, and why there is no plan at all."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from dcvrt.errors import InfeasibleError
from dcvrt.planning.master import Master
from dcvrt.planning.objective import MaxMin
from dcvrt.planning.plan import Binding
from dcvrt.planning.question import Question

if TYPE_CHECKING:
    from dcvrt.planning.hosting import HostingProblem

SHORT = 1e-7
"""Violation of a requirement row below which it is not missed, in its unit."""
NAMED = 3
"""Limits that are named at most."""


def named(limits: Iterable[Binding]) -> str:
    """Limits by kind, label and hour, the first few."""
    listed = [f"{b.kind} {b.label}" + ("" if b.hour is None else f" in hour {b.hour}") for b in limits]
    return ", ".join(listed[:NAMED])


def why_closed(
    problem: HostingProblem,
    master: Master,
    site: int,
    by_site: dict[int, float],
    rating: dict[int, float],
    in_the_way: Iterable[Binding],
) -> str:
    """Why a site hosts nothing: a requirement that opening it would break, its sizes, or what it would take
    from others.

    Parameters
    ----------
    site : position of the site.
    by_site, rating : capacities and converter ratings of the plan.
    in_the_way : limits with a price that hosting here would lean on.
    """
    bus, low = master.sites[site], float(master.lower[site])
    opened = {**by_site, bus: low}
    own = [(row.value(opened, rating), row) for row in master.rows if row.site == bus]
    broken = sorted(((room, row) for room, row in own if room < 0), key=lambda found: found[0])
    if broken:
        others = len(broken) - 1
        more = f", and {others} more margin{'s' * (others > 1)} fall{'s' * (others == 1)} short"
        room, worst = broken[0]
        short = f": {-room:.4g} {worst.unit}".rstrip() + f" short at {low:g} MW beside the other sites"
        said = short if any([*worst.coefficients.values(), *worst.rating.values()]) else ""
        return f"{worst.label}{said}{more if others else ''}"
    if master.upper[site] == 0:
        least, largest = problem.lower[site], problem.upper[site]
        if largest == 0:
            return "its largest size is 0 MW"
        sizes = f"none of its sizes, {least:g} to {largest:g} MW" if least > 0 else "no size above 0 MW"
        return f"the range given to it holds {sizes}"
    if low > 0 and (most := problem.largest(bus)) < low:
        return (
            f"its smallest size is {low:g} MW, but the limits leave it at most {most:.4g} MW whatever the "
            "other sites host"
        )
    return f"hosting here gains nothing within the shared limits ({named(in_the_way) or 'the other sites'})"


def refuse_sizes(problem: HostingProblem, question: Question) -> None:
    """Raise when no site has a size that the network allows: nothing is a plan then, not even nothing.

    Raises
    ------
    InfeasibleError
        With the smallest size of each site, and the largest that fits.
    """
    wanted = [
        (bus, float(low))
        for bus, low, high in zip(question.sites, question.lower, question.upper, strict=True)
        if high > 0
    ]
    if not wanted or any(low <= problem.largest(bus) for bus, low in wanted):
        return
    lines = "".join(
        f"\n  site {bus}: at least {low:g} MW, at most {problem.largest(bus):.4g} MW fit whatever the others "
        "host"
        for bus, low in wanted
    )
    raise InfeasibleError(
        f"{problem.network.name}: no site can be opened, as the smallest sizes exceed the limits.{lines}\n"
        "Ways out: smaller min_size, or wider limits."
    )


def why_none(problem: HostingProblem, question: Question, master: Master) -> str:
    """Why no plan exists: smallest sizes, or the requirement rows."""
    forced = question.must_open & (question.lower > 0)
    if forced.any():
        sizes = {
            bus: float(mw) for bus, mw, f in zip(question.sites, question.lower, forced, strict=True) if f
        }
        free = replace(
            question,
            lower=np.where(forced, 0.0, question.lower),
            objective=MaxMin({bus: sizes.get(bus, 0.0) for bus in question.sites}),
        )
        try:
            most = problem.optimum(free)
        except InfeasibleError:
            return _rows_exclude_all(master)
        listed = ", ".join(f"{mw:g} MW at {bus}" for bus, mw in sizes.items())
        return (
            f"The smallest sizes of the sites that must be open exceed the limits: {listed}. At most "
            f"{100 * most.objective:.1f} % of them fit together, by {named(most.binding)}. Ways out: smaller "
            "sizes, or let a site close."
        )
    return _rows_exclude_all(master)


def _rows_exclude_all(master: Master) -> str:
    """Which of the rows that hold for every plan exclude every one, and by how much."""
    general = [row for row, holds in zip(master.rows, master.always, strict=True) if holds]
    forced = [bus for bus, must in zip(master.sites, master.must_open, strict=True) if must]
    missed: npt.NDArray[np.float64] | None = master.least_violations()
    if missed is None or not (missed > SHORT).any():
        listed = ", ".join(row.label for row in general[:6]) + (", ..." if len(general) > 6 else "")
        found = f"Rows that hold for every plan: {listed or 'none'}."
    else:
        worst = np.argsort(-missed)
        parts = [
            f"{master.rows[r].label} ({missed[r]:.4g} {master.rows[r].unit}".rstrip() + " short at least)"
            for r in worst[:6].tolist()
            if missed[r] > SHORT
        ]
        found = f"Missed: {', '.join(parts)}."
    others = "every other site" if forced else "every site"
    return (
        f"No capacities meet all requirement rows, not even with {others} closed. {found} "
        "Ways out: give a row the site that it belongs to, so that the site can be closed, "
        + (f"let site {', '.join(map(str, forced))} be closed, " if forced else "")
        + "or relax its limit."
    )
