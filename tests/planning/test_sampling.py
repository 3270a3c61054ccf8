"""Sampled hosting vectors: inside the box, reproducible, both corners there, a split that fits need."""

from __future__ import annotations

import numpy as np
import pytest

from dcvrt.errors import InputError
from dcvrt.planning.sampling import NEAR_ZERO, sample_hosting

UPPER = np.array([31.4, 153.9, 102.4, 104.1])


def test_samples_lie_in_the_box_and_include_both_corners() -> None:
    samples = sample_hosting(UPPER, n=24, seed=7)
    assert samples.hosting.shape == (24, 4)
    assert (samples.hosting >= 0).all()
    assert (samples.hosting <= UPPER).all()
    np.testing.assert_array_equal(samples.hosting[0], UPPER)
    np.testing.assert_allclose(samples.hosting[1], NEAR_ZERO * UPPER, rtol=1e-6)
    assert samples.fit[0]
    assert samples.fit[1]


def test_half_of_the_samples_lie_in_the_high_capacity_region() -> None:
    samples = sample_hosting(UPPER, n=34, seed=7, high_share=0.5, high_from=0.6)
    high = (samples.hosting[2:] >= 0.6 * UPPER).all(axis=1)
    assert high[:16].all()
    assert not high[16:].all()


def test_the_seed_decides_samples_and_split() -> None:
    one, again, other = (sample_hosting(UPPER, n=20, seed=s) for s in (3, 3, 4))
    np.testing.assert_array_equal(one.hosting, again.hosting)
    np.testing.assert_array_equal(one.fit, again.fit)
    assert not np.array_equal(one.hosting, other.hosting)


@pytest.mark.parametrize("n", [6, 10, 24, 33])
def test_the_validation_share_is_kept(n: int) -> None:
    samples = sample_hosting(UPPER, n=n, seed=1, validation_share=0.25)
    assert (~samples.fit).sum() == max(1, round(0.25 * n))


def test_the_box_is_filled_evenly() -> None:
    """Sobol points: every eighth of each axis gets its share, give or take one."""
    samples = sample_hosting(UPPER, n=66, seed=5, high_share=0.0)
    for site in range(4):
        counts, _ = np.histogram(samples.hosting[2:, site] / UPPER[site], bins=8, range=(0, 1))
        assert (abs(counts - 8) <= 1).all()


def test_a_site_that_hosts_nothing_is_sampled_at_nothing() -> None:
    assert not sample_hosting([0.0, 50.0], n=8, seed=1).hosting[:, 0].any()


def test_bad_corners_are_named_at_once() -> None:
    with pytest.raises(InputError) as caught:
        sample_hosting([10.0, -5.0], n=2, seed=1)
    assert str(caught.value) == (
        "sample_hosting: 2 problems\n"
        "  upper = [10.0, -5.0]: needs one capacity of 0 MW or more for each site.\n"
        "  n = 2: needs at least 4 samples, two of them the corners of the box."
    )


def test_nothing_to_sample_says_so() -> None:
    with pytest.raises(InputError) as caught:
        sample_hosting([0.0, 0.0], n=8, seed=1)
    assert str(caught.value) == (
        "sample_hosting: upper is zero at every site: there is nothing to sample. "
        "Way out: look at what binds the plan without ride-through, or give sampling.h_max_mw."
    )
