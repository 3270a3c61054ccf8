"""Feasibility of every hour at given capacities: a dispatch for each, or a cut that forbids them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from dcvrt.grid.network import Network
from dcvrt.planning.hour import Dispatched, FlowCut, HourDispatch
from dcvrt.planning.plan import Certificate
from dcvrt.planning.profiles import Year

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

TOLERANCE_MW = 1e-6
KNOWN_DISPATCHES = 60
HULL_FROM = 400
"""Hours from which the convex hull is worth its computation."""
HULL_DIMENSIONS = 6
"""Parameters up to which the hull has far fewer vertices than there are hours."""


def corner_hours(year: Year) -> Integers:
    r"""Hours whose operating parameters are vertices of the convex hull of all.

    For fixed capacities the injections are affine in load factor, wind and data-centre factor, and the set of
    injections that have a dispatch is convex. If the vertices have one, so has every hour: the same convex
    combination of dispatches. All hours are returned where the hull does not pay or cannot be computed.

    Returns
    -------
    int array
        Positions in `year`, ascending.
    """
    everything = np.arange(len(year))
    if len(year) < HULL_FROM:
        return everything
    points = np.column_stack([year.load, *year.wind.values(), year.dc])
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
    """

    def __init__(self, network: Network, sites: Integers, year: Year, hull: bool = True) -> None:
        self.network, self.sites, self.year = network, sites, year
        self.dispatcher = HourDispatch(network)
        fixed = -np.outer(network.p_load, year.load) - network.g_shunt[:, None]
        for bus, mw in year.wind.items():
            fixed[network.index(bus)] += mw
        self.fixed = fixed
        """Injections without units and sites, MW, (buses, hours)."""
        self.corners = corner_hours(year) if hull else np.arange(len(year))
        self._flow = network.flows(fixed[:, self.corners])
        self._demand = -fixed[:, self.corners].sum(axis=0)
        self._dc = year.dc[self.corners]
        self._site_ptdf = network.ptdf()[:, sites]
        units = network.generators
        share = (-fixed.sum(axis=0).mean() - units.p_min.sum()) / max((units.p_max - units.p_min).sum(), 1e-9)
        self._known = [units.p_min + (units.p_max - units.p_min) * np.clip(share, 0.0, 1.0)]
        self.certificate = Certificate(0, 0, 0, TOLERANCE_MW)

    def bound(self, cut: FlowCut, hours: Integers | None = None) -> Floats:
        """Right-hand side of `-pi_C . H <= b` that a cut gives in each corner hour, MW of hosted load."""
        at = self.corners if hours is None else hours
        return -(cut.pi @ self.fixed[:, at] + cut.constant) / self.year.dc[at]

    def injection(self, H: Floats, hour: int) -> Floats:
        """Bus injections without units at position `hour`, MW."""
        injection = self.fixed[:, hour].copy()
        np.add.at(injection, self.sites, -self.year.dc[hour] * H)
        return injection

    def dispatch(self, H: Floats, hour: int) -> Dispatched:
        """Dispatch the hour at position `hour`."""
        return self.dispatcher.solve(self.injection(H, hour))

    def certify(self, H: Floats) -> FlowCut | None:
        """Show that every hour has a dispatch at `H`, or return a cut that `H` violates."""
        flow = self._flow - np.outer(self._site_ptdf @ H, self._dc)
        demand = self._demand + H.sum() * self._dc
        todo = np.arange(len(self.corners))
        scaled = programme = 0
        for units in reversed(self._known):
            served = self._serves(units, flow[:, todo], demand[todo])
            scaled += int(served.sum())
            todo = todo[~served]
            if not len(todo):
                break
        todo = todo[np.argsort(-demand[todo], kind="stable")]
        while len(todo):
            found = self.dispatch(H, int(self.corners[todo[0]]))
            self._remember(found.units)
            if found.shortfall > TOLERANCE_MW:
                return found.cut
            programme += 1
            todo = todo[1:]
            served = self._serves(found.units, flow[:, todo], demand[todo])
            scaled += int(served.sum())
            todo = todo[~served]
        combination = len(self.year) - len(self.corners)
        self.certificate = Certificate(scaled, programme, combination, TOLERANCE_MW)
        return None

    def _remember(self, units: Floats) -> None:
        self._known = [*self._known, units][-KNOWN_DISPATCHES:]

    def _serves(self, units: Floats, flow: Floats, demand: Floats) -> npt.NDArray[np.bool_]:
        """Hours that `units` serve after all were moved by one share of their room up or down."""
        low, high = self.network.generators.p_min, self.network.generators.p_max
        short = demand - units.sum()
        up = np.maximum(short, 0.0) / max((high - units).sum(), 1e-9)
        down = np.minimum(short, 0.0) / max((units - low).sum(), 1e-9)
        ptdf = self.dispatcher.units_ptdf
        total = (
            flow
            + (ptdf @ units)[:, None]
            + np.outer(ptdf @ (high - units), up)
            + np.outer(ptdf @ (units - low), down)
        )
        within = (abs(total) <= self.network.branches.rating[:, None] + 1e-2 * TOLERANCE_MW).all(axis=0)
        return np.asarray(within & (up <= 1.0) & (down >= -1.0))
