"""The linear voltage screen: voltages of every `pq` bus and hour as affine functions of the capacities."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from dcvrt.errors import InfeasibleError
from dcvrt.grid.network import Network
from dcvrt.grid.powerflow import HourlySolution, PowerFlow, hosting_directions, injections
from dcvrt.planning import reactive
from dcvrt.planning.profiles import Year

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Tangent:
    """One voltage as an affine function of the capacities: `constant + slope @ H` against a limit.

    `side` is -1 for the lower and +1 for the upper limit; `bus` counts `pq` buses, `hour` counts hours.
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

    The units follow the hosted load as `powerflow.dispatch` says, the slack takes losses, and `pv` buses hold
    their voltage without reactive limits; `reactive_excess` says how far units are beyond them.
    """

    def __init__(self, network: Network, sites: tuple[int, ...], year: Year, pf: float) -> None:
        self.network, self.year = network, year
        self.flow = PowerFlow(network)
        self.change = hosting_directions(network, sites, pf)
        self.scheduled = injections(network, year.load, year.wind)
        self._all = np.arange(len(year))
        self._latest: npt.NDArray[np.complex128] | None = (
            None  # the next capacities are mostly near the last ones
        )

    @cached_property
    def base(self) -> npt.NDArray[np.complex128]:
        """Voltages with nothing hosted, (buses, hours); raises `SimulationError` where there are none."""
        return self.flow.solve_hours(self.scheduled, hours=self.year.hours).require().v

    def solve(self, H: Floats, hours: Integers | None = None) -> HourlySolution:
        """AC power flow at `H` of the hours at the given positions (default all)."""
        at = self._all if hours is None else hours
        if self._latest is None:
            self._latest = self.base.copy()
        demand = self._demand(H, at)
        solved = self.flow.solve_hours(demand, start=self._latest[:, at], hours=self.year.hours[at])
        self._latest[:, at] = np.where(solved.converged, solved.v, self.base[:, at])
        return solved

    def _demand(self, H: Floats, at: Integers) -> npt.NDArray[np.complex128]:
        """Scheduled injections at `H`, MVA, (buses, hours)."""
        return self.scheduled[:, at] + np.outer(self.change.T @ H, self.year.dc[at])

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
        Naming the buses and hours that are outside the limits with nothing hosted.
    SimulationError
        When an hour has no power flow with nothing hosted.
    """

    def __init__(self, ac: HostedFlow, limits: tuple[float, float], base_violations: str) -> None:
        self.ac, self.network, self.year, self.limits = ac, ac.network, ac.year, limits
        self.pq = ac.flow.pq
        size = abs(ac.base[self.pq])
        self.slope = ac.flow.sensitivities(ac.base, ac.change, self.year.dc)
        self.constant = size.copy()
        self.lower = np.minimum(limits[0], size)
        self.upper = np.maximum(limits[1], size)
        outside = (size < limits[0]) | (size > limits[1])
        self.widened = int(outside.sum())
        if base_violations == "error":
            self._refuse(size, outside)

    def _refuse(self, size: npt.NDArray[np.floating[Any]], outside: npt.NDArray[np.bool_]) -> None:
        """Raise when the base case violates the limits at `pq` buses or at set points."""
        network, (low, high) = self.network, self.limits
        lines = []
        for i in np.flatnonzero(outside.any(axis=1)):
            hours = np.flatnonzero(outside[i])
            k = hours[np.maximum(low - size[i, hours], size[i, hours] - high).argmax()]
            lines.append(
                f"bus {network.bus[self.pq[i]]}: outside in {len(hours)} hours, worst {size[i, k]:.4f} pu "
                f"in hour {self.year.hours[k]}"
            )
        held = np.array(network.kind) != "pq"
        for i in np.flatnonzero(held & ((network.v_set < low) | (network.v_set > high))):
            lines.append(f"bus {network.bus[i]}: holds its set point {network.v_set[i]:.4f} pu")
        if not lines:
            return
        shown = "\n  ".join(lines[:10]) + (f"\n  ... and {len(lines) - 10} more" if len(lines) > 10 else "")
        raise InfeasibleError(
            f"{network.name}: with nothing hosted {len(lines)} bus(es) are outside the voltage limits "
            f"{low:g}-{high:g} pu.\n  {shown}\nWays out: wider limits (voltage=...), other set points, or "
            "base_violations='hold', with which "
            "these voltages must only not get worse."
        )

    # -- rows ----------------------------------------------------------------------------------------------

    def voltages(self, H: Floats) -> Floats:
        """Linear voltages at all `pq` buses and hours, pu."""
        return self.constant + (self.slope.reshape(-1, len(H)) @ H).reshape(self.constant.shape)

    def tangent(self, bus: int, hour: int, side: int) -> Tangent:
        """The present linearisation of one voltage against one of its limits."""
        limit = (self.lower if side < 0 else self.upper)[bus, hour]
        return Tangent(
            bus, hour, side, float(self.constant[bus, hour]), self.slope[bus, hour].copy(), float(limit)
        )

    def violated(self, H: Floats, tolerance: float) -> list[Tangent]:
        """The most violated lower and the most violated upper limit."""
        now = self.voltages(H)
        found = []
        for side, over in ((-1, self.lower - now), (1, now - self.upper)):
            bus, hour = divmod(int(over.argmax()), over.shape[1])
            if over[bus, hour] > tolerance:
                found.append(self.tangent(bus, hour, side))
        return found

    def relinearise(self, H: Floats, hours: Integers, v: npt.NDArray[np.complex128], steep: Integers) -> None:
        """Make the screen exact at `H` in `hours`, with new slopes in those of them at places `steep`.

        `v` are the AC voltages at `H`, (buses, len(hours)).
        """
        chosen = hours[steep]
        self.slope[:, chosen] = self.ac.flow.sensitivities(v[:, steep], self.ac.change, self.year.dc[chosen])
        self.constant[:, hours] = abs(v[self.pq]) - self.slope[:, hours] @ H
