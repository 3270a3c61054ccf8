"""AC power flow: Newton for one operating point, batched chord Newton and voltage sensitivities for many."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from dcvrt.errors import InputError, SimulationError
from dcvrt.grid.network import Network

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]
Phasors = npt.NDArray[np.complex128]

TOLERANCE = 1e-9
"""Largest power mismatch of a solution, pu on the system base."""


def participation(network: Network) -> Floats:
    """Share of each generator in a change of net load: its scheduled output over the sum of all.

    Units that are scheduled to take power in, or nothing, have share 0. The shares sum to 1.

    Raises
    ------
    InputError
        When no unit is scheduled to generate.
    """
    scheduled = np.maximum(network.generators.p_set, 0.0)
    if scheduled.sum() <= 0:
        raise InputError(
            f"{network.name}: no generator is scheduled to generate, so none can follow the load. "
            "Way out: give p_set of at least one unit."
        )
    return scheduled / scheduled.sum()


def dispatch(network: Network, net_load: Floats | float) -> Floats:
    """Output of each generator, MW, when all follow the net load in proportion to their schedule.

    Losses are not in it: the slack bus takes them. The limits p_min and p_max are not looked at.

    Parameters
    ----------
    net_load : float or array (hours,)
        Load and hosted load less wind, MW.

    Returns
    -------
    array (generators,) or (generators, hours)
    """
    return np.multiply.outer(participation(network), net_load)


def injections(
    network: Network, load: Floats, wind: Mapping[int, Floats], hosted: Mapping[int, Phasors] | None = None
) -> Phasors:
    """Scheduled bus injections in MVA, generation positive, of many operating hours.

    Parameters
    ----------
    load : array (hours,)
        Factor on every active and reactive load.
    wind : mapping of bus number to array (hours,)
        Wind power in MW, at unity power factor.
    hosted : mapping of bus number to complex array (hours,)
        Hosted load P + jQ in MVA, import positive.

    Returns
    -------
    complex array (buses, hours)
        Units follow the net load as `dispatch` says. At `pv` and `slack` buses Q is what holds the voltage.
    """
    load = np.atleast_1d(np.asarray(load, dtype=float))
    power = -np.outer(network.p_load + 1j * network.q_load, load)
    for bus, mw in wind.items():
        power[network.index(bus)] += mw
    for bus, mva in (hosted or {}).items():
        power[network.index(bus)] -= mva
    units = dispatch(network, -power.real.sum(axis=0))
    np.add.at(power, network.generator_index, units)
    return power


@dataclass(frozen=True, eq=False)
class OperatingPoint:
    """A solved operating point.

    Parameters
    ----------
    v : complex array (buses,)
        Bus voltages, pu, angle 0 at the slack bus.
    iterations : int
    mismatch_mva : float
        Largest power mismatch left.
    """

    v: Phasors
    iterations: int
    mismatch_mva: float


@dataclass(frozen=True, eq=False)
class HourlySolution:
    """Power flow of many hours; an hour without a solution stays in, labelled.

    Parameters
    ----------
    v : complex array (buses, hours)
        Voltages, pu; meaningless where not `converged`.
    converged : bool array (hours,)
    mismatch_mva : array (hours,)
        Largest power mismatch.
    worst_bus : int array (hours,)
        Number of the bus where it is.
    hours : int array (hours,)
        Names of the hours.
    """

    v: Phasors
    converged: npt.NDArray[np.bool_]
    mismatch_mva: Floats
    worst_bus: Integers
    hours: Integers

    @property
    def status(self) -> str:
        """A sentence on how it ended."""
        failed = np.flatnonzero(~self.converged)
        if not len(failed):
            return f"Solved in all {len(self.hours)} hours."
        k = failed[0]
        return (
            f"Power flow has no solution in {len(failed)} of {len(self.hours)} hours; the first is hour "
            f"{self.hours[k]}: mismatch {self.mismatch_mva[k]:.3g} MVA, largest at bus {self.worst_bus[k]}. "
            "Way out: host less there, or check the load and the voltage set points of that hour."
        )

    def require(self) -> HourlySolution:
        """Return itself, or raise `SimulationError` with `status` when an hour has no solution."""
        if not self.converged.all():
            raise SimulationError(self.status)
        return self


class PowerFlow:
    r"""Power flow equations of a network, in polar voltages.

    .. math:: S_k = V_k \Big(\sum_m Y_{km} V_m\Big)^*

    with P given at all buses but the slack and Q at `pq` buses. `pv` and `slack` buses hold `v_set` without
    reactive limits. Many hours are solved together by chord Newton: hours are sorted by net load into a few
    groups, each with one Jacobian, inverted once; residuals are exact, so only the number of steps suffers.
    """

    def __init__(self, network: Network) -> None:
        self.network = network
        kind = np.array(network.kind)
        self.pq = np.flatnonzero(kind == "pq")
        self.free = np.r_[np.flatnonzero(kind == "pv"), self.pq]
        """Buses whose angle is unknown: `pv`, then `pq`."""
        self._y = network.admittance()

    @cached_property
    def flat(self) -> Phasors:
        """Start values: set points where a voltage is held, 1 pu elsewhere, angle 0."""
        return self.network.v_set.astype(complex)

    # -- one point -----------------------------------------------------------------------------------------

    def solve(self, injection: Phasors, start: Phasors | None = None, steps: int = 30) -> OperatingPoint:
        """Solve one operating point by Newton's method.

        Parameters
        ----------
        injection : complex array (buses,)
            Scheduled injections, MVA.
        start : complex array (buses,), optional

        Raises
        ------
        SimulationError
            When Newton does not settle, with the bus of the largest mismatch.
        """
        found = self._newton(injection / self.network.base_mva, self.flat if start is None else start, steps)
        v, iterations, worst = found
        if not abs(worst).max() < TOLERANCE:
            bus = self.network.bus[self._bus_of_row(abs(worst).argmax())]
            raise SimulationError(
                f"{self.network.name}: power flow did not settle in {iterations} steps; mismatch "
                f"{abs(worst).max() * self.network.base_mva:.3g} MVA, largest at bus {bus}. "
                "Way out: host less there, or check loads and voltage set points."
            )
        return OperatingPoint(v, iterations, float(abs(worst).max() * self.network.base_mva))

    def _bus_of_row(self, row: npt.ArrayLike) -> Integers:
        return np.r_[self.free, self.pq][row]

    def _mismatch(self, v: Phasors, current: Phasors, s: Phasors) -> Floats:
        power = v * current.conj() - s
        return np.concatenate([power[self.free].real, power[self.pq].imag])

    def _jacobian(self, v: Phasors) -> sp.csc_matrix:
        """Derivative of the mismatch by the angles of `free` and the magnitudes of `pq`."""
        current = self._y @ v
        unit = sp.diags(v / abs(v))
        by_angle = (1j * sp.diags(v) @ (sp.diags(current) - self._y @ sp.diags(v)).conj()).tocsr()
        by_size = (sp.diags(v) @ (self._y @ unit).conj() + sp.diags(current.conj()) @ unit).tocsr()
        a, q = self.free, self.pq
        return sp.bmat(
            [[by_angle[a][:, a].real, by_size[a][:, q].real], [by_angle[q][:, a].imag, by_size[q][:, q].imag]]
        ).tocsc()

    def _newton(self, s: Phasors, start: Phasors, steps: int) -> tuple[Phasors, int, Floats]:
        angle, size = np.angle(start), abs(start)
        n = len(self.free)
        with np.errstate(all="ignore"):
            for step in range(steps + 1):
                v = size * np.exp(1j * angle)
                rest = self._mismatch(v, self._y @ v, s)
                if not np.isfinite(rest).all() or abs(rest).max() < TOLERANCE or step == steps:
                    break
                try:
                    move = spla.splu(self._jacobian(v)).solve(rest)
                except RuntimeError:  # singular Jacobian: the nose of the curve
                    break
                angle[self.free] -= move[:n]
                size[self.pq] -= move[n:]
        return v, step, np.where(np.isfinite(rest), rest, np.inf)

    # -- many hours ----------------------------------------------------------------------------------------

    def solve_hours(
        self, injection: Phasors, start: Phasors | None = None, hours: Integers | None = None, steps: int = 40
    ) -> HourlySolution:
        """Solve many operating points at once.

        Parameters
        ----------
        injection : complex array (buses, hours)
            Scheduled injections, MVA.
        start : complex array (buses, hours), optional
            Start values, for instance the solution at a nearby hosting vector.
        hours : int array (hours,), optional
            Names of the hours for messages; default 0, 1, ...

        Returns
        -------
        HourlySolution
        """
        s = injection / self.network.base_mva
        v = np.empty(s.shape, dtype=complex)
        rest = np.full(s.shape[1], np.inf)
        row = np.zeros(s.shape[1], dtype=np.int64)
        warm = None
        for group in self._groups(s):
            if start is None:
                centre, _, left = self._newton(
                    s[:, group].mean(axis=1), self.flat if warm is None else warm, 30
                )
                if not abs(left).max() < TOLERANCE:
                    centre = self.flat  # the hours are tried one by one below
                warm = centre
                begin = np.repeat(centre[:, None], len(group), axis=1)
            else:
                begin = start[:, group]
                centre = begin.mean(axis=1)
            v[:, group], rest[group], row[group] = self._chord(
                s[:, group], begin, self._inverse(centre), steps
            )
        for k in np.flatnonzero(~(rest < TOLERANCE)):
            v[:, k], _, left = self._newton(s[:, k], self.flat, 30)
            row[k] = abs(left).argmax()
            rest[k] = abs(left).max()
        names = np.arange(s.shape[1]) if hours is None else hours
        return HourlySolution(
            v, rest < TOLERANCE, rest * self.network.base_mva, self.network.bus[self._bus_of_row(row)], names
        )

    def _groups(self, s: Phasors) -> list[Integers]:
        """Hours sorted by load at `pq` buses and cut into groups of similar size."""
        order = np.argsort(s[self.pq].real.sum(axis=0), kind="stable")
        return [g for g in np.array_split(order, min(8, max(1, len(order) // 64))) if len(g)]

    def _inverse(self, v: Phasors) -> npt.NDArray[np.float32]:
        """Inverse Jacobian at one point, in single precision: it only steers, the residuals are exact."""
        return np.linalg.inv(self._jacobian(v).toarray()).astype(np.float32)

    def _chord(
        self, s: Phasors, start: Phasors, inverse: npt.NDArray[np.float32], steps: int
    ) -> tuple[Phasors, Floats, Integers]:
        """Newton with one inverse for all columns; columns that are done leave the loop."""
        n, count = len(self.free), s.shape[1]
        v = start.copy()
        worst, row = np.full(count, np.inf), np.zeros(count, dtype=np.int64)
        todo = np.arange(count)
        size, angle = abs(start), np.angle(start)
        with np.errstate(all="ignore"):
            for _ in range(steps):
                now = size * np.exp(1j * angle)
                rest = self._mismatch(now, self._y @ now, s[:, todo])
                level = abs(rest).max(axis=0)
                v[:, todo], worst[todo] = now, np.where(np.isfinite(level), level, np.inf)
                row[todo] = abs(rest).argmax(axis=0)
                going = (level >= TOLERANCE) & (level < 1e3)
                if not going.any():
                    break
                if going.mean() < 0.7:
                    todo, size, angle, rest = todo[going], size[:, going], angle[:, going], rest[:, going]
                move = inverse @ rest.astype(np.float32)
                angle[self.free] -= move[:n]
                size[self.pq] -= move[n:]
        return v, worst, row

    def sensitivities(self, v: Phasors, directions: Phasors, scale: Floats) -> Floats:
        r"""Derivative of the voltage magnitude at every `pq` bus by each hosted MW, exactly at `v`.

        Solves :math:`J_t\, x = d_t\, r_j` in every hour t for every direction r_j, by chord iteration with
        exact residuals, to a relative residual of 1e-10.

        Parameters
        ----------
        v : complex array (buses, hours)
            Solved voltages.
        directions : complex array (count, buses)
            Change of the scheduled injections, MVA per unit of each parameter.
        scale : array (hours,)
            Factor on every direction in each hour (d_t).

        Returns
        -------
        array (pq buses, hours, count)
            pu per unit of the parameter; zero at the other buses, which hold their voltage.
        """
        n, m = len(self.free), len(self.pq)
        result = np.empty((m, v.shape[1], len(directions)))
        unit, current = v / abs(v), self._y @ v
        for group in self._groups(v * current.conj()):
            inverse = self._inverse(v[:, group].mean(axis=1))
            vg, ug, ig = v[:, group], unit[:, group], current[:, group].conj()
            for j, direction in enumerate(directions / self.network.base_mva):
                base = np.r_[direction[self.free].real, direction[self.pq].imag]
                right = np.outer(base, scale[group])
                size = abs(right).max()
                x = np.outer(inverse @ base, scale[group])
                for _ in range(60):
                    dv = np.zeros_like(vg)
                    dv[self.free] = 1j * vg[self.free] * x[:n]
                    dv[self.pq] += ug[self.pq] * x[n:]
                    power = dv * ig + vg * (self._y @ dv).conj()
                    rest = np.concatenate([power[self.free].real, power[self.pq].imag]) - right
                    if abs(rest).max() <= 1e-10 * size:
                        break
                    x -= size * (
                        inverse @ (rest / size).astype(np.float32)
                    )  # scaled: single precision underflows
                else:
                    raise SimulationError(
                        f"{self.network.name}: voltage sensitivities did not settle; the operating "
                        "points lie close to the limit of power transfer. Way out: host less."
                    )
                result[:, group, j] = x[n:]
        return result


def hosting_directions(network: Network, sites: Sequence[int] | Integers, pf: float) -> Phasors:
    r"""Change of all scheduled injections per MW hosted at each site, MVA.

    The site takes :math:`1 + j\tan\arccos \mathrm{pf}`, and the units share the active part
    (`participation`).

    Returns
    -------
    complex array (sites, buses)
    """
    change = np.zeros((len(sites), len(network.bus)), dtype=complex)
    np.add.at(
        change.T, network.generator_index, np.repeat(participation(network)[:, None], len(sites), axis=1)
    )
    change[np.arange(len(sites)), network.indices(sites)] -= 1.0 + 1j * np.tan(np.arccos(pf))
    return change
