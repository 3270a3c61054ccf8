"""Hosting vectors that the surrogates learn from, and their split into fitting and validation sets."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dcvrt.errors import InputError, raise_all

Floats = npt.NDArray[np.float64]
Booleans = npt.NDArray[np.bool_]

NEAR_ZERO = 0.01
"""Share of the upper corner that stands for 'next to nothing hosted': a site with no load has no facility to
run."""


@dataclass(frozen=True, eq=False)
class Samples:
    """Sampled hosting vectors.

    Attributes
    ----------
    hosting : array (samples, sites)
        H in MW. Row 0 is the upper corner of the box, row 1 lies next to its lower corner.
    fit : bool array (samples,)
        True in the fitting set, False in the validation set. The two corners are in the fitting set.
    upper : array (sites,)
        Upper corner of the sampled box, MW: the box that plans are kept to.
    """

    hosting: Floats
    fit: Booleans
    upper: Floats

    def __len__(self) -> int:
        return len(self.hosting)


def sample_hosting(
    upper: npt.ArrayLike,
    n: int,
    seed: int,
    *,
    high_share: float = 0.5,
    high_from: float = 0.6,
    validation_share: float = 0.25,
) -> Samples:
    """Draw hosting vectors between nothing and the plan without ride-through (paper: Algorithm 1, line 2).

    A scrambled Sobol sequence fills the box [0, `upper`]; the first `high_share` of the points is squeezed
    into [`high_from`, 1] x `upper`, the high-capacity region that the plans are looked for in. Both corners
    of the box are always there.

    Parameters
    ----------
    upper : array (sites,)
        Upper corner of the box, MW.
    n : int
        Number of hosting vectors, corners included; at least 4.
    seed : int
        Of the sequence and of the split. The same seed gives the same samples everywhere.
    high_share, high_from : float
        Share of the points in the high-capacity region, and where it starts.
    validation_share : float
        Share of the vectors that no fit may see.

    Raises
    ------
    InputError
        For a corner that is negative, not finite or all zero, and for too few samples.

    Examples
    --------
    >>> samples = sample_hosting([30.0, 150.0], n=8, seed=1)
    >>> samples.hosting[0].tolist(), int(samples.fit.sum())
    ([30.0, 150.0], 6)
    """
    from scipy.stats import qmc

    corner = np.asarray(upper, dtype=float)
    problems = []
    if corner.ndim != 1 or not np.isfinite(corner).all() or (corner < 0).any():
        problems.append(f"upper = {corner.tolist()}: needs one capacity of 0 MW or more for each site.")
    elif not corner.any():
        problems.append(
            "upper is zero at every site: there is nothing to sample. "
            "Way out: look at what binds the plan without ride-through, or give sampling.h_max_mw."
        )
    if n < 4:
        problems.append(f"n = {n}: needs at least 4 samples, two of them the corners of the box.")
    raise_all(problems, "sample_hosting", InputError)
    free = n - 2
    sequence = qmc.Sobol(len(corner), scramble=True, rng=np.random.default_rng(seed))
    unit = sequence.random_base2(max(1, int(np.ceil(np.log2(free)))))[:free]
    high = np.arange(free) < round(high_share * free)
    unit[high] = high_from + (1.0 - high_from) * unit[high]
    hosting = np.vstack([corner, NEAR_ZERO * corner, unit * corner])
    fit = np.ones(n, dtype=bool)
    held_out = max(1, round(validation_share * n))
    fit[2 + np.random.default_rng([seed, 1]).permutation(free)[: min(held_out, free - 1)]] = False
    return Samples(np.round(hosting, 6), fit, corner)
