r"""The equations of the native engine, stepped by the implicit trapezoidal rule.

.. math::
    x_{n+1} - x_n = \tfrac{h}{2} (f_n + f_{n+1}), \qquad V = Z s(x), \qquad f = f(x, V)

with the same steps as ANDES takes, and events that take no time. Both then have the error of the same rule at
the same step, so that what is left between them is what their equations differ by. Slow, and meant for that
alone.

A state that meets its limit in a step ends the step there; one that is pushed back from it leaves in that
step.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from itertools import pairwise

import casadi as ca
import numpy as np
import numpy.typing as npt

from dcvrt.grid.faults import Stage
from dcvrt.grid.native.fleet import Equilibrium
from dcvrt.grid.native.point import NativePoint
from dcvrt.grid.native.structure import Structure, for_units

Floats = npt.NDArray[np.float64]
Phasors = npt.NDArray[np.complex128]

TOLERANCE = 1e-11
"""Last correction of a step, of any state."""
ITERATIONS = 60
CHANGES = 30
"""Changes of mode in one step."""
FREE = "FREE"


class Units:
    """The units of one structure: states, modes, equations with their Jacobians, interpreted."""

    def __init__(self, rest: Equilibrium) -> None:
        self.structure: Structure = rest.group.structure
        if not self.structure.affine:
            raise ValueError("the source of these units depends on their voltage")
        dae = self.structure.dae
        self.automata, self.x, self.p = dae.automata, rest.x.copy(), rest.p
        self.modes = np.tile([a.mode_number(a.start) for a in self.automata], (len(self.x), 1))

    def _function(self, name: str, *results: ca.SX) -> ca.Function:
        s, dae = self.structure, self.structure.dae
        at_rest = [ca.SX.zeros(dae.clocks.numel()), ca.SX(0)]
        made = ca.substitute([ca.densify(r) for r in results], [dae.clocks, dae.t], at_rest)
        return ca.Function(name, [dae.x, s.v, s.p, dae.q], made, {"cse": True})

    @cached_property
    def _rates(self) -> ca.Function:
        s, f = self.structure, self.structure.dae.f
        return self._function("rates", f, ca.jacobian(f, s.dae.x), ca.jacobian(f, s.v))

    @cached_property
    def _source(self) -> ca.Function:
        s = self.structure
        return self._function("source", s.source, ca.jacobian(s.source, s.dae.x))

    @cached_property
    def _guards(self) -> ca.Function:
        s, x = self.structure, self.structure.dae.x
        resets = ca.vertcat(*(row.reset.get(k, x[k]) for _, row in s.rows for k in range(x.numel())))
        return self._function("guards", s.guards[: len(s.rows)], resets)

    @property
    def flags(self) -> Floats:
        """Flags of the present modes (units, flags)."""
        each = [
            np.asarray(a.flags, dtype=float).reshape(len(a.modes), -1)[self.modes[:, k]]
            for k, a in enumerate(self.automata)
        ]
        return np.concatenate([np.zeros((len(self.x), 0)), *each], axis=1)

    def source(self, x: Floats) -> tuple[Phasors, Floats]:
        """Currents, and their Jacobian (units, 2, states)."""
        s, by_x = for_units(self._source, x, np.zeros((len(x), 2)), self.p, self.flags)
        return s[:, 0, 0] + 1j * s[:, 1, 0], by_x

    def rates(self, x: Floats, v: Phasors) -> tuple[Floats, Floats, Floats]:
        """Rates, and their Jacobians by states and voltages."""
        f, by_x, by_v = for_units(self._rates, x, np.stack([v.real, v.imag], axis=1), self.p, self.flags)
        return f[:, :, 0], by_x, by_v

    def change_modes(self, x: Floats, v: Phasors, held: dict[tuple[int, int], float]) -> bool:
        """Let every row fire whose guard is positive; `held` states (unit, state) end the step on a limit."""
        if not self.structure.rows:
            return False
        guard, reset = for_units(self._guards, x, np.stack([v.real, v.imag], axis=1), self.p, self.flags)
        reset = reset[:, :, 0].reshape(len(x), len(self.structure.rows), -1)
        changed = False
        for r, (a, row) in enumerate(self.structure.rows):
            automaton = self.automata[a]
            for k in np.flatnonzero(
                (self.modes[:, a] == automaton.mode_number(row.source)) & (guard[:, r, 0] > 0)
            ):
                self.modes[k, a], changed = automaton.mode_number(row.target), True
                for state in row.reset:
                    if row.target == FREE:
                        held.pop((int(k), state), None)
                    else:
                        held[int(k), state] = float(reset[k, r, state])
        return changed


class Stepper:
    """Steps an operating point of the native engine through the stages of a fault."""

    def __init__(self, point: NativePoint) -> None:
        self.point = point
        self.units = [Units(rest) for rest in point.rest]
        sizes = [units.x.size for units in self.units]
        self._begin = np.cumsum([0, *sizes])

    def _enter(self, stage: Stage) -> None:
        system = self.point.system
        shunts = {system.network.index(bus): y for bus, y in stage.shunts.items()}
        z, _ = self.point._ports(stage.out).impedances(shunts)
        port, at = (np.searchsorted(system.buses, buses) for buses in (system.unit_bus, system.points))
        self._z, self._z_points = z[np.ix_(port, port)], z[np.ix_(at, port)]

    def _split(self, x: Floats) -> list[Floats]:
        parts = zip(self._begin, self._begin[1:], self.units, strict=False)
        return [x[a:b].reshape(units.x.shape) for a, b, units in parts]

    def _sources(self, x: Floats) -> tuple[Phasors, list[Floats]]:
        found = [u.source(part) for u, part in zip(self.units, self._split(x), strict=True)]
        return np.concatenate([s for s, _ in found]), [by_x for _, by_x in found]

    def _voltages(self, s: Phasors) -> list[Phasors]:
        ends = np.cumsum([len(units.x) for units in self.units])[:-1]
        return np.split(self._z @ s, ends)

    def _rates(self, x: Floats) -> Floats:
        v = self._voltages(self._sources(x)[0])
        return np.concatenate(
            [
                u.rates(part, own)[0].ravel()
                for u, part, own in zip(self.units, self._split(x), v, strict=True)
            ]
        )

    def _change_modes(self, x: Floats, held: list[dict[tuple[int, int], float]]) -> bool:
        v = self._voltages(self._sources(x)[0])
        parts = zip(self.units, self._split(x), v, held, strict=True)
        return any([u.change_modes(part, own, on) for u, part, own, on in parts])

    def _jacobian(self, x: Floats) -> tuple[Floats, Floats]:
        """Rates, and their Jacobian by all states: through the own state, and through all voltages."""
        s, s_by_x = self._sources(x)
        n, units = len(x), len(s)
        by_state, v_by_x, f_by_v = np.zeros((n, n)), np.zeros((2 * units, n)), np.zeros((n, 2 * units))
        f, first = np.zeros(n), 0
        for u, part, own, begin, slope in zip(
            self.units, self._split(x), self._voltages(s), self._begin, s_by_x, strict=False
        ):
            rate, f_x, f_v = u.rates(part, own)
            nx = part.shape[1]
            for k in range(len(part)):
                at = slice(begin + k * nx, begin + (k + 1) * nx)
                f[at], by_state[at, at] = rate[k], f_x[k]
                f_by_v[at, first + k], f_by_v[at, units + first + k] = f_v[k].T
                z = self._z[:, first + k, None] * (slope[k, 0] + 1j * slope[k, 1])
                v_by_x[:units, at], v_by_x[units:, at] = z.real, z.imag
            first += len(part)
        return f, by_state + f_by_v @ v_by_x

    def _step(self, x: Floats, f: Floats, h: float) -> Floats:
        """States at the end of a step."""
        held: list[dict[tuple[int, int], float]] = [{} for _ in self.units]
        x1 = x + h * f
        for _ in range(CHANGES):
            x1 = self._newton(x, f, x1, h, held)
            if not self._change_modes(x1, held):
                return x1
        raise ArithmeticError("modes did not settle")

    def _newton(
        self, x: Floats, f: Floats, x1: Floats, h: float, held: list[dict[tuple[int, int], float]]
    ) -> Floats:
        on = {
            int(begin) + k * units.x.shape[1] + state: value
            for begin, units, states in zip(self._begin, self.units, held, strict=False)
            for (k, state), value in states.items()
        }
        rows, values = np.array(list(on), dtype=int), np.array(list(on.values()))
        f1, by_x = self._jacobian(x1)
        matrix = np.eye(len(x)) - 0.5 * h * by_x
        matrix[rows] = np.eye(len(x))[rows]
        inverse = np.linalg.inv(matrix)
        for _ in range(ITERATIONS):
            rest = x1 - x - 0.5 * h * (f + f1)
            rest[rows] = x1[rows] - values
            move = inverse @ rest
            x1 = x1 - move
            if np.abs(move).max() < TOLERANCE:
                return x1
            f1 = self._rates(x1)
        raise ArithmeticError("Newton's method did not settle")

    def run(self, stages: Sequence[Stage], times: Sequence[Floats]) -> Phasors:
        """Voltages at the points on the sample times, each a step; arguments as those of the engine."""
        point = self.point
        found = [np.tile(point.v0[point.system.points], (len(times[0]), 1))]
        x = np.concatenate([units.x.ravel() for units in self.units])
        for stage, t in zip(stages[1:], times[1:], strict=True):
            self._enter(stage)
            while self._change_modes(x, [{} for _ in self.units]):
                pass
            found.append((self._z_points @ self._sources(x)[0])[None])
            for a, b in pairwise(t):
                x = self._step(x, self._rates(x), float(b - a))
                found.append((self._z_points @ self._sources(x)[0])[None])
        return np.concatenate(found)
