"""The run that integrators are compared on, cut into the smooth stretches that a baseline integrates.

A tight reference run gives the times of all jumps and events and the modes between them. A baseline is handed
these for nothing: it integrates from one to the next with the flags of the mode as parameters and looks for
no event. With sensitivities it is also handed what S jumps by at each event. Both favour the baselines.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dcvrt import Waveform
from dcvrt.dae import Dae
from dcvrt.integrators import Casadi, Simulator
from dcvrt.integrators.channels import channels
from dcvrt.integrators.equations import Equations
from dcvrt.trajectory import Signals, Trajectory

Array = NDArray[np.float64]

SIGNALS = ("v_it", "p_g")
THETAS = ("beta", "H", "dc.T_hold", "bess.T_b", "sup.w_sag", "dc_loop.K_p")
AWAY = 1e-3
"""Samples closer to a jump than this, s, do not count: an event 1e-8 s late is no error of a jump's size."""
POINTS = 48
"""Samples of a stretch at which the error of a baseline is taken."""
SUBSTEPS, DOUBTFUL = 8, 100
"""Steps from a sample of the reference to a time between two; times at which a cubic is not believed."""


def disturbances(smoke: bool = False) -> Waveform:
    """Deep fault with recovery, dip, swell; cut after the fault for the smoke run."""
    if smoke:
        return Waveform.segments([(0.0, 1.0), (0.1, 0.45 * np.exp(-0.3j)), (0.2, 1.0)], until=0.4)
    return Waveform.segments(
        [
            (0.0, 1.0),
            (0.5, 0.45 * np.exp(-0.4j)),
            (0.6, 0.75 * np.exp(0.14j), 0.98),
            (1.0, 0.98, 1.0),
            (2.4, 0.7 * np.exp(-0.14j)),
            (2.75, 1.0),
            (4.2, 1.15 * np.exp(0.07j)),
            (4.35, 1.0),
        ],
        until=5.0,
    )


def cubic(t: Array, signals: Signals, columns: Sequence[int], at: Array) -> tuple[Array, Array | None]:
    """Values (times, columns) and sensitivities (times, columns, thetas) between the samples of a run."""
    i = np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(t) - 2)
    h = t[i + 1] - t[i]
    s = np.where(h > 0, (at - t[i]) / np.where(h > 0, h, 1.0), 0.0)

    def between(value: Array, rate: Array) -> Array:
        shape = (-1,) + (1,) * (value.ndim - 1)
        hh, ss = h.reshape(shape), s.reshape(shape)
        a, b = value[i], value[i + 1]
        m, n = rate[i] * hh - (b - a), (b - a) - rate[i + 1] * hh
        return a + ss * (b - a) + ss * (1 - ss) * ((1 - ss) * m + ss * n)

    columns = list(columns)
    assert signals.rate is not None
    values = between(signals.value[:, columns], signals.rate[:, columns])
    if signals.sens is None or signals.rate_sens is None:
        return values, None
    return values, between(signals.sens[:, columns], signals.rate_sens[:, columns])


