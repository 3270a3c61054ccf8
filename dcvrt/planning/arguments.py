"""What can be wrong with the arguments of a hosting problem, all of it at once."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from dcvrt.errors import did_you_mean
from dcvrt.grid.network import Network
from dcvrt.planning.objective import Rating
from dcvrt.planning.plan import Row
from dcvrt.planning.profiles import Year

Floats = npt.NDArray[np.float64]

SCREENS = ("relinearised", "one-shot")
BASE_VIOLATIONS = ("error", "hold")


def argument_faults(
    network: Network,
    sites: tuple[int, ...],
    hours: Year,
    rating_scale: float,
    voltage: tuple[float, float] | None,
    pf: float,
    screen: str,
    base: str,
) -> list[str]:
    """What is wrong with the arguments of a hosting problem by themselves."""
    known = set(network.bus.tolist())
    problems = [
        f"site {bus!r} is not a bus of {network.name}.{did_you_mean(bus, network.bus)}"
        for bus in sites
        if bus not in known
    ]
    problems += [
        f"wind bus {bus} is not a bus of {network.name}.{did_you_mean(bus, network.bus)}"
        for bus in hours.wind
        if bus not in known
    ]
    if not sites:
        problems.append("needs at least one site.")
    problems += [
        f"site {bus} is listed more than once." for bus in sorted({b for b in sites if sites.count(b) > 1})
    ]
    if not 0 < rating_scale < np.inf:
        problems.append(f"rating_scale is {rating_scale:g}; it must be a finite number above 0.")
    if voltage is not None and not 0 < voltage[0] < voltage[1] < np.inf:
        problems.append(f"voltage limits {voltage[0]:g} to {voltage[1]:g} pu must be positive and ascending.")
    if not 0 < pf <= 1:
        problems.append(f"pf is {pf:g}; it must be above 0 and at most 1.")
    for name, value, choices in (
        ("voltage_screen", screen, SCREENS),
        ("base_violations", base, BASE_VIOLATIONS),
    ):
        if value not in choices:
            problems.append(f"{name} {value!r} is unknown.{did_you_mean(value, choices)}")
    return problems


def per_site(
    name: str, value: float | Mapping[int, float], sites: tuple[int, ...], problems: list[str]
) -> Floats:
    """A size for every site, from one number or a mapping that names all sites."""
    if isinstance(value, Mapping):
        problems += [
            f"{name} names {bus!r}, which is not a site.{did_you_mean(bus, sites)}"
            for bus in value
            if bus not in sites
        ]
        problems += [f"{name} says nothing about site {bus}." for bus in sites if bus not in value]
        sizes = np.array([float(value.get(bus, 0.0)) for bus in sites])
    else:
        sizes = np.full(len(sites), float(value))
    problems += [
        f"{name} of site {bus} is {mw:g} MW; it must be finite and not negative."
        for bus, mw in zip(sites, sizes, strict=True)
        if not 0 <= mw < np.inf
    ]
    return sizes


def hosting_faults(hosting: Mapping[int, float], sites: tuple[int, ...]) -> list[str]:
    """What is wrong with given capacities."""
    return [
        f"{bus!r} is not a site.{did_you_mean(bus, sites)}"
        if bus not in sites
        else f"the capacity of site {bus} is {mw:g} MW; it must be finite and not negative."
        for bus, mw in hosting.items()
        if bus not in sites or not 0 <= mw < np.inf
    ]


def unit_faults(network: Network, hours: Year) -> list[str]:
    """Units with limits of their own in some hours that are unknown, or whose limits cross."""
    units = network.generators
    place = {name: k for k, name in enumerate(units.name)}
    problems = []
    for name in {**hours.p_min, **hours.p_max}:
        if name not in place:
            problems.append(f"unit {name!r} is not in {network.name}.{did_you_mean(name, units.name)}")
            continue
        low = hours.p_min.get(name, np.full(len(hours), units.p_min[place[name]]))
        high = hours.p_max.get(name, np.full(len(hours), units.p_max[place[name]]))
        crossed = np.flatnonzero(low > high)
        if len(crossed):
            k = crossed[0]
            problems.append(
                f"unit {name} has p_min {low[k]:g} MW above p_max {high[k]:g} MW in hour {hours.hours[k]}"
                + (f" ({len(crossed)} hours in all)." if len(crossed) > 1 else ".")
            )
    return problems


def row_faults(rows: tuple[Row, ...], sites: tuple[int, ...], rating: Rating | None) -> list[str]:
    """What is wrong with requirement rows."""
    problems = []
    for row in rows:
        named = [*row.coefficients, *row.rating, *([] if row.site is None else [row.site])]
        problems += [
            f"row {row.label!r} names {bus!r}, which is not a site.{did_you_mean(bus, sites)}"
            for bus in dict.fromkeys(named)
            if bus not in sites
        ]
        values = [*row.coefficients.values(), *row.rating.values()]
        limits = [limit for limit in (row.lower, row.upper) if np.isnan(limit) or np.isfinite(limit)]
        if not limits or not np.isfinite([*limits, *values]).all() or row.lower > row.upper:
            problems.append(f"row {row.label!r} has a coefficient or a limit that is not finite.")
        if row.rating and rating is None:
            problems.append(
                f"row {row.label!r} contains converter ratings, but none are asked for. "
                "Way out: solve(..., rating=Rating(...))."
            )
    return problems
