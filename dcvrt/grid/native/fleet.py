"""Units of a grid in groups of one structure: parameters, equilibrium with named residuals, its derivatives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
import numpy.typing as npt

from dcvrt.errors import InputError, SimulationError
from dcvrt.grid.native.text import Structure

Floats = npt.NDArray[np.float64]
Phasors = npt.NDArray[np.complex128]

TOLERANCE = 1e-12
"""Residual of an equilibrium that ends the search, of each equation."""
ACCEPTED = 1e-9
"""Largest residual of an equilibrium."""
STEPS = 40


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
    setpoints : sequence of str
        Parameters that follow from the operating point.
    inertia, reactance : str
        Of a rotor: the parameter that weighs its angle, and that behind which the q-axis lies.
    """

    structure: Structure
    units: Sequence[Unit]
    setpoints: Sequence[str] = ()
    inertia: str = ""
    reactance: str = ""

    @cached_property
    def p(self) -> Floats:
        """Parameters (units, parameters of the structure); set-points and shunts still to be filled in."""
        dae = self.structure.dae
        rest = [row.value for row in dae.inputs if row.path in self.structure.others]
        default = np.array([*(row.value for row in dae.parameter_rows), *rest, 1.0, 0.0, 0.0])
        p = np.tile(default, (len(self.units), 1))
        for k, unit in enumerate(self.units):
            for path, value in unit.values.items():
                p[k, self.structure.column(path)] = value
        if not self.structure.affine:
            p[:, -2:] = self._typical_shunt(p)
        return p

    def _typical_shunt(self, p: Floats) -> Floats:
        """Mean slope of the current at rest values: it leaves little for the iteration over voltages."""
        s, dae = self.structure, self.structure.dae
        x = np.array([row.value for row in dae.states])
        at = ca.substitute(
            [ca.densify(s.slope)],
            [dae.q, dae.clocks, dae.t, dae.x, s.v],
            [self._flags, ca.SX.zeros(len(dae.automata)), 0, ca.DM(x), ca.DM([1.0, 0.0])],
        )[0]
        slopes = np.array(ca.Function("typical", [s.p], [at]).map(len(p))(p.T)).reshape(2, len(p), 2)
        mean = 0.5 * np.stack([slopes[0, :, 0] + slopes[1, :, 1], slopes[1, :, 0] - slopes[0, :, 1]], axis=1)
        return np.where(np.isfinite(mean), -mean, 0.0)

    @cached_property
    def setpoint_columns(self) -> list[int]:
        """Positions of the set-points among the parameters."""
        return [self.structure.column(path) for path in self.setpoints]

    # -- functions of many units, interpreted --------------------------------------------------------------

    @cached_property
    def _flags(self) -> ca.DM:
        return ca.vertcat(
            *(ca.DM(a.flags[a.mode_number(a.start)]) for a in self.structure.dae.automata)
        ) if self.structure.dae.automata else ca.DM(0, 1)  # fmt: skip

    @cached_property
    def _rest(self) -> ca.Function:
        """Start values, residual of the equilibrium and its Jacobians, of one unit in its first modes."""
        s, dae = self.structure, self.structure.dae
        clocks = ca.SX.zeros(len(dae.automata))
        wanted = ca.SX.sym("current", 2)
        columns = [s.p[k] for k in self.setpoint_columns]
        unknown = ca.vertcat(dae.x, *columns)
        residual = ca.vertcat(dae.f, s.i - wanted) if self.setpoints else dae.f
        own = [dae.q, dae.clocks, dae.t]
        at_rest = [self._flags, clocks, 0]
        made = [
            residual,
            ca.densify(ca.jacobian(residual, unknown)),
            ca.densify(ca.jacobian(residual, s.v)),
            s.guards,
            s.i,
            ca.densify(ca.jacobian(s.i, ca.vertcat(unknown, s.v))),
        ]
        made = [ca.substitute([e], own, at_rest)[0] for e in made]
        return ca.Function("rest", [dae.x, s.v, s.p, wanted], made, {"cse": True})

    @cached_property
    def _start(self) -> ca.Function:
        s, dae = self.structure, self.structure.dae
        start = ca.substitute([dae.start], [dae.t, dae.clocks, dae.q], [0, ca.SX.zeros(len(dae.automata)), self._flags])[0]
        return ca.Function("start", [s.v, s.p], [start])

    @cached_property
    def _shunt(self) -> ca.Function:
        s = self.structure
        return ca.Function("shunt", [s.p], [ca.densify(s.slope)])

    @cached_property
    def _held(self) -> ca.Function:
        s = self.structure
        held = [row.held for _, row in s.rows]  # type: ignore[attr-defined]
        return ca.Function("held", [s.p], [ca.densify(ca.vertcat(ca.SX(0, 1), *held))])

    def held(self, p: Floats) -> Floats:
        """Dwell times (units, rows), s."""
        if not self.structure.rows:
            return np.zeros((len(p), 0))
        return np.array(self._held.map(len(p))(p.T)).reshape(len(self.structure.rows), len(p)).T

    def shunts(self) -> Phasors:
        """Admittance that the network holds for each unit."""
        if not self.structure.affine:
            return self.p[:, -2] + 1j * self.p[:, -1]
        slopes = np.array(self._shunt.map(len(self.units))(self.p.T)).reshape(2, len(self.units), 2)
        return -(slopes[0, :, 0] + 1j * slopes[1, :, 0])

    def equilibrium(self, v: Phasors, i: Phasors, where: str) -> Equilibrium:
        """States and set-points at rest, for given terminal voltages and currents into the network.

        Raises
        ------
        SimulationError
            When there is none for some unit, with its largest residuals by name; when a limit is exceeded.
        """
        n, dae = len(self.units), self.structure.dae
        p = self.p.copy()
        volts = np.vstack([v.real, v.imag])
        current = np.vstack([i.real, i.imag])
        x = np.array(self._start.map(n)(volts, p.T)).reshape(-1, n)[: dae.x.numel()].T.copy()
        if self.structure.angle:  # the rest is nearly linear once the q-axis is known
            behind = p[:, dae.parameter_number(self.reactance)]
            x[:, dae.x_names.index(self.structure.angle)] = np.angle(v + 1j * behind * i)
        rest = self._rest.map(n)
        columns = self.setpoint_columns
        nx, size = dae.x.numel(), dae.x.numel() + len(columns)
        last = np.full(n, np.inf)
        for step in range(STEPS + 1):
            residual, jacobian, by_v, guards, now, slopes = (
                np.array(a) for a in rest(x.T, volts, p.T, current)
            )
            r, j = residual.T, jacobian.reshape(size, n, size).transpose(1, 0, 2)
            level = np.abs(r).max(axis=1, initial=0.0)
            settled = bool((level < TOLERANCE).all()) or (
                step > 3 and bool((level < ACCEPTED).all() and (level >= 0.5 * last).all())
            )
            if settled or not np.isfinite(r).all() or step == STEPS:
                break
            last = level
            try:
                move = self._inverse(j) @ r[:, :, None]
            except np.linalg.LinAlgError:  # singular: told below, by the residuals that are left
                break
            x -= move[:, :nx, 0]
            p[:, columns] -= move[:, nx:, 0]
        self._check(r, where)
        over = guards.T if guards.size else np.zeros((n, 0))
        self._check_limits(over, where)
        return Equilibrium(
            self, x, p, self._inverse(j), by_v.reshape(size, n, 2).transpose(1, 0, 2), now[0] + 1j * now[1],
            slopes.reshape(2, n, size + 2).transpose(1, 0, 2), float(level.max(initial=0.0)),
        )  # fmt: skip

    def _inverse(self, jacobian: Floats) -> Floats:
        """Inverse Jacobians. A unit without set-points may rest anywhere along some direction, as a battery does
        at any charge: it stays where it starts."""
        return np.linalg.inv(jacobian) if self.setpoints else np.linalg.pinv(jacobian, rcond=1e-11)

    def _check(self, residual: Floats, where: str) -> None:
        worst = np.nan_to_num(np.abs(residual), nan=np.inf).max(axis=1, initial=0.0)
        bad = np.flatnonzero(worst > ACCEPTED)
        if not len(bad):
            return
        k = int(bad[np.argmax(worst[bad])])
        rows = [row.path for row in self.structure.dae.states] + ["active current", "reactive current"]
        order = np.argsort(-np.nan_to_num(np.abs(residual[k]), nan=np.inf))[:5]
        named = ", ".join(f"{rows[j]} {residual[k, j]:.3g}" for j in order)
        raise SimulationError(
            f"{where}: {len(bad)} unit(s) have no equilibrium; largest residuals of {self.units[k].name} at bus "
            f"{self.units[k].bus}: {named}. Way out: host less, or check its data."
        )

    def _check_limits(self, guards: Floats, where: str) -> None:
        rows, automata = self.structure.rows, self.structure.dae.automata
        broken = []
        for r, (a, row) in enumerate(rows):
            if row.source != automata[a].start:  # type: ignore[attr-defined]
                continue
            broken += [
                f"{self.units[k].name} at bus {self.units[k].bus}: {automata[a].path}, {row.text}"  # type: ignore[attr-defined]
                for k in np.flatnonzero(guards[:, r] > 1e-9)
            ]
        states = self.structure.dae.states
        for b, (state, _, bound) in enumerate(self.structure.bounds):
            broken += [
                f"{self.units[k].name} at bus {self.units[k].bus}: {states[state].path} is beyond {bound:g}"
                for k in np.flatnonzero(guards[:, len(rows) + b] > 1e-9)
            ]
        if broken:
            more = f"; and {len(broken) - 4} more" if len(broken) > 4 else ""
            raise SimulationError(
                f"{where}: {len(broken)} limit(s) are exceeded before the fault: {'; '.join(broken[:4])}{more}. "
                "Way out: host less, or give the unit a wider limit."
            )


