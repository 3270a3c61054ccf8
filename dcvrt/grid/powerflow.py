"""AC power flow: Newton for one operating point, batched chord Newton and voltage sensitivities for many."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from dcvrt.errors import SimulationError
from dcvrt.grid.chord import TOLERANCE, Chord
from dcvrt.grid.network import DENSE, Network
from dcvrt.grid.steering import Steering
from dcvrt.grid.switching import LOOKS, Limited, reactive_limits_at, switched

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]
Phasors = npt.NDArray[np.complex128]

LEVEL = 0.02
"""Hours whose load lies within so much of the reference load share one Jacobian."""
MOST_LEVELS = 60


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
    limited : int array (pv buses,)
        Reactive limit that each bus of `PowerFlow.pv` is at; empty without reactive limits.
    """

    v: Phasors
    iterations: int
    mismatch_mva: float
    limited: Limited = field(default_factory=lambda: np.zeros(0, dtype=np.int8))


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
    limited : int array (pv buses, hours)
        Reactive limit that each bus of `PowerFlow.pv` is at; no rows without reactive limits.
    """

    v: Phasors
    converged: npt.NDArray[np.bool_]
    mismatch_mva: Floats
    worst_bus: Integers
    hours: Integers
    limited: Limited

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

    def take(self, at: Integers) -> HourlySolution:
        """The hours at some places."""
        return HourlySolution(
            self.v[:, at],
            self.converged[at],
            self.mismatch_mva[at],
            self.worst_bus[at],
            self.hours[at],
            self.limited[:, at],
        )

    def unsolved(self) -> HourlySolution:
        """A copy to start from elsewhere, in which no hour counts as solved."""
        copies = (
            self.v.copy(),
            np.zeros_like(self.converged),
            self.mismatch_mva.copy(),
            self.worst_bus.copy(),
        )
        return HourlySolution(*copies, self.hours, self.limited.copy())

    def update(self, at: Integers, solved: HourlySolution) -> None:
        """Take over the solution of the hours at some places."""
        self.v[:, at], self.limited[:, at], self.converged[at] = solved.v, solved.limited, solved.converged
        self.mismatch_mva[at], self.worst_bus[at] = solved.mismatch_mva, solved.worst_bus

    def require(self) -> HourlySolution:
        """Return itself, or raise `SimulationError` with `status` when an hour has no solution."""
        if not self.converged.all():
            raise SimulationError(self.status)
        return self


class PowerFlow:
    r"""Power flow equations of a network, in polar voltages.

    .. math:: S_k = V_k \Big(\sum_m Y_{km} V_m\Big)^*

    with P given at all buses but the slack and Q at `pq` buses. `pv` and `slack` buses hold `v_set`. With
    `reactive_limits` they do so only as far as their units can:

    .. math::
        \underline Q \le Q \le \overline Q, \qquad
        V = V^{set} \;\text{or}\; (Q = \overline Q,\, V \le V^{set}) \;\text{or}\;
        (Q = \underline Q,\, V \ge V^{set})

    and Q is given where they cannot (PV-PQ switching, both ways); the slack bus keeps its angle.

    Many hours are solved together by chord Newton: hours of similar load share one Jacobian, kept for the
    next call; residuals are exact, so only the number of steps suffers.

    Parameters
    ----------
    network : Network
    reactive_limits : bool
        Whether the reactive limits of the units are enforced; units at one bus are taken together.
    """

    def __init__(self, network: Network, reactive_limits: bool = False) -> None:
        self.network, self.reactive_limits = network, reactive_limits
        kind = np.array(network.kind)
        self.pq = np.flatnonzero(kind == "pq")
        holding = np.r_[np.flatnonzero(kind == "pv"), np.flatnonzero(kind == "slack")]
        self.pv = np.sort(holding) if reactive_limits else np.zeros(0, dtype=np.int64)
        """Buses whose units hold the voltage and may let it go, the slack bus among them; none without
        `reactive_limits`."""
        self.free = np.r_[self.pq, holding[:-1]]
        """Buses whose angle is unknown: `pq`, then `pv`."""
        self.moving = np.r_[self.pq, self.pv]
        """Buses whose voltage can move."""
        self._y = network.admittance()
        self.q_low, self.q_high = reactive_limits_at(network, self.pv)
        self.held = network.v_set[self.pv]
        order = np.r_[self.pq, holding]
        self._chord = Chord(self._y, order, len(self.pq), self.pv, self.q_low, self.q_high, self.held)
        self._steerings: dict[int, Steering] = {}

    @cached_property
    def flat(self) -> Phasors:
        """Start values: set points where a voltage is held, 1 pu elsewhere, angle 0."""
        return self.network.v_set.astype(complex)

    @cached_property
    def _dense_y(self) -> Phasors:
        return np.asarray(self._y.toarray())

    # -- one point -----------------------------------------------------------------------------------------

    def solve(self, injection: Phasors, start: Phasors | None = None, steps: int = 30) -> OperatingPoint:
        """Solve one operating point by Newton's method.

        Parameters
        ----------
        injection : complex array (buses,)
            Scheduled injections, MVA; at `pv` buses their imaginary part is the demand alone.
        start : complex array (buses,), optional

        Raises
        ------
        SimulationError
            When Newton does not settle, with the bus of the largest mismatch.
        """
        s = injection / self.network.base_mva
        v, iterations, worst, limited = self._switched(s, self.flat if start is None else start, steps)
        if not abs(worst).max() < TOLERANCE:
            bus = self.network.bus[self._bus_of_row(abs(worst).argmax())]
            raise SimulationError(
                f"{self.network.name}: power flow did not settle in {iterations} steps; mismatch "
                f"{abs(worst).max() * self.network.base_mva:.3g} MVA, largest at bus {bus}. "
                "Way out: host less there, or check loads and voltage set points."
            )
        return OperatingPoint(v, iterations, float(abs(worst).max() * self.network.base_mva), limited)

    def _bus_of_row(self, row: npt.ArrayLike) -> Integers:
        return np.r_[self.free, self.moving][row]

    def _mismatch(self, v: Phasors, current: Phasors, s: Phasors, limited: Limited) -> Floats:
        """Missed equations: P of `free`, Q of `pq`, and Q of `pv` buses at a limit (0 where V is held)."""
        power = v * current.conj() - s
        rows = [power[self.free].real, power[self.pq].imag]
        if len(self.pv):
            rows.append(np.where(limited == 0, 0.0, power[self.pv].imag - self._limit(limited)))
        return np.concatenate(rows)

    def _limit(self, limited: Limited) -> Floats:
        shape = (-1,) + (1,) * (limited.ndim - 1)
        return np.where(limited > 0, self.q_high.reshape(shape), self.q_low.reshape(shape))

    def _switch(
        self, v: Phasors, current: Phasors, s: Phasors, limited: Limited, back: Any = True
    ) -> Limited:
        """Which limit each `pv` bus is at after one look at a solution; with `back` buses are released."""
        if not len(self.pv):
            return limited
        q = (v[self.pv] * current[self.pv].conj() - s[self.pv]).imag
        return switched(limited, q, np.abs(v[self.pv]), self.held, self.q_low, self.q_high, back)

    def _jacobian(self, v: Phasors, sizes: Integers) -> Any:
        """Derivative of P of `free` and Q of `sizes` by the angles of `free` and the voltages of `sizes`."""
        current = self._y @ v
        a = self.free
        if len(v) <= DENSE:
            y = self._dense_y
            unit = v / abs(v)
            by_angle = 1j * v[:, None] * (np.diag(current) - y * v).conj()
            by_size = v[:, None] * (y * unit).conj() + np.diag(current.conj() * unit)
            return np.block(
                [
                    [by_angle[np.ix_(a, a)].real, by_size[np.ix_(a, sizes)].real],
                    [by_angle[np.ix_(sizes, a)].imag, by_size[np.ix_(sizes, sizes)].imag],
                ]
            )
        phase = sp.diags(v / abs(v))
        angle = sp.csr_matrix(1j * sp.diags(v) @ (sp.diags(current) - self._y @ sp.diags(v)).conj())
        size = sp.csr_matrix(sp.diags(v) @ (self._y @ phase).conj() + sp.diags(current.conj()) @ phase)
        return sp.bmat(
            [
                [angle[a][:, a].real, size[a][:, sizes].real],
                [angle[sizes][:, a].imag, size[sizes][:, sizes].imag],
            ]
        ).tocsc()

    def _switched(self, s: Phasors, start: Phasors, steps: int) -> tuple[Phasors, int, Floats, Limited]:
        """Newton, and again with the buses that switch, until none does."""
        limited = np.zeros(len(self.pv), dtype=np.int8)
        v, total = start, 0
        for look in range(LOOKS):
            v, count, rest = self._newton(s, v, steps, limited)
            total += count
            if not abs(rest).max() < TOLERANCE:
                break
            current = np.asarray(self._y @ v, dtype=np.complex128)
            now = self._switch(v, current, s, limited, back=look < LOOKS // 2)
            if (now == limited).all():
                break
            v = v.copy()
            released = self.pv[(now == 0) & (limited != 0)]
            v[released] *= self.network.v_set[released] / abs(v[released])
            limited = now
        else:
            rest = np.full(len(rest), np.inf)
        return v, total, rest, limited

    def _newton(
        self, s: Phasors, start: Phasors, steps: int, limited: Limited
    ) -> tuple[Phasors, int, Floats]:
        angle, size = np.angle(start), abs(start)
        n = len(self.free)
        unheld = self.pv[limited != 0]
        sizes = np.r_[self.pq, unheld]
        rows = np.r_[np.ones(n + len(self.pq), dtype=bool), limited != 0]
        with np.errstate(all="ignore"):
            for step in range(steps + 1):
                v = size * np.exp(1j * angle)
                rest = self._mismatch(v, self._y @ v, s, limited)
                if not np.isfinite(rest).all() or abs(rest).max() < TOLERANCE or step == steps:
                    break
                jacobian = self._jacobian(v, sizes)
                try:
                    if isinstance(jacobian, np.ndarray):
                        move = np.linalg.solve(jacobian, rest[rows])
                    else:
                        move = spla.splu(jacobian).solve(rest[rows])
                except (RuntimeError, np.linalg.LinAlgError):  # singular Jacobian: the nose of the curve
                    break
                angle[self.free] -= move[:n]
                size[sizes] -= move[n:]
        return v, step, np.where(np.isfinite(rest), rest, np.inf)

    # -- many hours ----------------------------------------------------------------------------------------

    def solve_hours(
        self,
        injection: Phasors,
        start: Phasors | None = None,
        hours: Integers | None = None,
        steps: int = 60,
        limited: Limited | None = None,
    ) -> HourlySolution:
        """Solve many operating points at once.

        Parameters
        ----------
        injection : complex array (buses, hours)
            Scheduled injections, MVA; at `pv` buses their imaginary part is the demand alone.
        start : complex array (buses, hours), optional
            Start values, for instance the solution at a nearby hosting vector.
        hours : int array (hours,), optional
            Names of the hours for messages; default 0, 1, ...
        limited : int array (pv buses, hours), optional
            Limits that buses are at in `start`; default none.

        Returns
        -------
        HourlySolution
        """
        s = injection / self.network.base_mva
        v = np.empty(s.shape, dtype=complex)
        rest = np.full(s.shape[1], np.inf)
        bus = np.zeros(s.shape[1], dtype=np.int64)
        at = np.zeros((len(self.pv), s.shape[1]), dtype=np.int8)
        for level, group in self._levels(s):
            if start is None:
                centre, _, left = self._newton(s[:, group].mean(axis=1), self.flat, 30, at[:, 0] * 0)
                if not abs(left).max() < TOLERANCE:
                    centre = self.flat  # the hours are tried one by one below
                begin = np.repeat(centre[:, None], len(group), axis=1)
            else:
                begin = start[:, group]
            first = at[:, group] if limited is None else limited[:, group]
            v[:, group], rest[group], bus[group], at[:, group] = self._chord.solve(
                s[:, group], begin, self._steering(level, begin), steps, first
            )
        for k in np.flatnonzero(~(rest < TOLERANCE)):
            v[:, k], _, left, at[:, k] = self._switched(s[:, k], self.flat, 30)
            bus[k] = self._bus_of_row(abs(left).argmax())
            rest[k] = abs(left).max()
        names = np.arange(s.shape[1]) if hours is None else hours
        return HourlySolution(
            v,
            rest < TOLERANCE,
            rest * self.network.base_mva,
            self.network.bus[bus],
            names,
            at,
        )

    def _levels(self, s: Phasors) -> list[tuple[int, Integers]]:
        """Hours by the level of their load at `pq` buses, in steps of a share of the reference load."""
        step = LEVEL * max(abs(self.network.p_load.sum()) / self.network.base_mva, 1e-9)
        level = np.rint(s[self.pq].real.sum(axis=0) / step).astype(np.int64)
        if not len(level):
            return []
        order = np.argsort(level, kind="stable")
        found, begin = np.unique(level[order], return_index=True)
        return list(zip(found.tolist(), np.split(order, begin[1:]), strict=True))

    def _steering(self, level: int, v: Phasors) -> Steering:
        """The steering of a load level, made at the mean voltages of some hours when it is first needed."""
        if level not in self._steerings:
            if len(self._steerings) > MOST_LEVELS:
                self._steerings.clear()
            jacobian = self._jacobian(v.mean(axis=1), self._chord.moving)
            self._steerings[level] = Steering(jacobian, len(self.free) + len(self.pq))
        return self._steerings[level]

    def sensitivities(
        self, v: Phasors, directions: Phasors, scale: Floats, limited: Limited | None = None
    ) -> Floats:
        r"""Derivative of the voltage magnitude at every `moving` bus by each hosted MW, exactly at `v`.

        Solves :math:`J_t\, x = d_t\, r_j` in every hour t for every direction r_j, by chord iteration with
        exact residuals, to a relative residual of 1e-9. A bus at a reactive limit keeps its Q.

        Parameters
        ----------
        v : complex array (buses, hours)
            Solved voltages.
        directions : complex array (count, buses)
            Change of the scheduled injections, MVA per unit of each parameter.
        scale : array (hours,)
            Factor on every direction in each hour (d_t).
        limited : int array (pv buses, hours), optional
            Limits that `pv` buses are at, as `HourlySolution.limited` has them; default none.

        Returns
        -------
        array (moving buses, hours, count)
            pu per unit of the parameter; zero at buses that hold their voltage. Without `reactive_limits` the
            moving buses are the `pq` buses.
        """
        at = np.zeros((len(self.pv), v.shape[1]), dtype=np.int8) if limited is None else limited
        result = np.empty((len(self.moving), v.shape[1], len(directions)))
        change = directions.T / self.network.base_mva
        right = np.vstack([change[self.free].real, change[self._chord.moving].imag])
        for level, group in self._levels(v * (self._y @ v).conj()):
            vg, ag = v[:, group], at[:, group]

            def exactly(k: int, wanted: Floats, vg: Phasors = vg, ag: Limited = ag) -> Floats:
                return self._exactly(vg[:, k], ag[:, k], wanted)

            steering = self._steering(level, vg)
            result[:, group] = self._chord.sensitivities(vg, right, scale[group], steering, ag, exactly)
        return result

    def _exactly(self, v: Phasors, limited: Limited, right: Floats) -> Floats:
        """Moves of angles and sizes for residuals of one hour, from its own Jacobian."""
        n, m = len(self.free), len(self.pq)
        at = np.isin(self._chord.moving[m:], self.pv[limited != 0])
        rows = np.r_[np.ones(n + m, dtype=bool), at]
        jacobian = self._jacobian(v, self._chord.moving[rows[n:]])
        x = np.zeros(len(right))
        try:
            if isinstance(jacobian, np.ndarray):
                x[rows] = np.linalg.solve(jacobian, right[rows])
            else:
                x[rows] = spla.splu(jacobian).solve(right[rows])
        except (RuntimeError, np.linalg.LinAlgError):
            raise SimulationError(
                f"{self.network.name}: an operating point lies at the limit of power transfer, where "
                "voltages have no derivative. Way out: host less."
            ) from None
        return x
