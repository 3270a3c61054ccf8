"""Whether the facility models take what the study sets for them: each value within its bounds, and all
together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from dcvrt import facility as variants
from dcvrt.errors import DcvrtError

if TYPE_CHECKING:
    from dcvrt.grid.network import Network
    from dcvrt.planning.profiles import Year


def outside_ranges(sections: Mapping[str, Any], year: Year | None, network: Network | None) -> list[str]:
    """Ratings, power factor and data-centre factors outside the bounds of the variants' `beta`, `pf` and `d`.

    The data-centre factor is that of the hours that faults are simulated in; in all other hours a data
    centre is a load of the network alone.
    """
    facility, hosting = sections.get("facility"), sections.get("hosting")
    if facility is None:
        return []
    given = [(f"facility.beta[{k}]", "beta", beta) for k, beta in enumerate(facility.beta, start=1)]
    if hosting is not None:
        given.append(("hosting.pf", "pf", hosting.pf))
    if year is not None:
        given += [
            (f"period[{k}]: the data-centre factor of hour {hour}", "d", year.at(hour).dc)
            for k, hour in _hours(sections.get("period", ()), year, network)
        ]
    shared = {mode: variants.get(mode).shared for mode in facility.modes if mode in variants.names()}
    problems = []
    for path, name, value in given:
        bounds = {mode: own[name].declared.bounds for mode, own in shared.items() if name in own}
        narrow = [mode for mode, (low, high) in bounds.items() if not low <= value <= high]
        if narrow:
            low, high = max(bounds[m][0] for m in narrow), min(bounds[m][1] for m in narrow)
            problems.append(
                f"{path} = {value:g}: is outside [{low:g}, {high:g}], which parameter {name} of "
                f"{' and '.join(narrow)} may have."
            )
    return problems


def _hours(periods: Sequence[Any], year: Year, network: Network | None) -> list[tuple[int, int]]:
    """Number and hour of each period whose hour can be told."""
    chosen: Mapping[str, int] = {}
    if network is not None and not set(year.wind) - set(network.bus.tolist()):
        chosen = year.representative(network)
    known = set(year.hours.tolist())
    hours = [(k, chosen.get(p.hour, p.hour)) for k, p in enumerate(periods, start=1)]
    return [(k, hour) for k, hour in hours if hour in known]


def do_not_go_together(table: str, mode: str, values: Mapping[str, float]) -> list[str]:
    """Values that are each within bounds and of which no system can be made, such as thresholds without
    hysteresis."""
    problem = _problem_of(mode, tuple(sorted(values.items())))
    return [f"{table}: {problem}"] if problem else []


@lru_cache(maxsize=256)
def _problem_of(mode: str, values: tuple[tuple[str, float], ...]) -> str:
    diagram = variants.get(mode)
    try:
        for path, value in values:
            diagram.set(path, value)
        diagram.compile()
    except DcvrtError as error:
        head, *more = map(str.strip, str(error).splitlines())
        return f"{head}: {' '.join(more)}" if more else head
    return ""
