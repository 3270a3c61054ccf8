r"""From a :class:`~dcvrt.dae.Dae` to the functions an integrator calls.

With sensitivities S = dx/dtheta and S_z = dz/dtheta carried beside the states,

.. math::
    \dot S = f_x S + f_z S_z + f_p p_\theta + f_u u_\theta + f_c c_\theta, \qquad
    0 = g_x S + g_z S_z + g_p p_\theta + g_u u_\theta + g_c c_\theta,

as columns of the same system, so that they take part in the integrator's error control: left out of it,
an explicit method runs at its stability limit and S is worthless. Each column is carried times the size of
its parameter. A clock c = t - t_entry has the derivative -dt_entry/dtheta.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dcvrt.dae import Dae
from dcvrt.errors import ModelError

Array = NDArray[np.float64]


def voltage_channels(dae: Dae) -> tuple[int, int] | None:
    """Positions in `u` of the two parts of the POI phasor, or None when the system has no phasor input."""
    parts: dict[str, dict[str, int]] = {}
    for k, name in enumerate(dae.u_names):
        match = re.fullmatch(r"(.*?)[._](re|im)", name)
        if match:
            parts.setdefault(match[1], {})[match[2]] = k
    pairs = {stem: p for stem, p in parts.items() if len(p) == 2}
    if len(pairs) > 1:
        raise ModelError(
            f"{dae.name} has {len(pairs)} phasor inputs ({', '.join(pairs)}); "
            "a simulator drives one, the POI voltage."
        )
    return next(((p["re"], p["im"]) for p in pairs.values()), None)


@dataclass(frozen=True, eq=False)
class Direction:
    """One sensitivity column: a parameter, a tangent of the waveform, or both under one name."""

    name: str
    parameter: int | None
    scale: float


def directions(dae: Dae, wrt: tuple[str, ...]) -> tuple[Direction, ...]:
    """Columns for `wrt`; a name that is no parameter must be a tangent of every waveform given later."""
    found = []
    for name in wrt:
        k = dae.p_names.index(name) if name in dae.p_names else None
        size = abs(dae.parameter_rows[k].value) if k is not None else 1.0
        found.append(Direction(name, k, size or 1.0))
    return tuple(found)


class Equations:
    """Symbolic functions of one system for a set of sensitivity columns.

    Vectors, all dense columns: `X` = [x; S_1 scale_1; ...], `Z` = [z; S_z1 scale_1; ...],
    `P` = [p; q; t_entry of each automaton; dt_entry/dtheta times scale, automata within columns],
    `C` = [start, length, cubic coefficients of each input; then of each phasor tangent] of the piece of the
    inputs that holds at `t`.

    Functions: `rhs` in normalised time for the integrator; `look` (guards, state bounds and their rates);
    `cross` (derivative of the guards for the event time); `flow` (dx/dt); `outputs`; `reset_k`; `algebra`.
    """

    def __init__(self, dae: Dae, wrt: tuple[str, ...], tangents: bool) -> None:
        if not dae.states:
            raise ModelError(
                f"{dae.name} has no states: there is nothing to integrate. Way out: add a block with a state."
            )
        self.dae = dae
        self.columns = directions(dae, wrt)
        self.tangents = tangents and bool(wrt)
        self.nx, self.nz, self.nu, self.np = (s.numel() for s in (dae.x, dae.z, dae.u, dae.p))
        self.nq, self.na, self.nw = dae.q.numel(), len(dae.automata), len(wrt)
        self.rows = [(a, r) for a, automaton in enumerate(dae.automata) for r in automaton.rows]
        self.n_coefficients = 4 * self.nu + (8 * self.nw if self.tangents else 0)
        self.voltage = voltage_channels(dae)
        self.bounds = [
            (k, sign, bound)
            for k, row in enumerate(dae.states)
            for sign, bound in ((-1.0, row.bounds[0]), (1.0, row.bounds[1]))
            if np.isfinite(bound)
        ]
        self._symbols()
        self._inputs_over_time()

    def _symbols(self) -> None:
        self.scale = np.array([c.scale for c in self.columns])
        self.S = ca.SX.sym("S", self.nx, self.nw)
        self.Sz = ca.SX.sym("Sz", self.nz, self.nw)
        self.X = ca.vertcat(self.dae.x, ca.vec(self.S))
        self.Z = ca.vertcat(self.dae.z, ca.vec(self.Sz))
        self.entry = ca.SX.sym("t_entry", self.na)
        self.dentry = ca.SX.sym("dt_entry", self.na, self.nw)
        self.P = ca.vertcat(self.dae.p, self.dae.q, self.entry, ca.vec(self.dentry))
        self.C = ca.SX.sym("C", 2 + self.n_coefficients)

    def _inputs_over_time(self) -> None:
        """Inputs, their rates and the tangents of the phasor: cubics of time with the coefficients in `C`."""
        s = (self.dae.t - self.C[0]) / self.C[1]

        def channel(k: int) -> tuple[ca.SX, ca.SX]:
            c = [self.C[2 + 4 * k + j] for j in range(4)]
            value = c[0] + s * (c[1] + s * (c[2] + s * c[3]))
            return value, (c[1] + s * (2 * c[2] + 3 * s * c[3])) / self.C[1]

        pairs = [channel(k) for k in range(self.nu)]
        self.u_over_time = ca.vertcat(ca.SX(0, 1), *[v for v, _ in pairs])
        self.u_rate_over_time = ca.vertcat(ca.SX(0, 1), *[r for _, r in pairs])
        self.u_rate = ca.SX.sym("du_dt", self.nu)
        self.du, self.du_rate = ca.SX.zeros(self.nu, self.nw), ca.SX.zeros(self.nu, self.nw)
        if self.tangents and self.voltage is not None:
            for j in range(self.nw):
                for part, k in enumerate(self.voltage):
                    value, rate = channel(self.nu + 2 * j + part)
                    self.du[k, j], self.du_rate[k, j] = value, rate

    # -- derivatives --------------------------------------------------------------------------------------

    def _close(self, *expressions: ca.SX) -> list[ca.SX]:
        """Replace inputs, their rates and clocks by what they are over time; dense columns."""
        old = ca.vertcat(self.dae.u, self.u_rate, self.dae.clocks)
        new = ca.vertcat(self.u_over_time, self.u_rate_over_time, self.dae.t - self.entry)
        return [ca.densify(ca.substitute(e, old, new)) for e in expressions]

    def _along_theta(self, expression: ca.SX) -> ca.SX:
        """Total derivative with respect to every theta at fixed time, times its scale: one column each."""
        dae = self.dae
        arguments = ca.vertcat(dae.x, dae.z, dae.p, dae.u, self.u_rate, dae.clocks)
        columns = []
        for j, column in enumerate(self.columns):
            dp = ca.SX.zeros(self.np, 1)
            if column.parameter is not None:
                dp[column.parameter] = column.scale
            moved = (self.S[:, j], self.Sz[:, j], dp, self.du[:, j], self.du_rate[:, j], -self.dentry[:, j])
            columns.append(ca.jtimes(expression, arguments, ca.vertcat(*moved)))
        return ca.horzcat(*columns) if columns else ca.SX(expression.numel(), 0)

    def _along_time(self, expression: ca.SX) -> ca.SX:
        """Total time derivative along the solution."""
        dae = self.dae
        arguments = ca.vertcat(dae.x, dae.t, dae.u, dae.clocks)
        rates = ca.vertcat(dae.f, 1, self.u_rate, ca.SX.ones(self.na, 1))
        if self.nz:
            arguments, rates = ca.vertcat(arguments, dae.z), ca.vertcat(rates, self._z_rate)
        return ca.jtimes(expression, arguments, rates)

    @cached_property
    def _z_rate(self) -> ca.SX:
        """dz/dt from the derivative of 0 = g."""
        dae = self.dae
        known = ca.vertcat(dae.x, dae.t, dae.u, dae.clocks)
        moved = ca.jtimes(dae.g, known, ca.vertcat(dae.f, 1, self.u_rate, ca.SX.ones(self.na, 1)))
        return -ca.solve(ca.densify(ca.jacobian(dae.g, dae.z)), moved)

    def _function(self, name: str, *results: ca.SX) -> ca.Function:
        return ca.Function(name, [self.dae.t, self.X, self.Z, self.P, self.C], self._close(*results))

    # -- what the integrator calls ------------------------------------------------------------------------

    @cached_property
    def functions(self) -> list[ca.Function]:
        """Every function of (t, X, Z, P, C), to be compiled together."""
        dae = self.dae
        guards = ca.vertcat(
            ca.SX(0, 1),
            *[r.guard for _, r in self.rows],
            *[sign * (dae.x[k] - bound) for k, sign, bound in self.bounds],
        )
        made = [
            self._rhs(),
            self._function("look", guards, self._along_time(guards)),
            self._function("flow", dae.f),
            self._function("outputs", *self._outputs()),
        ]
        if self.nw:
            made.append(self._function("cross", self._along_theta(guards)))
        if self.nz:
            made.append(self._function("algebra", dae.g, ca.jacobian(dae.g, dae.z), self._along_theta_of_g()))
        made += [self._reset(k, row.reset) for k, (_, row) in enumerate(self.rows) if row.reset]
        return made

    def _rhs(self) -> ca.Function:
        """dX/dtau and the algebraic residual in normalised time tau; group k has t = t0 + T (tau - k)."""
        dae = self.dae
        tau, k, t0, length = (ca.SX.sym(n) for n in ("tau", "k", "t0", "T"))
        ode, alg = dae.f, dae.g
        if self.nw:
            both = self._along_theta(ca.vertcat(dae.f, dae.g))
            ode = ca.vertcat(ode, ca.vec(both[: self.nx, :]))
            alg = ca.vertcat(alg, ca.vec(both[self.nx :, :]))
        closed = self._close(ode, alg)
        t = t0 + length * (tau - k)
        ode, alg = (ca.densify(ca.substitute(e, dae.t, t)) for e in closed)
        group = ca.vertcat(k, t0, length, self.C)
        return ca.Function(
            "rhs",
            [tau, self.X, self.Z, self.P, group],
            [length * ode, alg],
            ["t", "x", "z", "p", "u"],
            ["ode", "alg"],
        )

    def _outputs(self) -> tuple[ca.SX, ...]:
        y, y_rate = self.dae.y, self._along_time(self.dae.y)
        return (y, y_rate, self._along_theta(y), self._along_theta(y_rate)) if self.nw else (y, y_rate)

    def _along_theta_of_g(self) -> ca.SX:
        """g_theta without the g_z S_z term, which is what S_z is solved from."""
        return ca.substitute(self._along_theta(self.dae.g), self.Sz, ca.SX.zeros(self.nz, self.nw))

    def _reset(self, k: int, reset: Mapping[int, ca.SX]) -> ca.Function:
        dae = self.dae
        after = ca.SX(dae.x)
        for state, expression in reset.items():
            after[state] = expression
        return self._function(f"reset_{k}", after, self._along_time(after), self._along_theta(after))

    @cached_property
    def held(self) -> ca.Function:
        """`held` of every row and its derivative by every theta (times scale)."""
        held = ca.vertcat(ca.SX(0, 1), *[ca.SX(r.held) for _, r in self.rows])
        columns = [
            ca.jacobian(held, self.dae.p[c.parameter]) * c.scale
            if c.parameter is not None
            else ca.SX.zeros(len(self.rows))
            for c in self.columns
        ]
        slopes = ca.horzcat(*columns) if columns else ca.SX(len(self.rows), 0)
        return ca.Function("held", [self.dae.p], [ca.densify(held), ca.densify(slopes)])

    @cached_property
    def rest(self) -> ca.Function:
        """Equilibrium residual of (x, z) at fixed inputs, its Jacobian, and its derivative by p and u."""
        dae = self.dae
        w = ca.vertcat(dae.x, dae.z)
        residual = ca.substitute(
            ca.vertcat(dae.f, dae.g), ca.vertcat(dae.t, dae.clocks), ca.SX.zeros(1 + self.na)
        )
        by_pu = ca.jacobian(residual, ca.vertcat(dae.p, dae.u))
        outputs = [ca.densify(e) for e in (residual, ca.jacobian(residual, w), by_pu)]
        return ca.Function("rest", [w, dae.u, dae.p, dae.q], outputs)

    @cached_property
    def start(self) -> ca.Function:
        """Start values of (x, z) and their derivative by p and u."""
        dae = self.dae
        start = dae.start
        if start.numel() == 0:
            start = ca.SX(ca.DM([r.value for r in (*dae.states, *dae.algebraics)]))
        by_pu = ca.jacobian(start, ca.vertcat(dae.p, dae.u))
        return ca.Function("start", [dae.u, dae.p], [ca.densify(start), ca.densify(by_pu)])
