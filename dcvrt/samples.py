r"""Samples over time: when they can be used, and the C1 cubic through them.

**A time that stands twice is a jump**: the first value holds up to it, the second from it on. Between jumps

.. math::
    y(t_k + s T_k) = c_0 + c_1 s + c_2 s^2 + c_3 s^3, \qquad 0 \le s \le 1,

with the slope of the parabola through three neighbours at inner samples and of the one-sided parabola at
jumps and ends; two points alone are joined by a straight line. The slopes are linear in the samples.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dcvrt.errors import InputError

Array = NDArray[np.float64]


WIDE = 10
"""So many usual steps without a sample are a gap of a record."""


def gaps(t: Array) -> list[str]:
    """The first gap of a record that is sampled at a fixed interval, told; none of points set by hand.

    Twenty steps or more, nine in ten of them within 1 % of the median, are a fixed interval.
    """
    steps = np.diff(t)
    steps = steps[steps > 0]  # at a jump a time stands twice
    if len(steps) < 20 or np.mean(np.abs(steps / np.median(steps) - 1) < 0.01) < 0.9:
        return []
    usual = float(np.median(steps))
    wide = np.flatnonzero(np.diff(t) > WIDE * usual)
    return [
        f"no sample between {t[k]:g} s and {t[k + 1]:g} s of a record with one every {usual:.6g} s. "
        "Fill the gap, or give the part before or after it."
        for k in wide[:1]
    ]


@dataclass(frozen=True, eq=False)
class Pieces:
    """Piecewise cubic: value = sum_j coefficients[k, j] * s**j with s = (t - start[k]) / length[k] in [0, 1].

    `after_jump[k]` marks pieces that do not continue the one before them.
    """

    start: Array
    length: Array
    coefficients: NDArray[Any]
    after_jump: NDArray[np.bool_]

    def at(self, t: ArrayLike) -> NDArray[Any]:
        """Value at times `t`; at a jump the value after it. Outside the range the end values hold."""
        t = np.asarray(t, dtype=float)
        k = np.clip(np.searchsorted(self.start, t, side="right") - 1, 0, len(self.start) - 1)
        s = np.clip((t - self.start[k]) / self.length[k], 0.0, 1.0)
        c = self.coefficients[k]
        return c[..., 0] + s * (c[..., 1] + s * (c[..., 2] + s * c[..., 3]))

    def on(self, start: Array, length: Array) -> NDArray[Any]:
        """Coefficients of the same function on finer pieces, each of which lies in one piece of this."""
        k = np.clip(np.searchsorted(self.start, start + length / 2, side="right") - 1, 0, len(self.start) - 1)
        a, h = (start - self.start[k]) / self.length[k], length / self.length[k]
        c0, c1, c2, c3 = self.coefficients[k].T
        moved = (
            c0 + a * (c1 + a * (c2 + a * c3)),
            h * (c1 + a * (2 * c2 + 3 * a * c3)),
            h**2 * (c2 + 3 * a * c3),
            h**3 * c3,
        )
        return np.stack(moved, axis=1)


def cubic_pieces(t: Array, v: NDArray[Any]) -> Pieces:
    """Pieces of the C1 cubic through `v` at `t`; a time that stands twice is a jump."""
    slope = _slopes(t, v)
    real = np.flatnonzero(np.diff(t) > 0)
    length = t[real + 1] - t[real]
    m0, m1, rise = slope[real] * length, slope[real + 1] * length, v[real + 1] - v[real]
    coefficients = np.stack((v[real], m0, 3 * rise - 2 * m0 - m1, m0 + m1 - 2 * rise), axis=1)
    after_jump = np.zeros(len(real), dtype=bool)
    after_jump[1:] = np.diff(real) > 1
    return Pieces(t[real], length, coefficients, after_jump)


def _slopes(t: Array, v: NDArray[Any]) -> NDArray[Any]:
    """Slope at every sample: of the parabola through three neighbours between jumps."""
    slope = np.zeros_like(v)
    edges = np.concatenate(([0], np.flatnonzero(np.diff(t) == 0) + 1, [len(t)]))
    for a, b in itertools.pairwise(edges):
        if b - a < 2:
            continue
        h = np.diff(t[a:b])
        secant = np.diff(v[a:b]) / h
        if b - a == 2:
            slope[a:b] = secant[0]
            continue
        slope[a + 1 : b - 1] = (h[1:] * secant[:-1] + h[:-1] * secant[1:]) / (h[:-1] + h[1:])
        slope[a] = secant[0] + h[0] * (secant[0] - secant[1]) / (h[0] + h[1])
        slope[b - 1] = secant[-1] + h[-1] * (secant[-1] - secant[-2]) / (h[-1] + h[-2])
    return slope


def check_samples(t: ArrayLike, v: ArrayLike, what: str) -> list[str]:
    """Say what is wrong with samples `v` on times `t`: one line a fault, none when they can be used."""
    t, v = np.asarray(t), np.asarray(v)
    if t.ndim != 1 or v.shape != t.shape:
        return [f"t has shape {t.shape} and {what} {v.shape}; both must be one column of the same length."]
    if len(t) < 2:
        return [f"{len(t)} sample(s); at least two times are needed."]
    problems = []
    for label, values in (("t", t), (what, v)):
        bad = np.flatnonzero(~np.isfinite(values))
        if len(bad):
            more = f" and {len(bad) - 1} more" if len(bad) > 1 else ""
            problems.append(f"{label}[{bad[0]}] is {values[bad[0]]}{more}.")
    step = np.diff(t)
    back = np.flatnonzero(step < 0)
    if len(back):
        k = back[0] + 1
        problems.append(
            f"times do not increase: t[{k}] = {t[k]:g} s comes after t[{k - 1}] = {t[k - 1]:g} s."
        )
    triple = np.flatnonzero((step[:-1] == 0) & (step[1:] == 0))
    if len(triple):
        k = triple[0]
        problems.append(
            f"t[{k}] = t[{k + 1}] = t[{k + 2}] = {t[k]:g} s: "
            "a time may stand twice (a jump), not three times."
        )
    if not problems and t[-1] <= t[0]:
        problems.append(f"it lasts no time: first and last time are {t[0]:g} s.")
    return problems


def negative(magnitudes: ArrayLike, what: str) -> list[str]:
    """Say which magnitude (a voltage given as a real number) is negative: one line, none when none is."""
    values = np.asarray(magnitudes)
    if np.iscomplexobj(values) or not (values < 0).any():
        return []
    k = int(np.argmax(values < 0))
    return [f"{what}[{k}] = {values[k]:g} pu is negative. Write a complex value to turn the phasor."]


def spans_of_steps(
    steps: Sequence[Sequence[Any]], until: float | None
) -> tuple[list[tuple[float, float]], list[str]]:
    """Begin and end of every entry of a stepped waveform, and what is wrong with them.

    Raises
    ------
    InputError
        no entries, or one that has neither two nor three parts.
    """
    if not steps:
        raise InputError(
            "waveform: no segments given; write for example [(0.0, 1.0), (0.1, 0.5), (0.2, 1.0)]."
        )
    wrong = [k for k, s in enumerate(steps) if len(s) not in (2, 3)]
    if wrong:
        raise InputError(
            f"waveform: segment {wrong[0]} is {steps[wrong[0]]!r}; write (t, v) or (t, v_from, v_to)."
        )
    begins = [float(s[0]) for s in steps]
    spans = list(zip(begins, [*begins[1:], begins[-1] + 1.0 if until is None else float(until)], strict=True))
    return spans, [
        f"segment {k} begins at {a:g} s and ends at {b:g} s; times must increase."
        for k, (a, b) in enumerate(spans)
        if not b > a
    ]
