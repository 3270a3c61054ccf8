"""What is asked of a hosting problem, checked."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from dcvrt.errors import did_you_mean, raise_all
from dcvrt.planning.arguments import row_faults
from dcvrt.planning.master import Master
from dcvrt.planning.objective import MaxMin, MaxTotal, Objective, Rating
from dcvrt.planning.plan import Row

Floats = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Question:
    """What is asked of a hosting problem, checked; see `HostingProblem.solve`."""

    sites: tuple[int, ...]
    lower: Floats
    upper: Floats
    rows: tuple[Row, ...]
    objective: Objective
    rating: Rating | None
    must_open: Flags

    @property
    def shares(self) -> Floats:
        """Share of each site in the least size; 0 where it does not count."""
        return np.where(self.upper > 0, self.objective.vector(self.sites), 0.0)

    def with_floor(self, least: float) -> Question:
        """The largest total at which no site is smaller than its share of a least size, MW.

        The floor is lower by a part in 1e8, so that rounding does not exclude the plan it was found at.
        """
        floor = self.shares * max(least, 0.0) * (1 - 1e-8)
        return replace(
            self,
            lower=np.maximum(self.lower, floor),
            objective=MaxTotal(),
            must_open=self.must_open | (floor > 0),
        )

    def master(self) -> Master:
        """The master programme without cuts."""
        return Master(
            self.sites, self.lower, self.upper, self.rows, self.objective, self.rating, self.must_open
        )


def ask(
    sites: tuple[int, ...],
    lower: Floats,
    upper: Floats,
    rows: Iterable[Row],
    bounds: Mapping[int, tuple[float, float]],
    objective: Objective | None,
    rating: Rating | None,
    must_open: Sequence[int],
) -> Question:
    """Check what is asked of sites with given sizes.

    Raises
    ------
    InputError
        Everything that is wrong with the bounds, the rows, or objective, ratings and sites that must be open.
    """
    rows = tuple(rows)
    objective = MaxTotal() if objective is None else objective
    lower, upper, outside = _within(bounds, sites, lower, upper)
    wanted = objective.faults(sites) + ([] if rating is None else rating.faults())
    wanted += [
        f"must_open names {bus!r}, which is not a site.{did_you_mean(bus, sites)}"
        for bus in must_open
        if bus not in sites
    ]
    if isinstance(objective, MaxMin) and not wanted and not (objective.vector(sites)[upper > 0] > 0).any():
        wanted.append("no site counts in the least size: each has share 0, or a largest size of 0 MW.")
    found = {"bounds": outside, "requirement rows": row_faults(rows, sites, rating), "objective": wanted}
    wrong = {part: problems for part, problems in found.items() if problems}
    if len(wrong) > 1:
        raise_all([f"{part}: {line}" for part, lines in wrong.items() for line in lines], "hosting problem")
    for part, problems in wrong.items():
        raise_all(problems, part)
    forced = np.array([bus in set(must_open) for bus in sites])
    return Question(sites, lower, upper, rows, objective, rating, forced)


def _within(
    bounds: Mapping[int, tuple[float, float]], sites: tuple[int, ...], least: Floats, largest: Floats
) -> tuple[Floats, Floats, list[str]]:
    """Sizes of the sites, narrowed to the ranges given to some of them, and what is wrong with these."""
    lower, upper = least.copy(), largest.copy()
    problems: list[str] = []
    for bus, (low, high) in bounds.items():
        if bus not in sites:
            problems.append(f"{bus!r} is not a site.{did_you_mean(bus, sites)}")
        elif not 0 <= low <= high < np.inf:
            problems.append(
                f"the range of site {bus} is {low:g} to {high:g} MW; it must be ascending and not negative."
            )
        else:
            i = sites.index(bus)
            lower[i], upper[i] = max(lower[i], low), min(upper[i], high)
            if low == 0.0 and high < least[i]:
                lower[i] = upper[i] = 0.0
            if lower[i] > upper[i]:
                problems.append(
                    f"the range of site {bus}, {low:g} to {high:g} MW, has nothing in common with "
                    f"its sizes {least[i]:g} to {largest[i]:g} MW."
                )
    return lower, upper, problems
