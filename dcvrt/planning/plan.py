"""What a hosting problem is asked (`Row`) and what it answers (`Plan`)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import inf, nan
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from dcvrt.planning.reactive import ReactiveExcess
from dcvrt.planning.security import SecurityInfo

if TYPE_CHECKING:
    import pandas as pd


SETTLED = 2e-3
"""Distance within which a plan takes the capacities of a simulated point, MW: the hosting programme itself
knows its optimum no better, as voltages agree with AC power flow to 1e-7 pu."""


@dataclass(frozen=True)
class Row:
    r"""A linear requirement, `lower` :math:`\le \sum_j (a_j H_j + c_j S_j) \le` `upper`.

    Parameters
    ----------
    coefficients : mapping of bus number to float
        a_j; sites that are not named have 0.
    lower : float
        Least value, in the unit of the requirement; minus infinity where there is none.
    label : str
        What reports call it, for instance "voltage at 75, fault 79, GFL, beta 1.15".
    site : int, optional
        The site whose facility the requirement is about. It holds only while that site is open (H > 0):
        a site without a facility has nothing that could fail. Without it the row always holds.
    unit : str
        Unit of the limits, for reports: "pu", "MW", "share of load"; empty where it has no name.
    upper : float
        Largest value. A limit on the aggregate loss of a fault is `Row(shares, -inf, label, upper=mw)`.
    rating : mapping of bus number to float
        c_j, of the converter ratings S_j in MVA; needs a `Rating` in `solve`.
    period, fault, mode, target : str
        What the requirement was made from; carried over to what binds.
    """

    coefficients: Mapping[int, float]
    lower: float
    label: str
    site: int | None = None
    unit: str = ""
    upper: float = inf
    rating: Mapping[int, float] = field(default_factory=dict)
    fault: str = ""
    mode: str = ""
    target: str = ""
    period: str = ""

    def value(self, by_site: Mapping[int, float], rating: Mapping[int, float] | None = None) -> float:
        """Distance to the nearer limit at given capacities and ratings: negative when violated."""
        left = sum(a * by_site[bus] for bus, a in self.coefficients.items())
        left += sum(c * (rating or {})[bus] for bus, c in self.rating.items())
        return min(left - self.lower, self.upper - left)


@dataclass(frozen=True)
class Binding:
    """A limit that keeps the plan from hosting more.

    Parameters
    ----------
    kind : str
        `line`, `generator`, `voltage`, `row`, `rating` or `bound`.
    label : str
        The line, the unit, the bus, the label of the row or the site.
    price : float
        Hosted MW gained per unit by which the limit is relaxed (0 where it binds without a price); with
        weights or a cost of ratings, what the objective gains. Of a `rating`: per MVA of converter that the
        site had more at the same capacity, by the rows that it helps to meet.
    unit : str
        Unit of the price.
    limit : float
        The limit itself: MVA, MW, pu, or the unit of the row.
    hour : int, optional
        Hour of the year.
    bus : int, optional
        Bus of a voltage, a unit or a site.
    outage : str
        Branch whose outage the limit of a line follows; empty for the intact network.
    period, fault, mode, target : str
        Those of the row; its period stands for the hour.
    """

    kind: str
    label: str
    price: float
    unit: str
    limit: float
    hour: int | None = None
    bus: int | None = None
    outage: str = ""
    fault: str = ""
    mode: str = ""
    target: str = ""
    period: str = ""

    def __str__(self) -> str:
        when = "" if self.hour is None else f" in hour {self.hour}"
        after = f" after the outage of {self.outage}" if self.outage else ""
        return f"{self.kind} {self.label}{after}{when}: {self.price:.4g} {self.unit}"


@dataclass(frozen=True)
class Certificate:
    """How each hour was shown to have a dispatch within all limits.

    Parameters
    ----------
    scaled : int
        Hours served by a known dispatch, scaled towards a limit of all units until it balances.
    programme : int
        Hours served by the dispatch of an own linear programme.
    combination : int
        Hours whose load, wind and data-centre factor are a convex combination of certified hours: the same
        combination of their dispatches serves them.
    tolerance_mw : float
        Largest violation of any limit that was let pass.
    """

    scaled: int
    programme: int
    combination: int
    tolerance_mw: float

    @property
    def hours(self) -> int:
        """Hours certified, by whatever method."""
        return self.scaled + self.programme + self.combination


@dataclass(frozen=True, eq=False)
class VoltageInfo:
    """How far the linear voltage screen can be trusted at the plan.

    Parameters
    ----------
    screen : str
        `one-shot` or `relinearised`.
    passes : int
        Linearisations after the first.
    guard_pu : float
        Guard band: hours in which a voltage was expected closer to a limit were solved by AC power flow.
    checked : int
        Number of hours solved, with the sample that the expectation rests on and the worst hour of each bus;
        with `one-shot` the hour with the least room alone.
    v_error_pu : float
        Largest difference between AC power flow and screen among the voltages within 5e-4 pu of a limit;
        in hours that were not solved, between what is expected and the screen.
    v_min_pu, v_max_pu : float
        Extremes of the AC voltages in them, at all buses whose voltage can move.
    widened : int
        Bus-hours outside the limits with nothing hosted, which must only not get worse.
    room : array (hours,)
        Least distance of a voltage to its limit in each hour as the screen has it, pu, at most 0.01.
    """

    screen: str
    passes: int
    guard_pu: float
    checked: int
    v_error_pu: float
    v_min_pu: float
    v_max_pu: float
    widened: int
    room: npt.NDArray[np.float64] = field(repr=False)


@dataclass(frozen=True, eq=False)
class Plan:
    """The largest capacities that meet every limit in every hour.

    Parameters
    ----------
    total_mw : float
    by_site : dict of bus number to float
        Hosted capacity H, MW.
    binding : tuple of Binding
        What keeps the total from growing, highest price first.
    closed : dict of bus number to str
        Sites without a facility, each with the reason.
    certificate : Certificate
    gap : float
        Bound on what a better choice of open sites could add, over the total; 0 without such a choice.
    voltage : VoltageInfo or None
        None when the problem has no voltage limits.
    rating_mva : dict of bus number to float
        Converter rating S of each site, MVA; empty unless ratings were part of the question.
    objective : float
        What was maximised: the weighted total less the cost of ratings, or the least size.
    security : SecurityInfo or None
        None without N-1 security.
    """

    total_mw: float
    by_site: dict[int, float]
    binding: tuple[Binding, ...]
    closed: dict[int, str]
    certificate: Certificate
    gap: float
    voltage: VoltageInfo | None
    rating_mva: dict[int, float] = field(default_factory=dict)
    objective: float = nan
    security: SecurityInfo | None = None

    def table(self) -> pd.DataFrame:
        """What binds, one row each."""
        import pandas as pd

        columns = ["kind", "label", "hour", "bus", "price", "unit", "limit"]
        columns += ["outage", "period", "fault", "mode", "target"]
        return pd.DataFrame([[getattr(b, c) for c in columns] for b in self.binding], columns=columns)


@dataclass(frozen=True)
class AcVerdict:
    """AC power flow of a plan in every hour.

    Parameters
    ----------
    passed : bool
        Solved in every hour, with every voltage that can move within the limits.
    v_min_pu, v_max_pu : float
        Extremes over these voltages and the hours that have a solution.
    v_error_pu : float
        Largest difference between AC and linear screen of the least distance to a limit, over the hours in
        which either puts it below 5e-4 pu; elsewhere no limit is near and the screen may be cruder.
    hour, bus : int or None
        Where the voltage is nearest to a limit, or farthest beyond it.
    status : str
        What came out of the voltages, then how far units are beyond their reactive limits.
    reactive, reactive_unhosted : ReactiveExcess or None
        Units beyond their reactive limits at the plan, and the same with nothing hosted: none with
        `reactive_limits`. `passed` says nothing about them. None when no hour has a solution.
    """

    passed: bool
    v_min_pu: float
    v_max_pu: float
    v_error_pu: float
    hour: int | None
    bus: int | None
    status: str
    reactive: ReactiveExcess | None = None
    reactive_unhosted: ReactiveExcess | None = None
