r"""Does a facility ride through? Margins of a run with their gradients, and the diagnostics beside them.

Both margins rest on one functional, the least level below which a signal stays for a whole window D,

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
Paper: eqs. (sustained_it_voltage), (voltage_margin), (loss_margin).
Differs: the paper's sustained voltage, min over s of the *min* over the window, does not depend on the
window; it is here as criterion="instantaneous".
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from dcvrt.errors import InputError, raise_all
from dcvrt.trajectory import Trajectory

Array = NDArray[np.float64]
TIE = 1e-6
"""Minima closer than this, pu, at different places are a tie: the gradient is that of one of them."""
LIMITED_BEFORE_FAULT = 0.999
"""Diagnostic `preload` from which on the current limiter counts as active before the fault."""


@dataclass(frozen=True)
class Criteria:
    """What a facility has to meet.

    Parameters
    ----------
    v_it_min : IT voltage that keeps the servers running, pu.
    window : time that the voltage must stay below a level to count, s.
    loss_share : share of the pre-fault import that may be lost.
    loss_window : time that a loss must last to count, s; 0 takes the peak, which a current lag makes 1 - V at
        fault inception whatever the converter.
    criterion : ``"sustained"``, or ``"instantaneous"``: the plain minimum of the IT voltage.
    recovery_share : share of the pre-fault import that counts as recovered.
    recovery_time : time within which the import must have recovered, s; None asks for nothing.
    """

    v_it_min: float = 0.90
    window: float = 0.020
    loss_share: float = 0.25
    loss_window: float = 0.040
    criterion: Literal["sustained", "instantaneous"] = "sustained"
    recovery_share: float = 0.9
    recovery_time: float | None = None

    def __post_init__(self) -> None:
        problems = [
            f"{name} = {value:g} must lie in [{low:g}, {high:g}]."
            for name, value, low, high in (
                ("v_it_min", self.v_it_min, 0.0, 2.0),
                ("window", self.window, 0.0, 60.0),
                ("loss_share", self.loss_share, 0.0, 1.0),
                ("loss_window", self.loss_window, 0.0, 60.0),
                ("recovery_share", self.recovery_share, 0.0, 1.0),
            )
            if not low <= value <= high
        ]
        if self.criterion not in ("sustained", "instantaneous"):
            problems.append(f"criterion = {self.criterion!r} must be 'sustained' or 'instantaneous'.")
        if self.recovery_time is not None and not self.recovery_time > 0:
            problems.append(f"recovery_time = {self.recovery_time:g} s must be positive.")
        raise_all(problems, "criteria")


@dataclass(frozen=True)
class Margin:
    """A margin (positive: met), its gradient, and where it is active.

    Attributes
    ----------
    value : pu volts, or share of the pre-fault import.
    grad : derivative by every theta of the run.
    time : begin of the active window or time of the active extremum, s.
    kind : ``"window"``, ``"extremum"``, ``"event"``, ``"jump"`` or ``"end"``: what makes it active.
    tie : whether another place reaches the same value: the gradient is then one of several.
    """

    value: float
    grad: Mapping[str, float] = field(default_factory=dict)
    time: float = math.nan
    kind: str = ""
    tie: bool = False


@dataclass(frozen=True)
class Margins:
    """Margins of one run, the sequence of modes that they belong to, and diagnostics.

    `sequence` labels the branch: margins of runs with different sequences do not lie on one smooth surface.
    """

    voltage: Margin
    loss: Margin
    sequence: tuple[str, ...]
    diagnostics: Mapping[str, float]
    recovered: bool = True

    @property
    def passed(self) -> bool:
        """Whether every criterion is met."""
        return self.voltage.value >= 0 and self.loss.value >= 0 and self.recovered

    def flat(self) -> dict[str, Any]:
        """One row of a table."""
        row: dict[str, Any] = {}
        for name, margin in (("voltage", self.voltage), ("loss", self.loss)):
            row[name] = margin.value
            row |= {f"d_{name}/d_{theta}": value for theta, value in margin.grad.items()}
            row[f"{name}_time"], row[f"{name}_kind"], row[f"{name}_tie"] = (
                margin.time,
                margin.kind,
                margin.tie,
            )
        return {**row, **self.diagnostics, "recovered": self.recovered, "sequence": " | ".join(self.sequence)}


def only_criteria(criteria: object) -> None:
    """Refuse what is no :class:`Criteria`.

    Raises
    ------
    InputError
        With the way to make some.
    """
    if not isinstance(criteria, Criteria):
        raise InputError(f"criteria = {criteria!r}: must be criteria. Way out: criteria=Criteria(...).")


def margins(run: Trajectory, criteria: Criteria | None = None) -> Margins:
    """Margins and diagnostics of a completed run.

    Diagnostics: `v_it_min` (instantaneous), `time_below` (s below the criterion's v_it_min), `loss_share`,
    `loss_pu` (the largest lasting loss), `peak_loss_share` (instantaneous), `recovery_time` (s from the first
    fall below recovery_share to the last return above it; inf if it is still below at the end), `bess_energy`
    (discharged, pu s), `peak_loading` (largest i_g/i_max) and `preload` (i_g/i_max before the fault: at 1 the
    limiter is active from the start, and the import has less reactive power than its power factor says).

    Raises
    ------
    InputError
        `criteria` that are none; the run did not complete, lacks the outputs `v_it` and `p_g`, imports
        nothing before the fault, or is shorter than the windows.
    """
    criteria = Criteria() if criteria is None else criteria
    only_criteria(criteria)
    if not run.completed:
        raise InputError(f"margins: the run has no result to judge: {run.status}.")
    voltage = Curve.of(run, "v_it")
    power = Curve.of(run, "p_g")
    pre, pre_theta = float(power.y[0]), power.y_theta[0]
    if not pre > 0:
        raise InputError(
            f"margins: the import before the fault is p_g = {pre:g} pu; a load loss has no reference."
        )
    window = criteria.window if criteria.criterion == "sustained" else 0.0
    low = sustained_minimum(voltage, window)
    held = sustained_minimum(power, criteria.loss_window)
    share = 1.0 - held.value / pre
    share_theta = -(held.gradient - held.value / pre * pre_theta) / pre
    recovery = _recovery_time(power, criteria.recovery_share * pre)
    diagnostics = {
        "v_it_min": float(voltage.y.min()),
        "time_below": sum((b - a for a, b in voltage.stretches_below(criteria.v_it_min)), 0.0),
        "loss_share": share,
        "loss_pu": share * pre,
        "peak_loss_share": 1.0 - float(power.y.min()) / pre,
        "recovery_time": recovery,
    }
    if "p_b" in run.outputs.names:
        diagnostics["bess_energy"] = float(np.trapezoid(np.maximum(run["p_b"], 0.0), run.t))
    if "i_g" in run.outputs.names and "i_max" in run.outputs.names:
        loading = run["i_g"] / run["i_max"]
        diagnostics["peak_loading"] = float(np.max(loading))
        diagnostics["preload"] = float(loading[0])
    return Margins(
        voltage=_margin(run, low, low.value - criteria.v_it_min, low.gradient),
        loss=_margin(run, held, criteria.loss_share - share, -share_theta),
        sequence=run.sequence,
        diagnostics=diagnostics,
        recovered=criteria.recovery_time is None or recovery <= criteria.recovery_time,
    )


def _margin(run: Trajectory, at: Extremum, value: float, gradient: Array) -> Margin:
    grad = {theta: float(g) for theta, g in zip(run.wrt, gradient, strict=True)}
    return Margin(value, grad, at.time, at.kind, at.tie)


def _recovery_time(power: Curve, level: float) -> float:
    below = power.stretches_below(level)
    if not below:
        return 0.0
    return math.inf if below[-1][1] >= power.t[-1] else below[-1][1] - below[0][0]


# -- the functional ---------------------------------------------------------------------------------------


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
    def of(cls, run: Trajectory, name: str) -> Curve:
        """The output `name` of a run."""
        signals, k = run._find(name)
        if signals.rate is None:
            raise InputError(f"margins need {name!r} among the outputs of the system.")
        n, nw = len(run.t), len(run.wrt)
        y_theta = signals.sens[:, k] if signals.sens is not None else np.zeros((n, nw))
        rate_theta = signals.rate_sens[:, k] if signals.rate_sens is not None else np.zeros((n, nw))
        kind = np.full(n, "extremum")
        kind[[0, -1]] = "end"
        event_times = {e.time for e in run.events}
        t_theta = np.zeros((n, nw))
        for left, moved in zip(run.breaks, run.break_grad, strict=True):
            kind[left : left + 2] = "event" if float(run.t[left]) in event_times else "jump"
            t_theta[left : left + 2] = moved
        return cls.with_extrema(
            run.t, signals.value[:, k], signals.rate[:, k], y_theta, rate_theta, t_theta, kind
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
    if span < window:
        raise InputError(f"margins: the run lasts {span:g} s, less than the window of {window:g} s.")
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
    a_theta, a_slope = _end(curve, first - 1, begin)
    b_theta, b_slope = _end(curve, last, end)
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


def _end(curve: Curve, interval: int, time: float) -> tuple[Array, float | None]:
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