class Reference:
    """A tight run with fine samples, and the distance of other results from it.

    Between its samples a cubic is not good enough where a limiter turns a corner: there, the reference is
    integrated on from the sample before, in `SUBSTEPS` steps of Runge-Kutta.
    """

    def __init__(self, run: Trajectory, equations: Equations, P: Array, group: Array) -> None:
        self.run, self.eq, self.P, self.group = run, equations, P, group
        self.columns = [run.outputs.names.index(n) for n in SIGNALS]
        self.edges = run.t[run.breaks]
        self.theta = np.array([abs(run.parameters[n]) for n in run.wrt])
        self.functions = {f.name(): f for f in equations.functions if f.name() in ("rhs", "outputs")}
        if run.outputs.sens is not None:
            scaled = np.abs(run.outputs.sens[:, self.columns] * self.theta).max(axis=0)
            self.size = np.maximum(scaled, 1e-2 * scaled.max())

    def far(self, t: Array) -> NDArray[np.bool_]:
        """Which times are away from every jump."""
        if not len(self.edges):
            return np.ones(len(t), dtype=bool)
        k = np.clip(np.searchsorted(self.edges, t), 1, len(self.edges) - 1)
        near = np.minimum(np.abs(t - self.edges[k - 1]), np.abs(t - self.edges[k]))
        return near > AWAY

    def exact(self, t: Array) -> tuple[Array, Array | None]:
        """Signals (times, signals) and their sensitivities at times away from jumps."""
        run, eq = self.run, self.eq
        i = np.searchsorted(run.t, t, side="right") - 1
        x = run.states.value[i]
        if eq.nw and run.states.sens is not None:
            S = run.states.sens[i] * eq.scale
            x = np.hstack((x, S.transpose(0, 2, 1).reshape(len(t), -1)))
        stretch = np.searchsorted(self.group[:, 1], t, side="right") - 1
        P, group, h = self.P[stretch].T, self.group[stretch].T.copy(), t - run.t[i]
        group[1], group[2] = run.t[i], h
        X, rhs, step = x.T, self.functions["rhs"], 1.0 / SUBSTEPS

        def f(tau: float, at: Array) -> Array:
            return np.array(rhs(np.full((1, len(t)), tau), at, ca.DM(0, 1), P, group)[0])

        for n in range(SUBSTEPS):
            tau = n * step
            k1 = f(tau, X)
            k2 = f(tau + step / 2, X + step / 2 * k1)
            k3 = f(tau + step / 2, X + step / 2 * k2)
            k4 = f(tau + step, X + step * k3)
            X = X + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        return outputs(self.functions["outputs"], eq, t, X, P, group[3:], self.columns)

    def error(self, t: Array, y: Array, y_theta: Array | None, exact: bool = False) -> tuple[float, float]:
        """Path error, pu: the largest difference of the signals (times, signals). Sensitivity error: the
        largest difference of theta dy/dtheta over the largest value in the run (at least 1 % of all).

        By cubics first, then at the worst times exactly; or `exact` everywhere.
        """
        far = self.far(t)
        t, y = t[far], y[far]
        if not np.isfinite(y).all():
            return np.inf, np.inf
        if exact:
            return self._worst(y, y_theta[far] if y_theta is not None else None, *self._kept(t))
        rough = cubic(self.run.t, self.run.outputs, self.columns, t)
        by_path = np.abs(y - rough[0]).max(axis=1)
        doubtful = set(np.argsort(by_path)[-DOUBTFUL:].tolist())
        if y_theta is not None and rough[1] is not None:
            y_theta = y_theta[far]
            by_theta = (np.abs(y_theta - rough[1]) * self.theta / self.size).max(axis=(1, 2))
            doubtful |= set(np.argsort(by_theta)[-DOUBTFUL:].tolist())
        k = np.array(sorted(doubtful))
        return self._worst(y[k], y_theta[k] if y_theta is not None else None, *self.exact(t[k]))

    def _worst(
        self, y: Array, y_theta: Array | None, wanted: Array, wanted_theta: Array | None
    ) -> tuple[float, float]:
        path = float(np.abs(y - wanted).max())
        if y_theta is None or wanted_theta is None:
            return path, np.inf
        error = np.abs(y_theta - wanted_theta) * self.theta / self.size
        return path, float(error.max()) if np.isfinite(error).all() else np.inf

    def _kept(self, t: Array) -> tuple[Array, Array | None]:
        """Exact values at times that are asked for again and again."""
        kept: dict[bytes, tuple[Array, Array | None]] = self.__dict__.setdefault("_values", {})
        key = t.tobytes()
        if key not in kept:
            kept[key] = self.exact(t)
        return kept[key]

    def of(self, run: Trajectory) -> tuple[float, float]:
        """Path error and sensitivity error of a run; infinite when its modes are others."""
        if run.sequence != self.run.sequence:
            return np.inf, np.inf
        sens = run.outputs.sens
        y_theta = None if sens is None else sens[:, self.columns]
        return self.error(run.t, run.outputs.value[:, self.columns], y_theta)


def outputs(
    function: ca.Function, eq: Equations, t: Array, X: Array, P: Array, C: Array, columns: Sequence[int]
) -> tuple[Array, Array | None]:
    """Signals (times, signals) and their sensitivities from states (n, times)."""
    found = function(t[None], X, ca.DM(0, 1), P, C)
    y = np.array(found[0]).T[:, columns]
    if not eq.nw:
        return y, None
    y_theta = np.array(found[2]).reshape(eq.dae.y.numel(), len(t), eq.nw).transpose(1, 0, 2) / eq.scale
    return y, y_theta[:, columns]


