r"""How far hosted load lowers the voltages of all hours, interpolated from a few.

At given capacities the drop of a voltage is a smooth function of the few parameters of an hour: load factor,
wind and data-centre factor. A quadratic through a sample of solved hours tells it for the others:

.. math::
    V_{\ell,t}(H) \approx V_{\ell,t}(0) - \sum_k c_{\ell k} \varphi_k(\theta_t)
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
import numpy.typing as npt

from dcvrt.planning.profiles import Year

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

SAMPLES = 2
"""Hours solved for each coefficient."""


class VoltageDrop:
    """Interpolation over the hours of a year.

    Parameters
    ----------
    year : Year
    """

    def __init__(self, year: Year) -> None:
        self.year = year

    @cached_property
    def features(self) -> Floats:
        """Products of at most two parameters of each hour, orthonormal over the hours, (hours, count)."""
        points = np.column_stack([self.year.load, *self.year.wind.values(), self.year.dc])
        points = points - points.mean(axis=0)
        size = abs(points).max(axis=0)
        points = points[:, size > 0] / size[size > 0]
        n = points.shape[1]
        pairs = [points[:, i] * points[:, j] for i in range(n) for j in range(i, n)]
        raw = np.column_stack([np.ones(len(points)), points, *pairs])
        if raw.shape[1] * SAMPLES >= len(raw):
            return raw
        left, singular, _ = np.linalg.svd(raw, full_matrices=False)
        return np.asarray(left[:, singular > 1e-8 * singular[0]] * np.sqrt(len(raw)))

    @cached_property
    def sample(self) -> Integers:
        """Hours that tell the coefficients: all of them where there are few."""
        count = SAMPLES * self.features.shape[1]
        if 3 * count >= len(self.year):
            return np.arange(len(self.year))
        # Hours that determine the coefficients best, one after the other: QR with column pivoting, in
        # rounds, each over the hours that are left.
        from scipy.linalg import qr

        left = np.arange(len(self.year))
        chosen: list[int] = []
        for _ in range(SAMPLES):
            _, order = qr(self.features[left].T, mode="r", pivoting=True)
            first = left[order[: self.features.shape[1]]]
            chosen += first.tolist()
            left = np.setdiff1d(left, first)
        return np.sort(np.array(chosen, dtype=np.int64))

    def expect(self, drop: Floats, at: Integers) -> Floats:
        """Drops in all hours, (rows, hours), from those found in the hours at the given places.

        Parameters
        ----------
        drop : array (rows, places)
        at : int array (places,)
        """
        known = self.features[at]
        coefficients, *_ = np.linalg.lstsq(known, drop.T, rcond=1e-12)
        return np.asarray((self.features @ coefficients).T)