@dataclass(frozen=True, eq=False)
class Equilibrium:
    """States and set-points of a group at rest.

    Parameters
    ----------
    group : Group
    x : array (units, states)
    p : array (units, parameters)
    inverse : array (units, n, n)
        Of the Jacobian of the residuals by states and set-points.
    by_v : array (units, n, 2)
        Jacobian of the residuals by the terminal voltage.
    current : complex array (units,)
        Into the network.
    slopes : array (units, 2, n + 2)
        Of the current by states and set-points, then by the voltage.
    residual : float
        Largest residual left.
    """

    group: Group
    x: Floats
    p: Floats
    inverse: Floats
    by_v: Floats
    current: Phasors
    slopes: Floats
    residual: float

    def derivatives(self, dv: Phasors, di: Phasors) -> tuple[Floats, Floats]:
        """Derivatives of states and set-points, for those of terminal voltages and currents (units, thetas).

        Returns
        -------
        dx : array (units, states, thetas)
        dsetpoints : array (units, set-points, thetas)
        """
        nx = self.x.shape[1]
        right = self.by_v @ np.stack([dv.real, dv.imag], axis=1)
        if self.group.setpoints:
            right[:, nx:] -= np.stack([di.real, di.imag], axis=1)
        moved = -self.inverse @ right
        return moved[:, :nx], moved[:, nx:]

    def current_by_v(self, dv: Phasors) -> Phasors:
        """Derivative of the current at rest, for those of terminal voltages (units, thetas)."""
        moved, _ = self.derivatives(dv, np.zeros_like(dv))
        volts = np.stack([dv.real, dv.imag], axis=1)
        parts = self.slopes @ np.concatenate([moved, volts], axis=1)
        return parts[:, 0] + 1j * parts[:, 1]


def check_one_at_each_bus(groups: Sequence[Group], where: str) -> None:
    """Refuse two units of the same name: messages could not tell them apart."""
    names = [unit.name for group in groups for unit in group.units]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InputError(f"{where}: several units are called {', '.join(twice)}.")
