"""Feasibility of every hour at given capacities: a dispatch for each, or a cut that forbids them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dcvrt.grid.network import Network
from dcvrt.planning.hour import INTACT, Dispatched, FlowCut, HourDispatch, LineWeight
from dcvrt.planning.plan import Certificate
from dcvrt.planning.profiles import Year
from dcvrt.planning.security import N1, Outages

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

TOLERANCE_MW = 1e-6
"""Violation that is let pass, MW."""
TOLERANCE_SHARE = 1e-10
"""The same over the largest demand, where that is more: below it a dispatch programme can't tell."""
KNOWN_DISPATCHES = 60
IDLE = 10
"""Known dispatches in a row that serve no hour before programmes are solved."""
BLOCK = 2_000_000
"""Flows looked at together, so that large networks stay small in memory."""
HULL_FROM = 1000
"""Hours from which the convex hull is worth its computation."""
HULL_DIMENSIONS = 6
"""Parameters up to which the hull has far fewer vertices than there are hours."""


def corner_hours(year: Year) -> Integers:
    r"""Hours whose operating parameters are vertices of the convex hull of all.

    For fixed capacities the injections are affine in load factor, wind and data-centre factor, and the set of
    injections and unit limits that have a dispatch is convex. If the vertices have one, so has every hour:
    the same convex combination of dispatches. All hours are returned where the hull does not pay or cannot be
    computed.

    Returns
    -------
    int array
        Positions in `year`, ascending.
    """
    everything = np.arange(len(year))
    if len(year) < HULL_FROM:
        return everything
    points = np.column_stack(
        [year.load, *year.wind.values(), *year.p_min.values(), *year.p_max.values(), year.dc]
    )
    points = points - points.mean(axis=0)
    size = abs(points).max(axis=0)
    points = points[:, size > 0] / size[size > 0]
    if not points.shape[1]:
        return everything[:1]
    left, singular, _ = np.linalg.svd(points, full_matrices=False)
    coordinates = left[:, singular > 1e-10 * singular[0]]
    if coordinates.shape[1] == 1:
        return np.unique([coordinates[:, 0].argmin(), coordinates[:, 0].argmax()])
    if coordinates.shape[1] > HULL_DIMENSIONS:
        return everything
    from scipy.spatial import ConvexHull, QhullError

    try:
        return np.sort(ConvexHull(coordinates).vertices).astype(np.int64)
    except QhullError:  # flat up to rounding: all hours are the safe answer
        return everything


