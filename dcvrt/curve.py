r"""A signal of a run as cubics, and the least level below which it stays for a whole window.

.. math::
    y^\ast = \min_s \max_{[s, s+D]} y = \inf \{v : \text{a stretch with } y \le v \text{ lasts at least } D\}.

On the cubic through the samples the stretch {y <= v} has ends a(v), b(v), and y* is reached in one of two
ways:

* b(v) - a(v) = D. A free end moves by da/dv = 1/y'(a) and da/dtheta = -y_theta/y'(a); an end held at a jump
  or event by da/dv = 0 and da/dtheta = that of the event's time (0 at an input jump). From
  dy*/dtheta = -(b_theta - a_theta)/(b_v - a_v): with two free ends (y'(a) y_theta(b) - y'(b) y_theta(a)) /
  (y'(a) - y'(b)); with a held at time t_a, y_theta(b) + y'(b) dt_a/dtheta.
* a local maximum of y that parts a long stretch into short ones. Its derivative is y_theta (envelope
  theorem), or y_theta + y' dt_e/dtheta if it stands at an event: the time of an event moves, and y is not
  stationary there.

For D = 0 it is the plain minimum, with the same two kinds of derivative.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dcvrt.errors import InputError
from dcvrt.trajectory import Trajectory

Array = NDArray[np.float64]
TIE = 1e-6
"""Minima closer than this, pu, at different places are a tie: the gradient is that of one of them."""
SAME_LENGTH = 1e-12
"""A stretch that misses the window by this, s, still counts: its ends carry round-off."""


@dataclass(frozen=True)
class Extremum:
    """Value of the functional, its gradient, where and how it is reached."""

    value: float
    gradient: Array
    time: float
    kind: str
    tie: bool


@dataclass(frozen=True, eq=False)
class Curve:
    """A signal as cubics between nodes, monotone on each: samples, and the extrema between them.

    Attributes
    ----------
    t, y, rate : nodes; at a break a time stands twice.
    y_theta : derivative of y by every theta at fixed time.
    t_theta : derivative of the node's time by every theta: not zero at events.
    kind : per node, what it is.
    """

    t: Array
    y: Array
    rate: Array
    y_theta: Array
    t_theta: Array
    kind: NDArray[np.str_]
    rate_theta: Array

    @classmethod
    def of(cls, run: Trajectory, name: str, per: str | None = None, sign: float = 1.0) -> Curve:
        """The output `name` of a run, over the output `per` if there is one, times `sign`.

        Raises
        ------
        InputError
            an unknown name, or a state: only outputs carry their rate.
        """
        n = len(run.t)
        kind = np.full(n, "extremum")
        kind[[0, -1]] = "end"
        event_times = {e.time for e in run.events}
        t_theta = np.zeros((n, run.break_grad.shape[1]), dtype=run.break_grad.dtype)
        for left, moved in zip(run.breaks, run.break_grad, strict=True):
            kind[left : left + 2] = "event" if float(run.t[left]) in event_times else "jump"
            t_theta[left : left + 2] = moved
        y, rate, y_theta, rate_theta = _samples(run, name)
        if per is not None:
            y, rate, y_theta, rate_theta = _quotient((y, rate, y_theta, rate_theta), _samples(run, per))
        return cls.with_extrema(
            run.t, sign * y, sign * rate, sign * y_theta, sign * rate_theta, t_theta, kind
        )

    @classmethod
    def with_extrema(
        cls,
        t: Array,
        y: Array,
        rate: Array,
        y_theta: Array,
        rate_theta: Array,
        t_theta: Array,
        kind: NDArray[np.str_],
    ) -> Curve:
        """Add the extrema of the cubics to the samples."""
        h = np.diff(t)
        rise = np.diff(y)
        c1, c2, c3 = (
            rate[:-1] * h,
            3 * rise - (2 * rate[:-1] + rate[1:]) * h,
            (rate[:-1] + rate[1:]) * h - 2 * rise,
        )
        places, fractions = [], []
        with np.errstate(divide="ignore", invalid="ignore"):
            disc = np.sqrt(c2 * c2 - 3 * c3 * c1)
            m = -(c2 + np.where(c2 >= 0, disc, -disc))
            for s in (m / (3 * c3), c1 / m):
                inside = np.flatnonzero((s > 1e-9) & (s < 1 - 1e-9) & (h > 0))
                places.append(inside)
                fractions.append(s[inside])
        place, s = np.concatenate(places), np.concatenate(fractions)
        order = np.lexsort((s, place))
        place, s = place[order], s[order]
        if not len(place):
            return cls(t, y, rate, y_theta, t_theta, kind, rate_theta)

        def insert(values: Array, new: Array) -> Array:
            return np.insert(values, place + 1, new, axis=0)

        new_y = y[place] + s * (c1[place] + s * (c2[place] + s * c3[place]))
        new_theta, new_rate_theta = hermite(h[place], s, y_theta, rate_theta, place)
        none = np.zeros((len(place), t_theta.shape[1]))
        return cls(
            insert(t, t[place] + s * h[place]), insert(y, new_y), insert(rate, np.zeros(len(place))),
            insert(y_theta, new_theta), insert(t_theta, none),
            np.insert(kind, place + 1, "extremum"), insert(rate_theta, new_rate_theta),
        )  # fmt: skip

    # -- stretches below a level --------------------------------------------------------------------------

    def runs(self, level: float, strictly: bool = False) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """First and last node of every run of nodes at or below (strictly: below) a level."""
        below = self.y < level if strictly else self.y <= level
        edge = np.diff(below.astype(np.int8))
        first, last = np.flatnonzero(edge == 1) + 1, np.flatnonzero(edge == -1)
        if below[0]:
            first = np.insert(first, 0, 0)
        if below[-1]:
            last = np.append(last, len(below) - 1)
        return first, last

    def ends(self, level: float, first: NDArray[np.int64], last: NDArray[np.int64]) -> tuple[Array, Array]:
        """Times between which the curve stays below a level, around runs of nodes."""
        n = len(self.t) - 1
        begin = [self._meets(level, k - 1) if k > 0 else float(self.t[0]) for k in first.tolist()]
        end = [self._meets(level, k) if k < n else float(self.t[n]) for k in last.tolist()]
        return np.array(begin), np.array(end)

    def _meets(self, level: float, i: int) -> float:
        """Time at which the monotone cubic of an interval passes a level: bracketed Newton."""
        t, h = float(self.t[i]), float(self.t[i + 1] - self.t[i])
        a, rise = float(self.y[i] - level), float(self.y[i + 1] - self.y[i])
        if h == 0.0 or rise == 0.0:
            return t
        m0, m1 = float(self.rate[i]) * h, float(self.rate[i + 1]) * h
        c2, c3 = 3 * rise - 2 * m0 - m1, m0 + m1 - 2 * rise
        low, high, s = 0.0, 1.0, min(max(-a / rise, 0.0), 1.0)
        for _ in range(80):
            value = a + s * (m0 + s * (c2 + s * c3))
            if (value > 0) == (rise > 0):
                high = s
            else:
                low = s
            slope = m0 + s * (2 * c2 + 3 * s * c3)
            new = s - value / slope if slope != 0.0 else -1.0
            if not low <= new <= high:
                new = 0.5 * (low + high)
            if abs(new - s) < 1e-15:
                break
            s = new
        return t + s * h

    def stretches_below(self, level: float) -> list[tuple[float, float]]:
        """Begin and end of every stretch with y < level."""
        first, last = self.runs(level, strictly=True)
        begin, end = self.ends(level, first, last)
        return list(zip(begin.tolist(), end.tolist(), strict=True))

    def longest(self, level: float, strictly: bool = False) -> tuple[float, int, int, float, float]:
        """Duration, first and last node, begin and end of the longest stretch at or below a level."""
        first, last, at_least, at_most = self._candidates(level, strictly)
        if not len(first):
            return 0.0, -1, -1, math.nan, math.nan
        possible = at_most >= at_least.max()
        first, last = first[possible], last[possible]
        begin, end = self.ends(level, first, last)
        k = int(np.argmax(end - begin))
        return float(end[k] - begin[k]), int(first[k]), int(last[k]), float(begin[k]), float(end[k])

    def lasts(self, level: float, window: float) -> bool:
        """Whether some stretch at or below a level lasts a window."""
        _, _, at_least, at_most = self._candidates(level, False)
        if at_least.max(initial=0.0) >= window or at_most.max(initial=0.0) < window:
            return bool(at_least.max(initial=0.0) >= window)
        return self.longest(level)[0] >= window

    def _candidates(self, level: float, strictly: bool) -> tuple[NDArray[Any], NDArray[Any], Array, Array]:
        """Runs of nodes below a level with the least and greatest duration of the stretch around each."""
        first, last = self.runs(level, strictly)
        at_most = self.t[np.minimum(last + 1, len(self.t) - 1)] - self.t[np.maximum(first - 1, 0)]
        return first, last, self.t[last] - self.t[first], at_most

    def at_node(self, k: int) -> Array:
        """Derivative of the extremum that stands at a node: the node moves with its time."""
        return self.y_theta[k] + self.rate[k] * self.t_theta[k]


def _samples(run: Trajectory, name: str) -> tuple[Array, Array, Array, Array]:
    """Values, rates, and the derivatives of both by every theta."""
    signals, k = run._find(name)
    if signals.rate is None:
        raise InputError(
            f"{name!r} is not among the outputs of the system: its rate is not kept. "
            "Way out: make it an output."
        )
    none = np.zeros((len(run.t), len(run.wrt)))
    y_theta = signals.sens[:, k] if signals.sens is not None else none
    rate_theta = signals.rate_sens[:, k] if signals.rate_sens is not None else none
    return signals.value[:, k], signals.rate[:, k], y_theta, rate_theta


def _quotient(
    above: tuple[Array, Array, Array, Array], below: tuple[Array, Array, Array, Array]
) -> tuple[Array, Array, Array, Array]:
    """Samples of the quotient of two signals."""
    a, da, a_theta, da_theta = above
    b, db, b_theta, db_theta = below
    y = a / b
    rate = (da - y * db) / b
    y_theta = (a_theta - y[:, None] * b_theta) / b[:, None]
    moved = da_theta - y_theta * db[:, None] - y[:, None] * db_theta - rate[:, None] * b_theta
    return y, rate, y_theta, moved / b[:, None]


def hermite(h: Array, s: Array, value: Array, rate: Array, place: NDArray[np.int64]) -> tuple[Array, Array]:
    """Columns and their rates on cubics, at fraction `s` of the intervals `place`."""
    h, s = h[:, None], s[:, None]
    a, m0, m1 = value[place], rate[place] * h, rate[place + 1] * h
    rise = value[place + 1] - a
    c2, c3 = 3 * rise - 2 * m0 - m1, m0 + m1 - 2 * rise
    return a + s * (m0 + s * (c2 + s * c3)), (m0 + s * (2 * c2 + 3 * s * c3)) / h


def sustained_minimum(curve: Curve, window: float) -> Extremum:
    """min over s of max over [s, s + window], with gradient; the plain minimum for window = 0.

    Raises
    ------
    InputError
        the run is shorter than the window.
    """
    if window == 0.0:
        k = int(np.argmin(curve.y))
        near = np.flatnonzero(curve.y <= curve.y[k] + TIE)
        tie = bool(len(near) and curve.y[near[0] : near[-1] + 1].max() > curve.y[k] + 2 * TIE)
        return Extremum(float(curve.y[k]), curve.at_node(k), float(curve.t[k]), str(curve.kind[k]), tie)
    span = float(curve.t[-1] - curve.t[0])
    if span < window - SAME_LENGTH:
        raise InputError(f"sustained minimum: {too_short(span, window)}")
    window -= SAME_LENGTH
    # between neighbouring maxima the stretches below a level do not merge, so that the longest grows
    # continuously
    y = curve.y
    rises, falls = np.append(True, y[1:] >= y[:-1]), np.append(y[:-1] >= y[1:], True)
    maxima = np.unique(y[rises & falls])
    low, high = 0, len(maxima) - 1
    while low < high:
        middle = (low + high) // 2
        if curve.lasts(float(maxima[middle]), window):
            high = middle
        else:
            low = middle + 1
    top = float(maxima[high])
    if curve.longest(top, strictly=True)[0] < window:
        return _at_maximum(curve, top, window)
    level = _level(curve, float(maxima[high - 1]) if high else float(y.min()), top, window)
    return _at_window(curve, level, window)


def too_short(span: float, window: float) -> str:
    """Say that a run cannot hold a window.

    >>> too_short(0.5, 1.0)
    'the run lasts 0.5 s, less than the window of 1 s.'
    """
    return f"the run lasts {span:g} s, less than the window of {window:g} s."


def _level(curve: Curve, low: float, high: float, window: float) -> float:
    """Level in (low, high) at which the longest stretch lasts exactly the window."""
    from scipy.optimize import brentq

    def excess(level: float) -> float:
        return curve.longest(level, strictly=level >= high)[0] - window

    if excess(low) >= 0:
        return low
    return float(brentq(excess, low, high, xtol=1e-14, rtol=8.9e-16))


def _at_maximum(curve: Curve, level: float, window: float) -> Extremum:
    """The level is that of a local maximum that parts the stretch."""
    _, first, last, _, _ = curve.longest(level)
    inside = np.arange(first, last + 1)
    k = int(inside[np.argmax(curve.y[inside])])
    return Extremum(
        level, curve.at_node(k), float(curve.t[k]), str(curve.kind[k]), _tied(curve, level, window)
    )


def _at_window(curve: Curve, level: float, window: float) -> Extremum:
    """The stretch below the level lasts exactly the window; its ends move with level and theta."""
    _, first, last, begin, end = curve.longest(level)
    a_theta, a_slope = end_of_stretch(curve, first - 1, begin)
    b_theta, b_slope = end_of_stretch(curve, last, end)
    if a_slope is None and b_slope is None:
        gradient = np.full(
            len(a_theta), math.nan
        )  # both ends are held: no such stretch has exactly the window
    elif a_slope is None:
        gradient = b_theta + (b_slope or 0.0) * a_theta
    elif b_slope is None:
        gradient = a_theta + a_slope * b_theta
    elif a_slope - b_slope != 0:
        gradient = (a_slope * b_theta - b_slope * a_theta) / (a_slope - b_slope)
    else:  # flat at both ends: the level is that of the plateau
        gradient = 0.5 * (a_theta + b_theta)
    return Extremum(level, gradient, begin, "window", _tied(curve, level, window))


def end_of_stretch(curve: Curve, interval: int, time: float) -> tuple[Array, float | None]:
    """End of a stretch: y_theta and slope there if it is free; derivative of its time and None if held."""
    if interval < 0 or interval >= len(curve.t) - 1:
        return np.zeros(curve.y_theta.shape[1]), None
    h = curve.t[interval + 1] - curve.t[interval]
    if h == 0:
        return curve.t_theta[interval], None
    place, s = np.array([interval]), np.array([(time - curve.t[interval]) / h])
    step = np.array([h])
    theta, _ = hermite(step, s, curve.y_theta, curve.rate_theta, place)
    _, slope = hermite(step, s, curve.y[:, None], curve.rate[:, None], place)
    return theta[0], float(slope[0, 0])


def _tied(curve: Curve, level: float, window: float) -> bool:
    first, last = curve.runs(level + TIE)
    begin, end = curve.ends(level + TIE, first, last)
    return int(np.sum(end - begin >= window)) > 1
