"""Units of a grid in groups of one structure: parameters, equilibrium and its derivatives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from dcvrt.errors import SimulationError
from dcvrt.grid.native.structure import Structure, for_units

Floats = npt.NDArray[np.float64]
Phasors = npt.NDArray[np.complex128]

TOLERANCE = 1e-12
"""Residual of an equilibrium that ends the search, of each equation."""
ACCEPTED = 1e-9
"""Largest residual of an equilibrium."""
STEPS = 40
AT_REST = 1e-8
"""Guard, of rates at rest, that counts as zero."""
ON_LIMIT = 1e-4
"""Distance beyond a limit, pu, at which a unit may start and counts as on it: data in four digits leave so
much. Both engines tell of it."""


@dataclass(frozen=True)
class Unit:
    """One device, or one plant with its controls, at a bus.

    Parameters
    ----------
    name : str
        What messages call it.
    bus : int
    values : mapping of parameter path to value
    share_p, share_q : float
        Part of the bus's generation that it feeds in.
    """

    name: str
    bus: int
    values: Mapping[str, float]
    share_p: float = 1.0
    share_q: float = 1.0


@dataclass(frozen=True, eq=False)
class Group:
    """Units of one structure.

    Parameters
    ----------
    structure : Structure
    units : sequence of Unit
    power : str
        Whose power at the bus they feed in: that of its `generation`, of its (negative) `load`, of its
        `wind`.
    tolerance : float
        Error of its states in a run, over that of the run's options.
    quick : bool
        Whether its lags are shorter than those of the others, so that it may take steps of its own inside
        theirs. Such groups are the last ones.
    """

    structure: Structure
    units: Sequence[Unit]
    power: str = "generation"
    tolerance: float = 1.0
    quick: bool = False

    @cached_property
    def p(self) -> Floats:
        """Parameters (units, parameters of the structure); set-points still to be found."""
        s = self.structure
        rest = [row.value for row in s.dae.inputs if row.path in s.others]
        default = np.array([*(row.value for row in s.dae.parameter_rows), *rest, 1.0, 0.0, 0.0])
        p = np.tile(default, (len(self.units), 1))
        for k, unit in enumerate(self.units):
            for path, value in unit.values.items():
                p[k, s.column(path)] = value
        if not s.affine:
            p[:, -2:] = self._typical_shunt(p)
        return p

    def _typical_shunt(self, p: Floats) -> Floats:
        """Mean slope of the current at rest values: it leaves little for the iteration over voltages."""
        x = np.tile([row.value for row in self.structure.dae.states], (len(p), 1))
        v = np.tile([1.0, 0.0], (len(p), 1))
        slopes = self._slopes(x, v, p)
        mean = 0.5 * np.stack([slopes[:, 0, 0] + slopes[:, 1, 1], slopes[:, 1, 0] - slopes[:, 0, 1]], axis=1)
        return np.where(np.isfinite(mean), -mean, 0.0)

    def _slopes(self, x: Floats, v: Floats, p: Floats) -> Floats:
        """di/dv as (units, 2, 2)."""
        return for_units(self.structure.slopes, x, v, p)[0]

    def shunts(self) -> Phasors:
        """Admittance that the network holds for each unit."""
        if not self.structure.affine:
            return self.p[:, -2] + 1j * self.p[:, -1]
        n = len(self.units)
        slopes = self._slopes(np.zeros((n, self.structure.dae.x.numel())), np.zeros((n, 2)), self.p)
        return -(slopes[:, 0, 0] + 1j * slopes[:, 1, 0])

    def held(self, p: Floats) -> Floats:
        """Dwell times (units, rows), s."""
        if not self.structure.rows:
            return np.zeros((len(p), 0))
        return for_units(self.structure.held, p)[0][:, :, 0]

    def equilibrium(self, v: Phasors, i: Phasors, where: str) -> Equilibrium:
        """States and set-points at rest, for given terminal voltages and currents into the network.

        Raises
        ------
        SimulationError
            When there is none for some unit, with its largest residuals by name; when a limit is exceeded.
        """
        s, n = self.structure, len(self.units)
        columns, nx = [s.column(path) for path in s.setpoints], s.dae.x.numel()
        volts, current = (np.stack([a.real, a.imag], axis=1) for a in (v, i))
        p, x = self.p.copy(), for_units(s.start, volts, self.p)[0][:, :, 0].copy()
        if s.angle:  # the rest is nearly linear once the q-axis is known
            x[:, s.dae.x_names.index(s.angle)] = np.angle(v + 1j * p[:, s.column(s.reactance)] * i)
        last = np.full(n, np.inf)
        for step in range(STEPS + 1):
            r, j = for_units(s.balance, x, volts, p, current)
            r = r[:, :, 0]
            level = np.abs(r).max(axis=1, initial=0.0)
            stalled = step > 3 and bool((level < ACCEPTED).all() and (level >= 0.5 * last).all())
            if (level < TOLERANCE).all() or stalled or not np.isfinite(r).all() or step == STEPS:
                break
            last = level
            try:
                move = self._solve(j, r[:, :, None])
            except np.linalg.LinAlgError:  # singular: told below, by the residuals that are left
                break
            x -= move[:, :nx, 0]
            p[:, columns] -= move[:, nx:, 0]
        self._check(r, where)
        by_given, guards, moves, now, slopes = for_units(s.at_rest, x, volts, p, current)
        notes = self._check_limits(guards[:, :, 0], moves[:, :, 0], where) if s.setpoints else ()
        return Equilibrium(
            self, x, p, j, by_given, now[:, 0, 0] + 1j * now[:, 1, 0], slopes,
            float(level.max(initial=0.0)), notes,
        )  # fmt: skip

    def _solve(self, jacobian: Floats, right: Floats) -> Floats:
        """Change of the unknowns. A unit without set-points may rest anywhere along some direction, as a
        battery does at any charge: it stays where it starts."""
        if self.structure.setpoints:
            return np.asarray(np.linalg.solve(jacobian, right), dtype=np.float64)
        return np.asarray(np.linalg.pinv(jacobian, rcond=1e-11) @ right, dtype=np.float64)

    def _check(self, residual: Floats, where: str) -> None:
        worst = np.nan_to_num(np.abs(residual), nan=np.inf).max(axis=1, initial=0.0)
        bad = np.flatnonzero(worst > ACCEPTED)
        if not len(bad):
            return
        k = int(bad[np.argmax(worst[bad])])
        rows = [row.path for row in self.structure.dae.states] + ["active current", "reactive current"]
        order = np.argsort(-np.nan_to_num(np.abs(residual[k]), nan=np.inf))[:5]
        named = ", ".join(f"{rows[j]} {residual[k, j]:.3g}" for j in order)
        way_out = "host less" if self.structure.setpoints else "a higher rating of the facility, or less load"
        raise SimulationError(
            f"{where}: {len(bad)} unit(s) have no equilibrium; largest residuals of {self.units[k].name} at "
            f"bus {self.units[k].bus}: {named}. Way out: {way_out}, or check its data."
        )

    def _check_limits(self, guards: Floats, moves: Floats, where: str) -> tuple[str, ...]:
        """Refuse a start outside a limit; a sentence for each that counts as on it.

        At rest nothing pushes, so the guard of a limit that also asks for that is zero to rounding; how far
        the limit is exceeded is then how far its row would move the state.
        """
        rows, automata = self.structure.rows, self.structure.dae.automata
        broken, notes = [], []
        beyond = np.maximum(guards[:, : len(rows)], moves)
        for r, (a, row) in enumerate(rows):
            if row.source != automata[a].start:
                continue
            for k in np.flatnonzero((guards[:, r] > -AT_REST) & (beyond[:, r] > AT_REST)).tolist():
                text = f"{self.units[k].name} at bus {self.units[k].bus}: {automata[a].path}, {row.text}"
                if beyond[k, r] > ON_LIMIT:
                    broken.append(f"{text} by {beyond[k, r]:.3g} pu")
                else:
                    notes.append(f"{text} by {beyond[k, r]:.1g} pu")
        states = self.structure.dae.states
        for b, (state, _, bound) in enumerate(self.structure.bounds):
            broken += [
                f"{self.units[k].name} at bus {self.units[k].bus}: {states[state].path} is beyond {bound:g}"
                for k in np.flatnonzero(guards[:, len(rows) + b] > 1e-9).tolist()
            ]
        if broken:
            more = f"; and {len(broken) - 4} more" if len(broken) > 4 else ""
            raise SimulationError(
                f"{where}: {len(broken)} limit(s) are exceeded before the fault: "
                f"{'; '.join(broken[:4])}{more}. "
                "Way out: host less, or give the unit a wider limit."
            )
        return tuple(notes)


@dataclass(frozen=True, eq=False)
class Equilibrium:
    """States and set-points of a group at rest.

    Parameters
    ----------
    group : Group
    x : array (units, states)
    p : array (units, parameters)
    jacobian : array (units, n, n)
        Of the residuals by states and set-points.
    by_given : array (units, n, 2 + varied)
        Jacobian of the residuals by the terminal voltage and the parameters that are varied.
    current : complex array (units,)
        Into the network.
    slopes : array (units, 2, n + 2 + varied)
        Of the current by states and set-points, then by the voltage and the parameters that are varied.
    residual : float
        Largest residual left.
    notes : tuple of str
        Units that start beyond a limit by so little that they count as on it.
    """

    group: Group
    x: Floats
    p: Floats
    jacobian: Floats
    by_given: Floats
    current: Phasors
    slopes: Floats
    residual: float
    notes: tuple[str, ...]

    def derivatives(self, dv: Phasors, di: Phasors, dvaried: Floats | None = None) -> tuple[Floats, Floats]:
        """Derivatives of states and set-points, for those of terminal voltages and currents (units, thetas).

        Parameters
        ----------
        dv, di : complex arrays (units, thetas)
        dvaried : array (units, varied, thetas), optional
            Derivatives of the parameters that are varied; they stand still when not given.

        Returns
        -------
        dx : array (units, states, thetas)
        dsetpoints : array (units, set-points, thetas)
        """
        nx = self.x.shape[1]
        if not dv.shape[1]:
            return np.zeros((*self.x.shape, 0)), np.zeros((len(self.x), self.jacobian.shape[2] - nx, 0))
        right = self.by_given @ self._given(dv, dvaried)
        if self.group.structure.setpoints:
            right[:, nx:] -= np.stack([di.real, di.imag], axis=1)
        moved = -self.group._solve(self.jacobian, right)
        return moved[:, :nx], moved[:, nx:]

    def current_derivative(self, dv: Phasors, dvaried: Floats) -> Phasors:
        """Derivative of the current at rest (units, thetas); arguments as those of `derivatives`."""
        moved, _ = self.derivatives(dv, np.zeros_like(dv), dvaried)
        parts = self.slopes @ np.concatenate([moved, self._given(dv, dvaried)], axis=1)
        return parts[:, 0] + 1j * parts[:, 1]

    def _given(self, dv: Phasors, dvaried: Floats | None) -> Floats:
        still = np.zeros((len(dv), len(self.group.structure.varied), dv.shape[1]))
        return np.concatenate(
            [dv.real[:, None], dv.imag[:, None], still if dvaried is None else dvaried], axis=1
        )