class Hours:
    """The operating hours as bus injections, and how each is certified.

    Parameters
    ----------
    network : Network
        With the ratings that hold in the study.
    sites : int array
        Bus positions of the sites.
    year : Year
    hull : bool
        Whether to look at `corner_hours` only.
    rule : N1 or None
        Outages that every hour must survive.
    """

    def __init__(
        self, network: Network, sites: Integers, year: Year, hull: bool = True, rule: N1 | None = None
    ) -> None:
        self.network, self.sites, self.year = network, sites, year
        self.outages = Outages(network, rule)
        self.dispatcher = HourDispatch(network, self.outages)
        fixed = -np.outer(network.p_load, year.load) - network.g_shunt[:, None]
        for bus, mw in year.wind.items():
            fixed[network.index(bus)] += mw
        self.fixed = fixed
        """Injections without units and sites, MW, (buses, hours)."""
        self.corners = corner_hours(year) if hull else np.arange(len(year))
        self.unit_ranges = UnitRanges(network, year)
        self._flow = network.flows(fixed[:, self.corners])
        self._demand = -fixed[:, self.corners].sum(axis=0)
        self._dc = year.dc[self.corners]
        at_site = np.zeros((len(network.bus), len(sites)))
        at_site[sites, np.arange(len(sites))] = 1.0
        self._site_flow = network.transfer(at_site)
        low, high = self.unit_ranges.limits(self.corners)
        room = (high - low).sum(axis=0).mean()
        share = (self._demand.mean() - low.sum(axis=0).mean()) / max(room, 1e-9)
        self._known = [_Known(np.full(len(network.generators), float(np.clip(share, 0.0, 1.0))))]
        self._watched = np.zeros(0, dtype=np.int64)
        self._failed: dict[int, None] = {}
        self.tolerance = max(TOLERANCE_MW, TOLERANCE_SHARE * float(self._demand.max(initial=0.0)))
        """Violation of any limit that is let pass, MW."""
        self.certificate = Certificate(0, 0, 0, self.tolerance)

    def bound(self, cut: FlowCut, hours: Integers | None = None) -> Floats:
        """Right-hand side of `-pi_C . H <= b` that a cut gives in each corner hour, MW of hosted load."""
        at = self.corners if hours is None else hours
        return -self.shortfall(cut, at) / self.year.dc[at]

    def shortfall(self, cut: FlowCut, hours: Integers) -> Floats:
        """Least shortfall that a cut proves for the hours at the given positions with nothing hosted, MW."""
        reduced = cut.pi[self.network.generator_index]
        low, high = self.unit_ranges.limits(hours)
        return (
            cut.pi @ self.fixed[:, hours]
            + cut.constant
            + np.maximum(reduced, 0.0) @ low
            + np.minimum(reduced, 0.0) @ high
        )

    def limit(self, line: LineWeight) -> float:
        """Limit of a branch, MVA, before or after an outage."""
        rating = self.network.branches.rating if line.outage == INTACT else self.outages.rating
        return float(rating[line.branch])

    def unit_limits(self, hour: int) -> tuple[Floats, Floats]:
        """Limits of the units at position `hour`, MW."""
        low, high = self.unit_ranges.limits(np.array([hour]))
        return low[:, 0], high[:, 0]

    def injection(self, H: Floats, hour: int) -> Floats:
        """Bus injections without units at position `hour`, MW."""
        injection = self.fixed[:, hour].copy()
        np.add.at(injection, self.sites, -self.year.dc[hour] * H)
        return injection

    def dispatch(self, H: Floats, hour: int) -> Dispatched:
        """Dispatch the hour at position `hour`."""
        return self.dispatcher.solve(self.injection(H, hour), *self.unit_limits(hour))

    def all_hours(self) -> Hours:
        """The same with every hour a corner."""
        return Hours(self.network, self.sites, self.year, False, self.outages.rule)

    def served_like(self, found: Dispatched, hour: int, at: Integers) -> Flags:
        """Which corner hours the dispatch of the hour at a position serves, too, with nothing hosted."""
        return self._serves(self._remember(found.units, hour), np.zeros(len(self.sites)), at)

    def certify(self, H: Floats) -> FlowCut | None:
        """Show that every hour has a dispatch at `H`, or return a cut that `H` violates."""
        todo = np.arange(len(self.corners))
        scaled = programme = 0
        idle = 0
        for known in reversed(self._known.copy()):
            served = self._serves(known, H, todo)
            idle = 0 if served.any() else idle + 1
            if served.any():  # to the front of the next search
                self._known.remove(known)
                self._known.append(known)
            scaled += int(served.sum())
            todo = todo[~served]
            if not len(todo) or idle > IDLE:
                break
        todo = todo[np.argsort(-self._demand[todo] - H.sum() * self._dc[todo], kind="stable")]
        suspect = np.isin(todo, list(self._failed))
        todo = np.r_[todo[suspect], todo[~suspect]]
        while len(todo):
            first, todo = int(todo[0]), todo[1:]
            found = self.dispatch(H, int(self.corners[first]))
            known = self._remember(found.units, int(self.corners[first]))
            if found.shortfall > self.tolerance:
                assert found.cut is not None
                self._failed[first] = None
                return found.cut
            programme += 1
            served = self._serves(known, H, todo)
            scaled += int(served.sum())
            todo = todo[~served]
        combination = len(self.year) - len(self.corners)
        self.certificate = Certificate(scaled, programme, combination, self.tolerance)
        return None

    def _remember(self, units: Floats, hour: int) -> _Known:
        """Keep a dispatch as the share that each unit gives of its range in the hour."""
        low, high = self.unit_limits(hour)
        known = _Known((units - low) / np.where(high > low, high - low, np.inf))
        self._known = [*self._known, known][-KNOWN_DISPATCHES:]
        return known

    def _serves(self, known: _Known, H: Floats, at: Integers) -> Flags:
        """Corner hours that units at `share` of their ranges serve, after all were moved by one share of
        their room up or down so that the hour balances."""
        good = np.zeros(len(at), dtype=bool)
        if not len(at):
            return good
        low, high = self.unit_ranges.limits(self.corners[at], compact=True)
        units = low + known.share[:, None] * (high - low)
        short = self._demand[at] + H.sum() * self._dc[at] - units.sum(axis=0)
        up = np.maximum(short, 0.0) / np.maximum((high - units).sum(axis=0), 1e-9)
        down = np.minimum(short, 0.0) / np.maximum((units - low).sum(axis=0), 1e-9)
        if known.flows is None or not self.unit_ranges.constant:
            known.flows = [self.unit_ranges.flows(part) for part in (units, high - units, units - low)]
        flows = known.flows
        site = self._site_flow @ H

        def within(rows: Integers | slice, hours: Integers) -> tuple[Flags, Floats]:
            base, more, less = (f[rows] if f.shape[1] == 1 else f[rows][:, hours] for f in flows)
            flow = self._flow[rows][:, at[hours]] - np.outer(site[rows], self._dc[at[hours]])
            flow = flow + base + more * up[hours] + less * down[hours]
            limit = self.network.branches.rating[rows, None] + 1e-2 * self.tolerance
            return np.asarray((abs(flow) <= limit).all(axis=0)), flow

        hours = np.flatnonzero((up <= 1.0) & (down >= -1.0))
        if len(self._watched):
            hours = hours[within(self._watched, hours)[0]]
        block = max(1, BLOCK // len(site))
        while len(hours):
            now, hours = hours[:block], hours[block:]
            ok, flow = within(slice(None), now)
            if not ok.all():
                broken = (abs(flow) - self.network.branches.rating[:, None]).argmax(axis=0)[~ok]
                self._watched = np.union1d(self._watched, broken)
                hours = hours[within(self._watched, hours)[0]] if len(hours) else hours
            ok[ok] = self.outages.survived(flow[:, ok], 1e-2 * self.tolerance)
            good[now[ok]] = True
        return good


@dataclass(eq=False)
class _Known:
    """A dispatch that may serve other hours too.

    Attributes
    ----------
    share : array (units,)
        What each unit gives of its range.
    flows : list of arrays or None
        Branch flows of the outputs, of the room above and of the room below; kept while no limit varies.
    """

    share: Floats
    flows: list[Floats] | None = None


class UnitRanges:
    """Limits of the units hour by hour, and the branch flows of their outputs.

    Parameters
    ----------
    network : Network
    year : Year
        Its `p_min` and `p_max` name the units whose limits vary.
    """

    def __init__(self, network: Network, year: Year) -> None:
        self.network, self.year = network, year
        units = network.generators
        place = {name: k for k, name in enumerate(units.name)}
        self._low = {place[name]: mw for name, mw in year.p_min.items()}
        self._high = {place[name]: mw for name, mw in year.p_max.items()}
        self._varying = np.array(sorted({*self._low, *self._high}), dtype=np.int64)
        injection = np.zeros((len(network.bus), len(self._varying)))
        injection[network.generator_index[self._varying], np.arange(len(self._varying))] = 1.0
        self._columns = network.transfer(injection)

    @property
    def constant(self) -> bool:
        """Whether no limit varies."""
        return not len(self._varying)

    def limits(self, hours: Integers, compact: bool = False) -> tuple[Floats, Floats]:
        """Lower and upper limits at the given positions, MW, (units, hours).

        With `compact` there is one column where no limit varies.
        """
        count = 1 if compact and not len(self._varying) else len(hours)
        sides = []
        for fixed, by_unit in (
            (self.network.generators.p_min, self._low),
            (self.network.generators.p_max, self._high),
        ):
            limit = np.repeat(fixed[:, None], count, axis=1)
            for g, mw in by_unit.items():
                limit[g] = mw[hours]
            sides.append(limit)
        return sides[0], sides[1]

    def flows(self, output: Floats) -> Floats:
        """Branch flows of unit outputs, MW, (branches, columns); rows of units whose limits do not vary hold
        one value."""
        constant = output[:, 0].copy()
        constant[self._varying] = 0.0
        injection = np.zeros(len(self.network.bus))
        np.add.at(injection, self.network.generator_index, constant)
        flow = self.network.transfer(injection)[:, None]
        return flow + self._columns @ output[self._varying] if len(self._varying) else flow
