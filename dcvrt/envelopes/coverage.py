"""How a waveform lies to an envelope: when voltage or frequency leaves what the code covers.

A band lasts from the moment the voltage leaves the continuous range, so that at the time tau after it the
worst voltage covered is that of the most severe band whose time is not over. A frequency may stay in a band
for its time in all.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dcvrt.envelopes.choices import Yardstick
from dcvrt.envelopes.table import Band, Envelope
from dcvrt.waveform import Waveform

Array = NDArray[np.float64]
STEP = 1e-3
"""Distance, s, at which a waveform is looked at; jumps are met exactly."""
SAME_TIME, SAME_LEVEL, SAME_HZ = 1e-9, 1e-6, 1e-3


@dataclass(frozen=True, eq=False)
class Course:
    """A waveform on times at most `STEP` apart, jumps with both their values."""

    waveform: Waveform
    t: Array
    magnitude: Array

    @classmethod
    def of(cls, waveform: Waveform) -> Course:
        """Look at a waveform."""
        fine = waveform.resampled(STEP)
        return cls(waveform, fine.t, fine.magnitude)

    def frequency(self, v_floor: float) -> tuple[Array, Array, Array]:
        """Begin, duration and mean deviation from nominal, Hz, of every step with a voltage.

        Taken from the samples that were given: between them the angle of the cubic ripples.
        """
        t, v, m = self.waveform.t, self.waveform.v, self.waveform.magnitude
        step = np.diff(t)
        k = np.flatnonzero((step > 0) & (m[:-1] > v_floor) & (m[1:] > v_floor))
        return t[k], step[k], np.angle(v[k + 1] * v[k].conj()) / (2 * np.pi * step[k])


def spans(where: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First and last sample of every stretch in which something is the case."""
    edge = np.diff(np.concatenate(([False], where, [False])).astype(np.int8))
    ends = zip(np.flatnonzero(edge == 1), np.flatnonzero(edge == -1) - 1, strict=True)
    return [(int(first), int(last)) for first, last in ends]


def limit(bands: tuple[Band, ...], steady: float, tau: Array, side: int) -> Array:
    """Worst voltage that the curve still contains a time `tau` after the range was left; side -1 low, +1
    high."""
    worst = np.full(len(tau), steady)
    for band in bands:
        far = side * math.inf if band.severe is None else band.severe
        beyond = np.maximum(worst, far) if side > 0 else np.minimum(worst, far)
        worst = np.where(tau <= band.time + SAME_TIME, beyond, worst)
    return worst


def covered_until(envelope: Envelope, course: Course, yardstick: Yardstick) -> tuple[float, str]:
    """When voltage or frequency leaves what the code covers, and how; the end of the waveform if never."""
    end = float(course.t[-1])
    if envelope.kind == "cases":
        return end, ""
    found = [(end, "")]
    if envelope.continuous is not None:
        low, high = envelope.continuous.low, envelope.continuous.high
        m = course.magnitude
        outside = (m < low - SAME_LEVEL) | (m > high + SAME_LEVEL)
        for first, last in spans(outside):
            part = slice(first, last + 1)
            tau = course.t[part] - course.t[first]
            beyond = (m[part] < limit(envelope.low, low, tau, -1) - SAME_LEVEL) | (
                m[part] > limit(envelope.high, high, tau, +1) + SAME_LEVEL
            )
            if beyond.any():
                k = first + int(np.argmax(beyond))
                found.append(
                    (float(course.t[k]), f"{m[k]:.3g} pu after {course.t[k] - course.t[first]:.3g} s")
                )
                break
    if envelope.frequency:
        begin, step, deviation = course.frequency(yardstick.v_floor)
        f = envelope.nominal_hz + deviation
        inside = np.zeros(len(f), dtype=bool)
        for band in envelope.frequency:
            within = (f >= band.low - SAME_HZ) & (f <= band.high + SAME_HZ)
            spent = np.cumsum(np.where(within & ~inside, step, 0.0))
            inside |= within & (spent <= band.time + SAME_TIME)
        if not inside.all():
            k = int(np.argmax(~inside))
            found.append((float(begin[k]), f"{f[k]:.4g} Hz"))
    return min(found, key=lambda entry: entry[0])