@dataclass(frozen=True, eq=False)
class Case:
    """One run as stretches between its jumps.

    Attributes
    ----------
    equations : of the system, with the sensitivities of `thetas`.
    X0 : state with scaled sensitivities at the start, columns one after the other.
    P : per stretch [p, flags, entry times, their gradients] as :class:`Equations` orders them.
    group : per stretch [0, begin, duration, coefficients of the inputs].
    jump : what X jumps by at the begin of each stretch; only S does.
    seeds : per stretch and theta, derivative of the first three parts of P times the scale of theta.
    """

    name: str
    dae: Dae
    waveform: Waveform
    values: dict[str, float]
    equations: Equations
    reference: Reference
    X0: Array
    P: Array
    group: Array
    jump: Array
    seeds: Array

    @property
    def begin(self) -> Array:
        return self.group[:, 1]

    @property
    def length(self) -> Array:
        return self.group[:, 2]

    def times(self, points: int = POINTS) -> Array:
        """Times of the samples of all stretches."""
        return (self.begin[:, None] + self.length[:, None] * np.arange(1, points + 1) / points).ravel()

    def errors(self, X: Array) -> tuple[float, float]:
        """Path and sensitivity error of states (stretches, points, n)."""
        k, points = X.shape[:2]
        t = self.times(points)
        rows = np.repeat(np.arange(k), points)
        y, y_theta = outputs(
            self._outputs, self.equations, t, X.reshape(k * points, -1).T, self.P[rows].T,
            self.group[rows, 3:].T, self.reference.columns,
        )  # fmt: skip
        return self.reference.error(t, y, y_theta, exact=True)

    @cached_property
    def _outputs(self) -> ca.Function:
        return next(f for f in self.equations.functions if f.name() == "outputs")


def build(
    name: str,
    dae: Dae,
    waveform: Waveform,
    thetas: Sequence[str] = (),
    values: dict[str, float] | None = None,
    solver: Casadi | None = None,
    save_at: float = 1e-4,
    equations: Equations | None = None,
) -> Case:
    """Reference run of a case, cut into stretches."""
    values = dict(values or {})
    tight = solver or (Casadi("erk", 1e-11, 1e-13) if thetas else Casadi("cvodes", 1e-11, 1e-13))
    run = Simulator(dae, tight, wrt=thetas, save_at=save_at)(waveform, **values)
    return cut(name, dae, waveform, run, equations or Equations(dae, tuple(thetas), False), values)


def cut(
    name: str, dae: Dae, waveform: Waveform, run: Trajectory, eq: Equations, values: dict[str, float]
) -> Case:
    """Stretches of a run, at jumps, events, and wherever a piece of the inputs ends."""
    inputs = channels(eq, waveform, None)
    breaks, n = run.breaks, len(run.t)
    first, last = np.append(0, breaks + 1), np.append(breaks, n - 1)
    scale = eq.scale if eq.nw else np.ones(0)

    def state(k: int) -> Array:
        x = run.states.value[k]
        if run.states.sens is None:
            return x
        return np.concatenate((x, (run.states.sens[k] * scale).T.ravel()))

    p = np.array([run.parameters[q] for q in dae.p_names])
    dp = np.zeros((eq.nw, len(p)))
    for j, column in enumerate(eq.columns):
        if column.parameter is not None:
            dp[j, column.parameter] = column.scale
    modes = [a.mode_number(a.start) for a in dae.automata]
    entry, dentry = np.full(eq.na, run.t[0]), np.zeros((eq.na, eq.nw))
    events = list(run.events)
    P, group, jump, seeds = [], [], [], []
    for a, b in zip(first, last, strict=True):
        while events and events[0].time <= run.t[a]:
            event = events.pop(0)
            i = next(i for i, automaton in enumerate(dae.automata) if automaton.path == event.automaton)
            modes[i], entry[i] = dae.automata[i].mode_number(event.target), event.time
            dentry[i] = [event.grad[c.name] * c.scale for c in eq.columns]
        flags = np.concatenate([np.zeros(0), *(g.flags[m] for g, m in zip(dae.automata, modes, strict=True))])
        ends = np.append(inputs.start, inputs.start[-1] + inputs.length[-1])
        inner = ends[(ends > run.t[a] + 1e-10) & (ends < run.t[b] - 1e-10)]
        edges = np.concatenate(([run.t[a]], inner, [run.t[b]]))
        for number, (left, right) in enumerate(itertools.pairwise(edges)):
            k = int(np.searchsorted(inputs.start, 0.5 * (left + right), side="right")) - 1
            P.append(np.concatenate((p, flags, entry, dentry.T.ravel())))
            group.append(np.concatenate(([0.0, left, right - left], inputs.C[k])))
            jump.append(state(a) - state(a - 1) if number == 0 and a > 0 else np.zeros_like(state(a)))
            seeds.append(np.hstack((dp, np.zeros((eq.nw, len(flags))), dentry.T)))
    for change in jump:
        change[: eq.nx] = 0.0  # states are continuous here: the difference is what the two samples differ by
    return Case(
        name, dae, waveform, values, eq, Reference(run, eq, np.array(P), np.array(group)), state(0),
        np.array(P), np.array(group), np.array(jump), np.array(seeds),
    )  # fmt: skip
