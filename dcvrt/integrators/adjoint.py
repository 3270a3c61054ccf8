r"""Gradients of functionals by one sweep backwards in time, at a cost that does not grow with the thetas.

For a functional J with weights on the samples, lambda = dJ/dx is carried backwards: over a smooth stretch by
CasADi's adjoint of its multistep integrator, which controls the error of lambda (the adjoint of an explicit
method does not, and is worthless where that method runs at its stability limit); at a sample by its weight;
at a break by the transpose of the jump term. With S^+ = R_\theta + (\dot R - f^+) dt_e/dtheta and
dt_e/dtheta = -h_\theta/\dot h,

.. math::
    \tau \mathrel{+}= \lambda^{+\mathsf T} (\dot R - f^+), \qquad
    \lambda^- = R_x^{\mathsf T} \lambda^+ - h_x^{\mathsf T} \tau / \dot h, \qquad
    J_\theta \mathrel{+}= R_\theta^{\mathsf T} \lambda^+ - h_\theta^{\mathsf T} \tau / \dot h .

tau is the weight on the time of the event; the entry time of a mode and the start of a timer hand theirs on
to it. At the start the derivative of the equilibrium takes what is left of lambda.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, Literal

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dcvrt.dae import Dae
from dcvrt.errors import InputError, SimulationError
from dcvrt.integrators.casadi import Casadi, bind
from dcvrt.integrators.channels import Channels
from dcvrt.integrators.equations import Equations
from dcvrt.integrators.recorded import Break, Cause, Point, RecordedRun
from dcvrt.integrators.slopes import Columns, Leaf, Slope, breaks
from dcvrt.trajectory import Trajectory

Array = NDArray[np.float64]
TIGHTER, TIGHTEST = 1e-2, 1e-10
"""Tolerance of the sweep over that of the run; the least that a multistep method reaches in useful time."""


class Backwards:
    """Transposed derivatives of the functions of a system, and of its flow over a stretch."""

    def __init__(self, equations: Equations, solver: Casadi) -> None:
        self.equations = equations
        self.plugin = "idas" if equations.nz else "cvodes"
        rtol = max(solver.rtol * TIGHTER, TIGHTEST)
        rhs = equations.functions[0]
        tau = ca.SX.sym("tau")
        x, z, P, group = (ca.SX.sym(n, rhs.numel_in(n)) for n in ("x", "z", "p", "u"))
        ode, alg = rhs(tau, x, z, P, group)
        dae = {"t": tau, "x": x, "z": z, "p": ca.vertcat(P, group), "ode": ode, "alg": alg}
        if not equations.nz:
            del dae["z"], dae["alg"]
        options = {
            "reltol": rtol,
            "abstol": rtol * 1e-2,
            "nadj": 1,
            "quad_err_con": True,  # the weights on parameters are quadratures
            "max_num_steps": 100_000,
            # going back, no more than 500 steps are made between two checkpoints: keep these close
            "steps_per_checkpoint": 1,
            "max_step_size": 0.02,
            "disable_internal_warnings": True,
        }
        self.stretch = ca.integrator("backwards", self.plugin, dae, 0.0, [1.0], options)
        self.x0, self.z0 = np.zeros(equations.nx), np.zeros(equations.nz)
        self.p, self.adj_x = np.zeros(P.numel() + group.numel()), np.zeros(equations.nx)
        self.adj_x0, self.adj_p = np.zeros(equations.nx), np.zeros(len(self.p))
        self._buffer, self._call = bind(
            self.stretch,
            {"x0": self.x0, "z0": self.z0, "p": self.p, "adj_xf": self.adj_x},
            {"adj_x0": self.adj_x0, "adj_p": self.adj_p},
        )
        functions = {f.name(): f for f in equations.functions}
        self.transposed = lru_cache(maxsize=None)(lambda name: functions[name].reverse(1))
        self.at = lru_cache(maxsize=None)(lambda name: functions[name])

    def over(self, begin: float, end: float, X: Array, Z: Array, P: Array, C: Array, weight: Array) -> bool:
        """Pull `weight` on x(end) back to x(begin): in `adj_x0` and `adj_p` = [P; 0, begin, length, C].

        False when the way is too long for the integrator.
        """
        size = float(np.abs(weight).max())  # the problem is linear: its tolerance is meant for numbers near 1
        self.x0[:], self.z0[:], self.adj_x[:] = X, Z, weight / size
        self.p[:] = np.concatenate((P, [0.0, begin, end - begin], C))
        try:
            self._call()
        except RuntimeError:
            return False
        self.adj_x0 *= size
        self.adj_p *= size
        return bool(np.isfinite(self.adj_x0).all())

    def pull(
        self, name: str, point: Point, C: Array, weights: Mapping[int, Array]
    ) -> tuple[Array, Array, Array]:
        """Weights on results of a function, by number, pulled back to x, P and C; z is solved for."""
        eq = self.equations
        ax, az, aP, aC = self._transpose(name, point, C, weights)
        if eq.nz:
            _, jacobian, _ = (np.array(m) for m in self.at("algebra")(point.t, point.X, point.Z, point.P, C))
            m = np.asarray(-np.linalg.solve(jacobian.T, az), dtype=np.float64)
            bx, _, bP, bC = self._transpose("algebra", point, C, {0: m})
            ax, aP, aC = ax + bx, aP + bP, aC + bC
        return ax, aP, aC

    def _transpose(
        self, name: str, point: Point, C: Array, weights: Mapping[int, Array]
    ) -> tuple[Array, Array, Array, Array]:
        function = self.at(name)
        arguments: list[Any] = [point.t, point.X, point.Z, point.P, C]
        n = function.n_out()
        results = [ca.DM(*function.size_out(k)) for k in range(n)]
        seeds = [
            ca.DM(weights[k]).reshape(function.size_out(k)) if k in weights else ca.DM(*function.size_out(k))
            for k in range(n)
        ]
        _, ax, az, aP, aC = (np.array(m)[:, 0] for m in self.transposed(name)(*arguments, *results, *seeds))
        return ax, az, aP, aC


@dataclass(frozen=True, eq=False)
class Adjoint:
    """Everything that a sweep through one run reads; called with a slope it returns the gradient.

    Attributes
    ----------
    named : equations that know the thetas (their parameters, tangents, scales), for names only.
    inputs : pieces with the tangents of the thetas.
    start : derivative of (x, z) at the start by every theta.
    """

    backwards: Backwards
    run: RecordedRun
    named: Equations
    inputs: Channels
    start: Array

    def gradient(self, slope: object, sign: float = 1.0) -> Mapping[str, float]:
        """Derivative by every theta, when it is asked for; 0 or NaN for what is a number already."""
        names = tuple(c.name for c in self.named.columns)
        if not isinstance(slope, Slope):
            return dict.fromkeys(names, sign * float(slope))  # type: ignore[arg-type]
        return Gradient(self, slope * sign, names)

    def sweep(self, weights: Mapping[Leaf, float]) -> Array:
        """Gradient of the form with these weights."""
        return Sweep(self).through(weights)


def adjoint_solver(dae: Dae, solver: object, wrt: tuple[str, ...]) -> Casadi:
    """Solver of a simulator with mode="adjoint".

    Raises
    ------
    InputError
        no thetas, or another solver than CasADi's.
    """
    if not wrt:
        raise InputError("mode = 'adjoint' without wrt: nothing to derive by. Way out: wrt=dae.p_names.")
    default = Casadi("rosenbrock" if dae.z.numel() else "erk")
    if solver is None:
        return default
    if not isinstance(solver, Casadi):
        raise InputError(
            f"mode = 'adjoint' with solver = {solver!r}: the adjoint runs through CasADi. "
            f"Ways out: solver=Casadi({default.plugin!r}), or mode='forward'."
        )
    return solver


def plain(named: Equations, inputs: Channels) -> Channels:
    """The inputs without the tangents of the thetas."""
    return replace(inputs, C=np.ascontiguousarray(inputs.C[:, : 2 + 4 * named.nu]))


def with_gradients(run: Trajectory, adjoint: Adjoint) -> Trajectory:
    """A run whose functionals and margins get their gradients from sweeps."""
    n, outputs = len(run.t), run.outputs
    slopes: Any = replace(outputs, sens=Columns("value", n), rate_sens=Columns("rate", n))  # type: ignore[arg-type]
    return replace(run, outputs=slopes, break_grad=breaks(len(run.breaks)), adjoint=adjoint)


class Gradient(Mapping[str, float]):
    """Derivatives by name; the sweep runs when the first one is read."""

    def __init__(self, adjoint: Adjoint, slope: Slope, names: tuple[str, ...]) -> None:
        self._adjoint, self._slope, self._names = adjoint, slope, names

    @cached_property
    def _values(self) -> dict[str, float]:
        found = self._adjoint.sweep(self._slope.weights())
        return dict(zip(self._names, found.tolist(), strict=True))

    def __getitem__(self, name: str) -> float:
        return self._values[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)

    def __repr__(self) -> str:
        return repr(self._values)


class Sweep:
    """One pass from the last phase to the first. `x`, `P`: weights on the state and on [p; q; t_entry]."""

    def __init__(self, adjoint: Adjoint) -> None:
        self.a, self.back, self.run = adjoint, adjoint.backwards, adjoint.run
        eq = self.back.equations
        self.x, self.P = np.zeros(eq.nx), np.zeros(eq.np + eq.nq + eq.na)
        self.theta = np.zeros(adjoint.named.nw)
        self.entry = eq.np + eq.nq
        self.scale = adjoint.named.scale
        _, held = adjoint.named.held(self.run.p)
        self.held = np.array(held) / self.scale

    def through(self, weights: Mapping[Leaf, float]) -> Array:
        """Gradient by every theta."""
        for phase in self.run.into:
            for one in phase:
                one.cause.weight = 0.0
        for inside in self.run.inside:
            for cause in inside:
                cause.weight = 0.0
        if any(np.isnan(w) for w in weights.values()):
            return np.full(len(self.theta), np.nan)
        starts = np.cumsum([0, *(len(t) for t, _, _ in self.run.samples)])
        on_samples: dict[int, dict[int, Array]] = {}
        sizes = {"value": 0, "rate": 1}
        for (kind, number, output), w in weights.items():
            if kind == "break":
                if self.run.into[number + 1]:
                    self.run.into[number + 1][-1].cause.weight += w
                continue
            both = on_samples.setdefault(
                number, {k: np.zeros(self.back.equations.dae.y.numel()) for k in (0, 1)}
            )
            both[sizes[kind]][output] += w
        for k in reversed(range(len(self.run.phases))):
            first = int(starts[k])
            mine = {i - first: w for i, w in on_samples.items() if first <= i < int(starts[k + 1])}
            self._phase(k, mine)
            for one in reversed(self.run.into[k]):
                self._jumps(one)
        return self._start()

    def _phase(self, k: int, weights: Mapping[int, Mapping[int, Array]]) -> None:
        """Back over one phase, stopping where a sample has a weight, a guard crossed, or a piece ends."""
        t, X, Z = self.run.samples[k]
        P, run = self.run.phases[k].P, self.run
        ends = run.ends[(run.ends > t[0]) & (run.ends < t[-1])]
        crossed = {int(np.argmin(np.abs(t - c.guard.t))): c for c in run.inside[k] if c.guard is not None}
        border = np.unique(np.searchsorted(t, ends)) if len(ends) else np.zeros(0, dtype=np.int64)
        stops = sorted({0, len(t) - 1, *weights, *crossed, *border.tolist()}, reverse=True)
        for here, before in zip(stops, [*stops[1:], -1], strict=True):
            piece = self._piece(t, here)
            if here in weights:
                point = Point(float(t[here]), X[here], Z[here], P, piece)
                self._add("outputs", point, weights[here])
            if here in crossed:
                self._guard(crossed[here])
            if before >= 0 and self.x.any():
                self._stretch(k, before, here, piece)

    def _piece(self, t: Array, sample: int) -> int:
        """Piece of the inputs that ends at or holds at a sample; at the begin of a phase the one after it."""
        inputs = self.run.inputs
        at = t[0] + 1e-12 if sample == 0 else t[sample]
        side: Literal["left", "right"] = "right" if sample == 0 else "left"
        return int(np.clip(np.searchsorted(inputs.start, at, side=side) - 1, 0, len(inputs.start) - 1))

    def _stretch(self, k: int, before: int, here: int, piece: int) -> None:
        """From one sample of a phase back to another on one piece; in halves where that is too far."""
        t, X, Z = self.run.samples[k]
        back, P, n = self.back, self.run.phases[k].P, len(self.P)
        C = self.run.inputs.C[piece]
        if back.over(float(t[before]), float(t[here]), X[before], Z[before], P, C, self.x):
            self.x = back.adj_x0.copy()
            self.P += back.adj_p[:n]
            self._inputs(piece, back.adj_p[n + 3 :])
            return
        if here - before < 2:
            raise SimulationError(
                f"adjoint: {back.plugin} cannot go back from {t[here]:.6g} to {t[before]:.6g} s. "
                "Ways out: a looser tolerance, a smaller save_at, or mode='forward'."
            )
        middle = (before + here) // 2
        self._stretch(k, middle, here, piece)
        self._stretch(k, before, middle, piece)

    def _add(self, name: str, point: Point, weights: Mapping[int, Array]) -> None:
        """Weights on a function at a point."""
        ax, aP, aC = self.back.pull(name, point, self.run.inputs.C[point.piece], weights)
        self.x = self.x + ax
        self.P += aP
        self._inputs(point.piece, aC)

    def _inputs(self, piece: int, weight: Array) -> None:
        """Weight on the coefficients of the inputs: to the tangents of the waveform."""
        named, nu = self.a.named, self.back.equations.nu
        if not named.tangents or named.voltage is None:
            return
        tangents = self.a.inputs.C[piece, 2 + 4 * nu :].reshape(named.nw, 2, 4)
        for part, k in enumerate(named.voltage):
            self.theta += tangents[:, part] @ weight[2 + 4 * k : 6 + 4 * k] / self.scale

    def _jumps(self, one: Break) -> None:
        """Back over the jumps of one instant, then to what their time depends on."""
        for jump in reversed(one.jumps):
            own = self.entry + jump.automaton
            one.cause.weight += float(self.x @ jump.moved) + float(self.P[own])
            self.P[own] = 0.0
            if jump.row in self.run.model.resets:
                after, self.x = self.x, np.zeros_like(self.x)
                self._add(f"reset_{jump.row}", jump.before, {0: after})
        cause = one.cause
        if cause.guard is not None:
            self._guard(cause)
        elif cause.row >= 0:
            self.theta += cause.weight * self.held[cause.row]
            if cause.started is not None:
                cause.started.weight += cause.weight
        cause.weight = 0.0

    def _guard(self, cause: Cause) -> None:
        """The weight on the time of a crossing, to the guard."""
        point, weight = cause.guard, cause.weight
        assert point is not None
        if weight == 0.0:
            return
        C = self.run.inputs.C[point.piece]
        guards, rates = (
            np.array(m)[:, 0] for m in self.back.at("look")(point.t, point.X, point.Z, point.P, C)
        )
        seed = np.zeros(len(guards))
        with np.errstate(divide="ignore", invalid="ignore"):  # a grazing guard has no derivative: NaN says so
            seed[cause.row] = -np.float64(weight) / rates[cause.row]
        cause.weight = 0.0
        self._add("look", point, {0: seed})

    def _start(self) -> Array:
        """What is left on the start values, and the parameters by name."""
        eq = self.back.equations
        gradient = self.theta + self.x @ self.a.start[: eq.nx]
        for j, column in enumerate(self.a.named.columns):
            if column.parameter is not None:
                gradient[j] += self.P[column.parameter]
        return gradient
