"""Where guards cross zero: found on the samples of a stretch with their slopes, on the cubic between them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def first_crossing(t: Array, h: Array, rate: Array) -> tuple[int, dict[int, tuple[float, float]]] | None:
    """First interval in which some column of `h` goes from <= 0 to > 0.

    A column that is above zero only *between* two samples is found too, by the maximum of the cubic there.

    Parameters
    ----------
    t : times, (n,).
    h, rate : values and slopes, (n, columns); columns that do not matter hold -1.

    Returns
    -------
    interval number, and for each column that crosses in it the time at which the cubic does, and a time by
    which it has; None when nothing crosses.
    """
    over = h[1:] > 0
    step = np.diff(t)[:, None]
    hump = ~over & (rate[:-1] > 0) & (rate[1:] < 0) & (h[:-1] <= 0)
    hump &= np.minimum(h[:-1] + rate[:-1] * step, h[1:] - rate[1:] * step) > 0
    candidates = np.flatnonzero((over | hump).any(axis=1))
    for i in candidates:
        found: dict[int, tuple[float, float]] = {}
        for k in np.flatnonzero(over[i]):
            s = _rise(1.0, float(step[i, 0]), h[i, k], rate[i, k], h[i + 1, k], rate[i + 1, k])
            found[int(k)] = (float(t[i]) + s * float(step[i, 0]), float(t[i + 1]))
        for k in np.flatnonzero(hump[i]):
            peak = _peak(float(step[i, 0]), h[i, k], rate[i, k], h[i + 1, k], rate[i + 1, k])
            if peak is not None:
                s = _rise(peak, float(step[i, 0]), h[i, k], rate[i, k], h[i + 1, k], rate[i + 1, k])
                found[int(k)] = (float(t[i]) + s * float(step[i, 0]), float(t[i]) + peak * float(step[i, 0]))
        if found:
            return int(i), found
    return None


def _peak(step: float, a: float, da: float, b: float, db: float) -> float | None:
    """Fraction of the step at which the cubic through two samples is largest, if it is above zero there."""
    c1, c2, c3 = da * step, 3 * (b - a) - (2 * da + db) * step, (da + db) * step - 2 * (b - a)
    for s in quadratic_roots(3 * c3, 2 * c2, c1):
        if 0 < s < 1 and a + s * (c1 + s * (c2 + s * c3)) > 0:
            return s
    return None


def _rise(high: float, step: float, a: float, da: float, b: float, db: float) -> float:
    """Fraction in [0, high] at which the cubic through two samples rises through zero, by bisection."""
    c1, c2, c3 = da * step, 3 * (b - a) - (2 * da + db) * step, (da + db) * step - 2 * (b - a)
    low = 0.0
    for _ in range(40):
        s = 0.5 * (low + high)
        low, high = (low, s) if a + s * (c1 + s * (c2 + s * c3)) > 0 else (s, high)
    return high


def quadratic_roots(a: float, b: float, c: float) -> list[float]:
    """Real roots of a s^2 + b s + c without cancellation."""
    if a == 0:
        return [-c / b] if b != 0 else []
    disc = b * b - 4 * a * c
    if disc < 0:
        return []
    m = -0.5 * (b + (disc**0.5 if b >= 0 else -(disc**0.5)))
    return [m / a] + ([c / m] if m != 0 else [])
