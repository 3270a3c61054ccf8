"""Forms of the margins side by side: what each keeps of the feasible points, on margins in closed form."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dcvrt.errors import InputError
from dcvrt.planning.kept import lower_bound, one_sided, pieces, side_by_side
from dcvrt.planning.surrogate import MarginData

SITES = (1, 2)


def samples(
    margin, slope, n: int = 60, betas: tuple[float, ...] = (1.1, 1.3), fit: bool | None = None
) -> tuple[MarginData, np.ndarray]:
    """Runs of one fault and period with a loss margin of each site, in MW over a load of its own H."""
    rng = np.random.default_rng(1)
    H = rng.uniform(1.0, 100.0, (n, 2))
    rows = [(k, site, beta) for k in range(n) for site in SITES for beta in betas]
    hosting = np.array([H[k] for k, *_ in rows])
    loss = np.array([margin(H[k], site, beta) for k, site, beta in rows])
    own = np.array([H[k][site - 1] for k, site, _ in rows])
    same = np.full(len(rows), "x")
    slopes = np.zeros((len(rows), 2, 2))
    slopes[:, 1] = [slope(H[k], site, beta) for k, site, beta in rows]
    data = MarginData(
        SITES,
        hosting,
        np.ones(len(rows)),
        same,
        same,
        np.full(len(rows), "gfl"),
        np.array([site for _, site, _ in rows]),
        np.array([beta for *_, beta in rows]),
        np.full(len(rows), 0.1),
        loss,
        loss * own,
        np.ones(len(rows), dtype=bool),
        np.full(len(rows), "completed"),
        np.full(len(rows), "NORMAL"),
        np.array([k % 4 != 0 if fit is None else fit for k, *_ in rows]),
        np.array([f"s{k:03}" for k, *_ in rows]),
    )
    return data, slopes


def kinked(H: np.ndarray, site: int, beta: float) -> float:
    """Level, then falling with both capacities: concave."""
    return min(0.05, 0.25 * beta - 0.2 - 1e-3 * H[site - 1] - 2e-4 * H.sum())


def kinked_slope(H: np.ndarray, site: int, beta: float) -> np.ndarray:
    if kinked(H, site, beta) >= 0.05:
        return np.zeros(2)
    return -2e-4 - 1e-3 * (np.arange(2) == site - 1)


def test_every_form_is_safe_and_pieces_keep_most_of_a_kinked_margin() -> None:
    data, slopes = samples(kinked, kinked_slope)
    found = {one.method: one for one in side_by_side(data, slopes)}
    assert list(found) == ["paper", "share", "bound", "pieces"]
    assert len({one.feasible for one in found.values()}) == 1
    assert found["pieces"].feasible > 20
    assert found["pieces"].share == 1.0  # piecewise affine, so the pieces are exact
    assert found["pieces"].false_passes == 0
    assert found["pieces"].scores["loss"].mae < 1e-12
    assert found["share"].share < 1.0
    assert found["bound"].share >= found["share"].share


def test_without_gradients_there_are_no_pieces() -> None:
    data, _ = samples(kinked, kinked_slope)
    assert [one.method for one in side_by_side(data)] == ["paper", "share", "bound"]


def test_a_lower_bound_lies_below_every_sample() -> None:
    rng = np.random.default_rng(2)
    x = np.column_stack([np.ones(40), rng.uniform(0, 100, (40, 3))])
    m = rng.normal(size=40)
    k = lower_bound(x, m)
    assert (x @ k <= m + 1e-15).all()
    assert np.isclose(x @ k, m, atol=1e-7).sum() >= 4


def test_sequences_are_not_mixed_in_a_piece() -> None:
    H = np.array([[0.0], [1.0], [2.0]])
    found = pieces(H, np.array([1.0, 0.9, -0.75]), np.full((3, 1), -0.1), ["a", "a", "a>BATTERY"])
    assert len(found) == 2


def test_margins_seen_from_one_side_are_named() -> None:
    data, _ = samples(lambda H, site, beta: 0.1 if site == 1 else 0.05 - 1e-3 * H[1], lambda *_: np.zeros(2))
    said = one_sided(data)
    assert "loss at bus 1, fault x, gfl, beta 1.1: every sample meets it" in said
    assert not any(line.startswith("loss at bus 2") for line in said)


def test_nothing_held_out_is_refused() -> None:
    data, _ = samples(kinked, kinked_slope, fit=True)
    with pytest.raises(InputError) as error:
        side_by_side(data)
    assert str(error.value) == "surrogates side by side: no hosting vector was held out to judge them on."


def test_a_site_that_hosts_nothing_is_no_pair() -> None:
    """In MW its margin is 0, so that every form in MW would pass it, whatever its share."""
    data, _ = samples(lambda H, site, beta: 0.1 if site == 1 else -0.1, kinked_slope)
    hosting = data.hosting.copy()
    hosting[:, 1] = 0.0
    closed = replace(data, hosting=hosting, loss_mw=np.where(data.site == 2, 0.0, data.loss_mw))
    for form in side_by_side(closed):
        assert form.feasible == form.kept == 15 * 2
        assert form.false_passes == 0
