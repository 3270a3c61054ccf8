"""What a plan maximises, and what converter ratings cost."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from dcvrt.errors import did_you_mean

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class MaxTotal:
    r"""The largest weighted total, :math:`\max \sum_i w_i H_i`.

    Parameters
    ----------
    weights : mapping of bus number to float
        w_i, worth of a MW at a site; sites that are not named have 1.
    """

    weights: Mapping[int, float] = field(default_factory=dict)

    def vector(self, sites: Sequence[int]) -> Floats:
        """Weights in the order of the sites."""
        return np.array([float(self.weights.get(bus, 1.0)) for bus in sites])

    def faults(self, sites: Sequence[int]) -> list[str]:
        """What is wrong with these for some sites, as sentences."""
        return _faults("weight", self.weights, sites)


@dataclass(frozen=True)
class MaxMin:
    r"""The largest least size, :math:`\max \min_i H_i / w_i`, and then the largest total that keeps it.

    Parameters
    ----------
    shares : mapping of bus number to float
        w_i, size that a site is meant to have relative to the others; sites that are not named have 1, and
        a site with 0, or whose largest size is 0, does not count.
    """

    shares: Mapping[int, float] = field(default_factory=dict)

    def vector(self, sites: Sequence[int]) -> Floats:
        """Shares in the order of the sites."""
        return np.array([float(self.shares.get(bus, 1.0)) for bus in sites])

    def faults(self, sites: Sequence[int]) -> list[str]:
        """What is wrong with these for some sites, as sentences."""
        return _faults("share", self.shares, sites)


Objective = MaxTotal | MaxMin


@dataclass(frozen=True)
class Rating:
    r"""Converter ratings as unknowns, :math:`\underline\beta H_i \le S_i \le \overline\beta H_i`, at a cost.

    The objective then is :math:`\sum_i w_i H_i - c \sum_i S_i`. Rows in H and S keep the programme linear, so
    that siting and rating are decided together. `low == high` fixes the rating ratio.

    Parameters
    ----------
    low, high : float
        Range of S over H, MVA per MW.
    cost : float
        c, hosted MW that an MVA of converter must earn.
    """

    low: float = 1.0
    high: float = 1.5
    cost: float = 0.0

    def faults(self) -> list[str]:
        """What is wrong with it, as sentences."""
        problems = []
        if not 0 <= self.low <= self.high < np.inf:
            problems.append(
                f"rating ratios are {self.low:g} to {self.high:g}; they must be ascending and not negative."
            )
        if not 0 <= self.cost < np.inf:
            problems.append(f"cost of ratings is {self.cost:g}; it must be finite and not negative.")
        return problems


def _faults(what: str, values: Mapping[int, float], sites: Sequence[int]) -> list[str]:
    problems = [
        f"{what} names {bus!r}, which is not a site.{did_you_mean(bus, sites)}"
        for bus in values
        if bus not in sites
    ]
    problems += [
        f"{what} of site {bus} is {value:g}; it must be finite and not negative."
        for bus, value in values.items()
        if not 0 <= value < np.inf
    ]
    return problems
