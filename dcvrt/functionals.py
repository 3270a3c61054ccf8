r"""Functionals of a run: one number of one signal, with its gradient, and where it is active.

Each is exact on the solution, not on samples: a kernel computes it inside the run, on the dense output of its
steps; on a trajectory it is that of the cubics through the samples. Derivatives by theta are total ones, with
times of events that move:

* an extremum by the envelope theorem, y_theta; at an event y_theta + y' dt_e/dtheta;
* a sustained extremum as in :mod:`dcvrt.curve`;
* a time from the crossings of the level v at t_k, dt_k/dtheta = -(y_theta - v_theta)/y';
* an integral as the integral of y_theta, plus (y^- - y^+) dt_e/dtheta for jumps of y at events.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dcvrt.curve import SAME_LENGTH, Curve, Extremum, end_of_stretch, hermite, sustained_minimum, too_short
from dcvrt.errors import InputError, did_you_mean, raise_all
from dcvrt.trajectory import Trajectory

Array = NDArray[np.float64]


class Outcome(NamedTuple):
    """Value of a functional, its gradient, and where it is active.

    Attributes
    ----------
    value : in the unit of the signal, or s, or unit times s.
    grad : derivative by every theta of the run; NaN where there is none.
    time : begin of the active window or time of the active extremum, s; NaN for times and integrals.
    kind : ``"window"``, ``"extremum"``, ``"event"``, ``"jump"`` or ``"end"``: what makes it active; empty for
        what is active at no single place.
    tie : whether another place reaches the same value: the gradient is then one of several.
    """

    value: float
    grad: Mapping[str, float] = {}
    time: float = math.nan
    kind: str = ""
    tie: bool = False

    def flat(self, name: str) -> dict[str, Any]:
        """Columns of a table under a name."""
        row: dict[str, Any] = {name: self.value}
        row |= {f"d_{name}/d_{theta}": value for theta, value in self.grad.items()}
        if self.kind:
            row |= {f"{name}_time": self.time, f"{name}_kind": self.kind, f"{name}_tie": self.tie}
        return row


# -- declarations -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Functional:
    """What all functionals share.

    Parameters
    ----------
    signal : output of the system.
    per : output that divides it, if any: ``Maximum("i_g", per="i_max")``.
    """

    signal: str
    per: str | None = field(default=None, kw_only=True)
    sign: ClassVar[float] = 1.0
    """-1 for what is a minimum of the negative signal."""

    def on(self, curve: Curve) -> Extremum:
        """The functional of a curve, which is the signal times `sign`."""
        raise NotImplementedError

    def of(self, run: Trajectory) -> Outcome:
        """The functional of a completed run.

        Raises
        ------
        InputError
            the run did not complete, lacks the signal, or is shorter than the window.
        """
        return evaluate({str(self): self}, run)[str(self)]

    @property
    def signals(self) -> tuple[str, ...]:
        """Outputs that it reads."""
        return (self.signal,) if self.per is None else (self.signal, self.per)

    @property
    def span(self) -> float:
        """Time that a run must last for it, s."""
        return 0.0

    def __str__(self) -> str:
        return f"{type(self).__name__} of {' / '.join(self.signals)}"


@dataclass(frozen=True)
class Initial(Functional):
    """First value, y(t_0)."""

    def on(self, curve: Curve) -> Extremum:
        return _without_place(float(curve.y[0]), curve.y_theta[0])


@dataclass(frozen=True)
class Minimum(Functional):
    """Least value, min_t y."""

    def on(self, curve: Curve) -> Extremum:
        return sustained_minimum(curve, 0.0)


@dataclass(frozen=True)
class Maximum(Minimum):
    """Largest value, max_t y."""

    sign = -1.0


@dataclass(frozen=True)
class SustainedMinimum(Functional):
    """Least level below which the signal stays for a whole window, min_s max_[s, s + window] y.

    Parameters
    ----------
    window : s; 0 gives the plain minimum.
    """

    window: float

    def __post_init__(self) -> None:
        if not 0.0 <= self.window < math.inf:
            raise InputError(f"{self}: window = {self.window:g} s must be a time, 0 or longer.")

    @property
    def span(self) -> float:
        return self.window

    def on(self, curve: Curve) -> Extremum:
        return sustained_minimum(curve, self.window)


@dataclass(frozen=True)
class SustainedMaximum(SustainedMinimum):
    """Largest level above which the signal stays for a whole window, max_s min_[s, s + window] y."""

    sign = -1.0


@dataclass(frozen=True)
class TimeBelow(Functional):
    """Total time, s, for which the signal is below a level.

    Parameters
    ----------
    level : in the unit of the signal; or
    share : the level as a share of the signal's first value, whose gradient then counts too.
    """

    level: float | None = None
    share: float | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        given = [v for v in (self.level, self.share) if v is not None]
        if len(given) != 1 or not math.isfinite(given[0]):
            raise InputError(
                f"{self}: level = {self.level}, share = {self.share}: give one of the two, a finite number."
            )

    def level_on(self, curve: Curve) -> tuple[float, Array]:
        """The level on a curve and its derivative by every theta."""
        if self.share is not None:
            return self.share * float(curve.y[0]), self.share * curve.y_theta[0]
        return self.sign * float(self.level or 0.0), np.zeros(curve.y_theta.shape[1])

    def on(self, curve: Curve) -> Extremum:
        level, slope = self.level_on(curve)
        value, gradient = 0.0, np.zeros_like(slope)
        for begin, end in _stretches(curve, level, slope):
            value += end[0] - begin[0]
            gradient = gradient + end[1] - begin[1]
        return _without_place(value, gradient)


@dataclass(frozen=True)
class TimeAbove(TimeBelow):
    """Total time, s, for which the signal is above a level; arguments as in :class:`TimeBelow`."""

    sign = -1.0


@dataclass(frozen=True)
class RecoveryTime(TimeBelow):
    """Time, s, from the first fall below a level to the last return above it; arguments as in
    :class:`TimeBelow`.

    0 if it never falls below; inf, without a gradient, if it is still below at the end.
    """

    def on(self, curve: Curve) -> Extremum:
        level, slope = self.level_on(curve)
        stretches = _stretches(curve, level, slope)
        if not stretches:
            return _without_place(0.0, np.zeros_like(slope))
        (begin, begin_theta), (end, end_theta) = stretches[0][0], stretches[-1][1]
        if end >= curve.t[-1]:
            return _without_place(math.inf, np.full_like(slope, math.nan))
        return _without_place(end - begin, end_theta - begin_theta)


@dataclass(frozen=True)
class Integral(Functional):
    """Integral over the run, of the signal or (`positive`) of max(signal, 0)."""

    positive: bool = False

    def on(self, curve: Curve) -> Extremum:
        value, gradient = _integral(curve, self.positive)
        return _without_place(value, gradient)


def _without_place(value: float, gradient: Array) -> Extremum:
    return Extremum(value, gradient, math.nan, "", False)


# -- on trajectories --------------------------------------------------------------------------------------


def evaluate(functionals: Mapping[str, Functional], run: Trajectory) -> dict[str, Outcome]:
    """Functionals of a completed run, by name.

    Raises
    ------
    InputError
        the run did not complete, lacks a signal, or is shorter than a window.
    """
    if not run.completed:
        raise InputError(f"functionals: the run has no result to judge: {run.status}.")
    span = float(run.t[-1] - run.t[0])
    short = [f"{f}: {too_short(span, f.span)}" for f in functionals.values() if span < f.span - SAME_LENGTH]
    raise_all(short, "functionals")
    curves: dict[tuple[str, str | None, float], Curve] = {}
    outcomes = {}
    for name, f in functionals.items():
        key = (f.signal, f.per, f.sign)
        if key not in curves:
            curves[key] = Curve.of(run, *key)
        found = f.on(curves[key])
        # times and integrals of the negative signal are what they are; values change their sign back
        sign = f.sign if found.kind else 1.0
        grad = run.gradient(found.gradient, sign)
        outcomes[name] = Outcome(sign * found.value, grad, found.time, found.kind, found.tie)
    return outcomes


Crossing = tuple[float, Array]
"""Time at which a curve passes a level, and its derivative by every theta."""


def _stretches(curve: Curve, level: float, level_theta: Array) -> list[tuple[Crossing, Crossing]]:
    """Begin and end of every stretch strictly below a level."""
    first, last = curve.runs(level, strictly=True)
    begin, end = curve.ends(level, first, last)

    def moved(interval: int, time: float) -> Array:
        theta, slope = end_of_stretch(curve, interval, time)
        if slope is None:
            return theta
        with np.errstate(divide="ignore", invalid="ignore"):
            return -(theta - level_theta) / slope if slope else np.full_like(theta, math.nan)

    return [
        ((a, moved(i - 1, a)), (b, moved(j, b)))
        for a, b, i, j in zip(begin.tolist(), end.tolist(), first.tolist(), last.tolist(), strict=True)
    ]


def _integral(curve: Curve, positive: bool) -> tuple[float, Array]:
    """Integral of the cubics, or of their positive part, and its derivative by every theta."""
    h, jumps = np.diff(curve.t), np.flatnonzero(np.diff(curve.t) == 0.0)
    y = np.maximum(curve.y, 0.0) if positive else curve.y
    whole = (curve.y[:-1] >= 0) & (curve.y[1:] >= 0) if positive else np.ones(len(h), dtype=bool)
    columns = np.column_stack((curve.y, curve.y_theta))
    rates = np.column_stack((curve.rate, curve.rate_theta))
    k = np.flatnonzero(whole)
    total = _cubics(h[k], columns[k], rates[k], columns[k + 1], rates[k + 1]).sum(axis=0)
    for i in np.flatnonzero(~whole & (curve.y[:-1] * curve.y[1:] < 0) & (h > 0)).tolist():
        s = np.array([(curve._meets(0.0, i) - curve.t[i]) / h[i]])
        at, rate = hermite(h[[i]], s, columns, rates, np.array([i]))
        if curve.y[i] > 0:
            total += _cubics(s * h[i], columns[[i]], rates[[i]], at, rate)[0]
        else:
            total += _cubics((1 - s) * h[i], at, rate, columns[[i + 1]], rates[[i + 1]])[0]
    moved = ((y[jumps] - y[jumps + 1])[:, None] * curve.t_theta[jumps]).sum(axis=0)
    return float(total[0]), total[1:] + moved


def _cubics(h: Array, y0: Array, r0: Array, y1: Array, r1: Array) -> Array:
    """Integrals of the cubics through values and rates at the ends of intervals."""
    h = h[:, None]
    return h / 2 * (y0 + y1) + h**2 / 12 * (r0 - r1)


# -- asked for in a batch ---------------------------------------------------------------------------------


def check_functionals(functionals: object, outputs: tuple[str, ...], span: float, where: str) -> None:
    """Refuse what cannot be computed of runs with these outputs that last `span`, all at once.

    Raises
    ------
    InputError
        what is no functional, an unknown output, a window longer than the run.
    """
    if not isinstance(functionals, Mapping):
        raise InputError(
            f"{where}: functionals = {functionals!r} must be a mapping of names to functionals. "
            "Way out: functionals={'v': Minimum('v_it')}."
        )
    problems = []
    for name, f in functionals.items():
        if not isinstance(f, Functional) or type(f) is Functional:
            problems.append(f"functional {name!r} = {f!r} is none. Way out: Minimum('v_it'), for example.")
            continue
        problems += [
            f"functional {name!r}: the system has no output {signal!r}.{did_you_mean(signal, outputs)}"
            for signal in f.signals
            if signal not in outputs
        ]
        if span < f.span - SAME_LENGTH:
            problems.append(f"functional {name!r}: {too_short(span, f.span)}")
    raise_all(problems, where)
