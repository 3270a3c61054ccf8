"""The linear voltage screen: voltages of every moving bus and hour as affine functions of the capacities."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from dcvrt.errors import InfeasibleError
from dcvrt.grid.network import Network
from dcvrt.grid.powerflow import HourlySolution, PowerFlow
from dcvrt.grid.schedule import hosting_directions, injections
from dcvrt.planning import reactive
from dcvrt.planning.interpolation import VoltageDrop
from dcvrt.planning.profiles import Year, in_ranges

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]


MOST_KEPT = 4
"""Capacities whose voltages are kept to start from."""
SAME = 1e-6
"""Difference of capacities that counts as none, MW: it moves no voltage by 1e-8 pu."""
BUSES_A_ROUND = 4
"""Buses whose violated limits become cuts together."""


@dataclass(frozen=True, eq=False)
class Tangent:
    """One voltage as an affine function of the capacities: `constant + slope @ H` against a limit.

    `side` is -1 for the lower and +1 for the upper limit; `bus` counts moving buses, `hour` counts hours.
    """

    bus: int
    hour: int
    side: int
    constant: float
    slope: Floats
    limit: float

    @property
    def key(self) -> tuple[int, int, int]:
        """Which voltage and which limit."""
        return self.bus, self.hour, self.side

    def cut(self) -> tuple[Floats, float]:
        """The limit as `a @ H <= b`."""
        return self.side * self.slope, self.side * (self.limit - self.constant)

    def bounds(self, H: Floats, voltage: float) -> bool:
        """Whether the tangent is on the safe side of the AC voltage at `H`, so that as a cut it excludes no
        capacities that AC power flow allows there."""
        linear = self.constant + self.slope @ H
        return bool(self.side * (voltage - linear) >= -1e-9)


class HostedFlow:
    """AC power flow of the operating hours at any capacities.

    The units follow the hosted load as `schedule.dispatch` says and the slack takes losses. `pv` buses hold
    their voltage, with `reactive_limits` as far as their units can.
    """

    def __init__(
        self, network: Network, sites: tuple[int, ...], year: Year, pf: float, reactive_limits: bool = True
    ) -> None:
        self.network, self.year = network, year
        self.flow = PowerFlow(network, reactive_limits)
        self.change = hosting_directions(network, sites, pf)
        self.scheduled = injections(network, year.load, year.wind)
        self._all = np.arange(len(year))
        self._solved: list[tuple[Floats, HourlySolution]] = []

    @cached_property
    def unhosted(self) -> HourlySolution:
        """Power flow with nothing hosted; raises `InfeasibleError` where there is none."""
        solved = self.flow.solve_hours(self.scheduled, hours=self.year.hours)
        if not solved.converged.all():
            raise InfeasibleError(_no_base(self.network, solved))
        return solved

    @property
    def base(self) -> npt.NDArray[np.complex128]:
        """Voltages with nothing hosted, (buses, hours)."""
        return self.unhosted.v

    def solve(self, H: Floats, hours: Integers | None = None) -> HourlySolution:
        """AC power flow at `H` of the hours at the given positions (default all).

        Hours that were solved at these capacities before are not solved again.
        """
        known = self._known(H)
        at = self._all if hours is None else hours
        fresh = at[~known.converged[at]]
        if len(fresh):
            solved = self.flow.solve_hours(
                self._demand(H, fresh),
                start=known.v[:, fresh],
                hours=self.year.hours[fresh],
                limited=known.limited[:, fresh],
            )
            known.update(fresh, solved)
        found = known.take(at)
        failed = at[~known.converged[at]]
        known.v[:, failed], known.limited[:, failed] = self.base[:, failed], self.unhosted.limited[:, failed]
        return found

    def _known(self, H: Floats) -> HourlySolution:
        """What was solved at `H`, all hours; those that were not hold what is known nearest to it, to start
        from. A search comes back to the same capacities again and again.
        """
        if not H.any():
            return self.unhosted
        far = [float(abs(H - other).max()) for other, _ in self._solved]
        nearest = int(np.argmin(far)) if far and min(far) < abs(H).max() else None
        if nearest is not None and far[nearest] <= SAME:
            self._solved.append(self._solved.pop(nearest))
            return self._solved[-1][1]
        start = self.unhosted if nearest is None else self._solved[nearest][1]
        fresh = start.unsolved()
        self._solved = [*self._solved[1 - MOST_KEPT :], (H.copy(), fresh)]
        return fresh

    def _demand(self, H: Floats, at: Integers) -> npt.NDArray[np.complex128]:
        """Scheduled injections at `H`, MVA, (buses, hours)."""
        return self.scheduled[:, at] + np.outer(self.change.T @ H, self.year.dc[at])

    def slopes(self, solved: HourlySolution, at: Integers) -> Floats:
        """Derivative of every moving voltage by the capacities, pu/MW, (moving buses, hours, sites)."""
        return self.flow.sensitivities(solved.v, self.change, self.year.dc[at], solved.limited)

    def reactive_excess(
        self, H: Floats, v: npt.NDArray[np.complex128], hours: Integers
    ) -> reactive.ReactiveExcess:
        """How far units are beyond their reactive limits at `H`.

        `v` are the AC voltages at `H`, (buses, hours), of the hours at the given positions.
        """
        output = reactive.unit_output(self.network, self._unit_buses, v, self._demand(H, hours))
        return reactive.excess(self.network, self._unit_buses, output, self.year.hours[hours])

    @cached_property
    def reactive_unhosted(self) -> reactive.ReactiveExcess:
        """How far units are beyond their reactive limits with nothing hosted."""
        return self.reactive_excess(np.zeros(len(self.change)), self.base, self._all)

    @cached_property
    def _unit_buses(self) -> reactive.UnitBuses:
        return reactive.UnitBuses.of(self.network)


class VoltageScreen:
    r"""Voltages :math:`V_{\ell,t}(H) \approx c_{\ell,t} + \Gamma_{\ell,t}\cdot H` within limits.

    First linearised with nothing hosted; `relinearise` moves single hours to another point.

    Parameters
    ----------
    base_violations : str
        `error`: voltages outside the limits with nothing hosted raise. `hold`: they must not get worse.

    Raises
    ------
    InfeasibleError
        Naming the buses and hours that are outside the limits with nothing hosted, or the hours that have no
        power flow then.
    """

    def __init__(self, ac: HostedFlow, limits: tuple[float, float], base_violations: str) -> None:
        self.ac, self.network, self.year, self.limits = ac, ac.network, ac.year, limits
        self.moving = ac.flow.moving
        size = self.sizes(ac.unhosted)
        self.unhosted = size
        self.interpolation = VoltageDrop(ac.year)
        self.slope = ac.slopes(ac.unhosted, np.arange(len(self.year)))
        self.constant = size.copy()
        self.settled = False
        """Whether AC power flow has agreed in every hour once: from then on its hours are well placed."""
        self.lower = np.minimum(limits[0], size)
        self.upper = np.maximum(limits[1], size)
        # Extremes over the hours, from which `near` bounds voltages for H >= 0.
        self._constant_range = self.constant.min(axis=1), self.constant.max(axis=1)
        self._slope_range = self.slope.min(axis=1), self.slope.max(axis=1)
        self._tightest = self.lower.max(axis=1), self.upper.min(axis=1)
        outside = (size < limits[0]) | (size > limits[1])
        self.widened = int(outside.sum())
        if base_violations == "error":
            self._refuse(size, outside)

    def _refuse(self, size: Floats, outside: npt.NDArray[np.bool_]) -> None:
        """Raise when the base case violates the limits at moving buses or at set points."""
        network, (low, high) = self.network, self.limits
        lines = []
        beyond = np.maximum(low - size, size - high).max(axis=1)
        for i in np.argsort(-beyond, kind="stable")[: int(outside.any(axis=1).sum())]:
            hours = np.flatnonzero(outside[i])
            k = hours[np.maximum(low - size[i, hours], size[i, hours] - high).argmax()]
            lines.append(
                f"bus {network.bus[self.moving[i]]}: outside in {len(hours)} hours "
                f"({in_ranges(self.year.hours[hours])}), worst {size[i, k]:.4f} pu in hour "
                f"{self.year.hours[k]}"
            )
        held = np.setdiff1d(np.arange(len(network.bus)), self.moving)
        for i in np.intersect1d(held, np.flatnonzero((network.v_set < low) | (network.v_set > high))):
            lines.append(f"bus {network.bus[i]}: holds its set point {network.v_set[i]:.4f} pu")
        if not lines:
            return
        shown = "\n  ".join(lines[:10]) + (f"\n  ... and {len(lines) - 10} more" if len(lines) > 10 else "")
        raise InfeasibleError(
            f"{network.name}: with nothing hosted {len(lines)} bus(es) are outside the voltage limits "
            f"{low:g}-{high:g} pu.\n  {shown}\nWays out: wider voltage limits, other set points, or "
            "base_violations='hold', with which "
            "these voltages must only not get worse."
        )

    # -- rows ----------------------------------------------------------------------------------------------

    def sizes(self, solved: HourlySolution) -> Floats:
        """Voltages of the moving buses in a power flow, pu, (moving buses, hours)."""
        return np.asarray(abs(solved.v[self.moving]), dtype=np.float64)

    def near(self, H: Floats, margin: float) -> Integers:
        """Rows, places of moving buses, in which the screen may come within `margin` pu of a limit in some
        hour; elsewhere the extremes of the hours show that it does not."""
        least = self._constant_range[0] + self._slope_range[0] @ H
        most = self._constant_range[1] + self._slope_range[1] @ H
        return np.flatnonzero((least < self._tightest[0] + margin) | (most > self._tightest[1] - margin))

    def voltages(self, H: Floats, rows: Integers | None = None) -> Floats:
        """Linear voltages in all hours, of all moving buses or of some rows of them, pu."""
        slope, constant = (
            (self.slope, self.constant) if rows is None else (self.slope[rows], self.constant[rows])
        )
        return constant + (slope.reshape(-1, len(H)) @ H).reshape(constant.shape)

    def room(self, voltage: Floats, rows: Integers, hours: Integers | slice = slice(None)) -> Floats:
        """Distance of voltages, (rows, hours), to the nearer limit, pu; negative beyond it."""
        low, high = self._limits(rows, hours)
        room = voltage - low
        return np.minimum(room, high - voltage, out=room)

    def _limits(self, rows: Integers, hours: Integers | slice = slice(None)) -> tuple[Any, Any]:
        """Lower and upper limits, (rows, hours); one number each where they are the same everywhere."""
        if not self.widened:
            return self.limits
        at = (rows, hours) if isinstance(hours, slice) else np.ix_(rows, hours)
        return self.lower[at], self.upper[at]

    def tangent(self, bus: int, hour: int, side: int) -> Tangent:
        """The present linearisation of one voltage against one of its limits."""
        limit = (self.lower if side < 0 else self.upper)[bus, hour]
        return Tangent(
            bus, hour, side, float(self.constant[bus, hour]), self.slope[bus, hour].copy(), float(limit)
        )

    def violated(self, H: Floats, tolerance: float) -> list[Tangent]:
        """The most violated lower and upper limit of each of the buses with the worst."""
        rows = self.near(H, 0.0)
        if not len(rows):
            return []
        now = self.voltages(H, rows)
        found = []
        low, high = self._limits(rows)
        for side, over in ((-1, low - now), (1, now - high)):
            hour = over.argmax(axis=1)
            worst = over[np.arange(len(rows)), hour]
            for k in np.argsort(-worst, kind="stable")[:BUSES_A_ROUND].tolist():
                tangent = self.tangent(int(rows[k]), int(hour[k]), side)
                if worst[k] > tolerance and tangent.slope.any():  # else no capacity moves it: AC has the word
                    found.append(tangent)
        return found

    def relinearise(
        self,
        H: Floats,
        hours: Integers,
        solved: HourlySolution,
        steep: Integers,
        rows: Integers,
        expected: Floats | None,
    ) -> None:
        """Make the screen exact at `H` in `hours`, with new slopes in those of them at places `steep`, and as
        expected in all other hours of some rows.

        Parameters
        ----------
        solved : HourlySolution
            AC power flow at `H` of the hours.
        expected : array (rows, all hours) or None
            Voltages, pu; None leaves the other hours as they are.
        """
        chosen = hours[steep]
        self.slope[:, chosen] = self.ac.slopes(solved.take(steep), chosen)
        drop = (self.slope.reshape(-1, len(H)) @ H).reshape(self.constant.shape)
        if expected is not None:
            self.constant[rows] = expected - drop[rows]
        self.constant[:, hours] = self.sizes(solved) - drop[:, hours]
        _widen(self._constant_range, self.constant, hours)
        _widen(self._slope_range, self.slope, chosen)
        if expected is not None:
            for side, extreme in zip(self._constant_range, (np.min, np.max), strict=True):
                side[rows] = extreme(self.constant[rows], axis=1)


def _no_base(network: Network, solved: HourlySolution) -> str:
    """Say which hours have no power flow with nothing hosted."""
    failed = np.flatnonzero(~solved.converged)
    buses, count = np.unique(solved.worst_bus[failed], return_counts=True)
    worst = ", ".join(str(bus) for bus in buses[np.argsort(-count, kind="stable")[:3]])
    return (
        f"{network.name}: with nothing hosted {len(failed)} of {len(solved.hours)} hours have no AC power "
        f"flow (hours {in_ranges(solved.hours[failed])}).\n  Newton's method ends with the largest mismatch "
        f"at bus {worst}.\n"
        "Ways out: check loads, reactive limits and voltage set points, leave these hours out, or "
        "voltage=None for line limits alone."
    )


def _widen(range_: tuple[Floats, Floats], values: Floats, hours: Integers) -> None:
    """Take what changed in some hours into the extremes over the hours."""
    if len(hours):
        np.minimum(range_[0], values[:, hours].min(axis=1), out=range_[0])
        np.maximum(range_[1], values[:, hours].max(axis=1), out=range_[1])
