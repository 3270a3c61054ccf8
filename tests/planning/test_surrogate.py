"""Surrogates: exact on affine margins, never above a fitted point, conservative on kinked ones, honest about
failures."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dcvrt.errors import InputError
from dcvrt.planning.sampling import sample_hosting
from dcvrt.planning.surrogate import (
    MarginData,
    false_passes,
    fit_surrogates,
    least_squares,
    score,
)

SITES = (21, 75)
UPPER = np.array([30.0, 150.0])
PERIODS = {"peak": 1.0, "light": 0.8}
LAMBDA = 0.10


def runs(
    voltage,
    loss_share,
    betas=(1.0, 1.2, 1.4),
    n=40,
    seed=2,
    failed=lambda H, beta: False,
    sequence=lambda H, beta: "NORMAL",
) -> MarginData:
    """Margins given as functions of (H, d, beta, own site) on sampled hosting vectors."""
    samples = sample_hosting(UPPER, n=n, seed=seed)
    rows = []
    for k, H in enumerate(samples.hosting):
        for period, d in PERIODS.items():
            for own, site in enumerate(SITES):
                for beta in betas:
                    share = loss_share(H, d, beta, own)
                    ok = not failed(H, beta)
                    rows.append(
                        (
                            H,
                            d,
                            period,
                            site,
                            beta,
                            voltage(H, d, beta, own) if ok else np.nan,
                            share if ok else np.nan,
                            share * d * H[own] if ok else np.nan,
                            ok,
                            sequence(H, beta),
                            samples.fit[k],
                            f"s{k:03}",
                        )
                    )
    columns = [np.array(column) for column in zip(*rows, strict=True)]
    H, d, period, site, beta, v, share, mw, ok, order, fit, name = columns
    return MarginData(
        sites=SITES,
        hosting=H,
        d=d,
        period=period,
        fault=np.full(len(d), "bus 32"),
        mode=np.full(len(d), "gfl"),
        site=site,
        beta=beta,
        voltage=v,
        loss_share=share,
        loss_mw=mw,
        ok=ok,
        status=np.where(ok, "completed", "gfl: no equilibrium at rest. Largest residuals:\n  dc.w = 1"),
        sequence=order,
        fit=fit,
        name=name,
    )


def retained(H, d, own):
    """Voltage that the fault leaves, affine in the load."""
    return 0.72 + 0.05 * own - d * (H @ [2e-4, 1e-4])


def static_loss(H, d, beta, own):
    """Static loss law: lambda - (1 - min(1, beta V))."""
    return LAMBDA - (1.0 - min(1.0, beta * retained(H, d, own)))


def affine(H, d, beta, own):
    return 0.02 - 3e-4 * d * H[0] + 1e-4 * d * H[1] + 2e-3 * beta * H[own]


def test_least_squares_recovers_coefficients_and_keeps_signs() -> None:
    rng = np.random.default_rng(0)
    x = np.column_stack([np.ones(50), rng.uniform(0, 150, (50, 3))])
    true = np.array([0.5, -2e-3, 1e-3, 4e-4])
    np.testing.assert_allclose(least_squares(x, x @ true), true, rtol=1e-10)
    np.testing.assert_allclose(least_squares(x, x @ true, not_negative=[3]), true, rtol=1e-10)
    bounded = least_squares(x, x @ true, not_negative=[1])
    assert bounded[1] == 0.0
    kept = np.delete(np.arange(4), 1)  # what is left is the plain least squares without the column
    np.testing.assert_allclose(bounded[kept], np.linalg.lstsq(x[:, kept], x @ true, rcond=None)[0], rtol=1e-8)


def test_paper_surrogate_recovers_an_affine_margin() -> None:
    fits = fit_surrogates(runs(affine, lambda *a: 0.0), "paper")
    for f in (f for f in fits if f.target == "voltage"):
        own = SITES.index(f.site)
        assert f.intercept == pytest.approx(0.02, abs=1e-10)
        assert f.slopes == pytest.approx([-3e-4, 1e-4], abs=1e-12)
        assert f.rating_slope == pytest.approx(2e-3, abs=1e-12)
        assert f.tightening < 1e-12
        assert f.scores.rmse < 1e-12
        assert f.scores.violation_rate == 0.0
        coefficients, bound = f.at(beta=1.2, d=0.8, own=own)
        H = np.array([10.0, 60.0])
        assert coefficients @ H - bound == pytest.approx(affine(H, 0.8, 1.2, own), abs=1e-12)


def test_share_surrogate_recovers_a_margin_affine_at_each_rating_and_period() -> None:
    def margin(H, d, beta, own):
        return beta**2 * (0.05 if d == 1.0 else 0.08) + d * (H @ [-2e-4 * beta, 1e-4])

    for f in fit_surrogates(runs(margin, margin), "share"):
        assert f.intercept == pytest.approx(f.beta**2 * (0.05 if f.period == "peak" else 0.08), abs=1e-10)
        assert f.slopes == pytest.approx([-2e-4 * f.beta, 1e-4], abs=1e-12)
        assert f.rating_slope == 0.0
        assert f.tightening < 1e-12


@pytest.mark.parametrize("method", ["paper", "share"])
@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10_000), kink=st.floats(-0.05, 0.05), slope=st.floats(-1e-3, 1e-3))
def test_tightening_never_overpredicts_a_fitted_point(
    method: str, seed: int, kink: float, slope: float
) -> None:
    rng = np.random.default_rng(seed)

    def rough(H, d, beta, own):
        return min(kink, slope * (H[own] - 20.0)) + rng.normal(0, 0.01)

    data = runs(rough, rough, n=20, seed=seed)
    for f in fit_surrogates(data, method):
        chosen = (
            (data.site == f.site)
            & data.fit
            & ((data.period == f.period) | (f.period == ""))
            & ((data.beta == f.beta) | (f.beta == 0))
        )
        guess = f.predict(data.hosting[chosen], data.d[chosen], data.beta[chosen], SITES.index(f.site))
        assert (guess <= data.margin(f.target, method)[chosen] + 1e-10).all()
        assert f.n_fit == chosen.sum()


@pytest.mark.parametrize("method", ["paper", "share"])
def test_a_saturating_margin_gets_no_false_pass_where_it_was_sampled(method: str) -> None:
    data = runs(lambda *a: 0.02, static_loss, betas=(1.1, 1.2, 1.25, 1.3, 1.4))
    fits = fit_surrogates(data, method)
    assert all(f.tightening > 0 for f in fits if f.target == "loss" and f.beta == 1.25 and f.site == 21)
    assert not any(false_passes(f.validation[2], f.validation[1]).any() for f in fits)
    assert all(f.scores.violation_rate == 0.0 for f in fits)


def test_share_surrogate_agrees_with_the_static_loss_law() -> None:
    """loss <= lambda iff V >= (1 - lambda)/beta: at ratings that no kink disturbs, the fit's sign is the
    law's."""
    data = runs(lambda *a: 0.02, static_loss, betas=(1.1, 1.15, 1.2, 1.25, 1.3))
    rng = np.random.default_rng(9)
    seen = set()
    for f in fit_surrogates(data, "share"):
        if f.target != "loss" or f.tightening > 1e-9:
            continue
        own, d = SITES.index(f.site), PERIODS[f.period]
        for H in rng.uniform(0, UPPER, (50, 2)):
            passes = retained(H, d, own) >= (1 - LAMBDA) / f.beta
            seen.add(passes)
            assert (f.predict(H[None], d, f.beta, own)[0] >= -1e-9) == passes
    assert seen == {True, False}


def test_paper_rows_never_get_harder_as_the_rating_rises() -> None:
    falling = runs(lambda H, d, beta, own: 0.05 - 0.02 * beta * H[own] / 30.0, static_loss)
    for f in fit_surrogates(falling, "paper"):
        assert f.rating_slope >= 0.0
        own = SITES.index(f.site)
        low, high = (f.at(beta, 1.0, own) for beta in (1.0, 1.5))
        assert (high[0] >= low[0]).all()
        assert high[1] == low[1]


def test_failed_runs_are_left_out_and_counted() -> None:
    def fails(H, beta):
        return H[1] > 120.0 and beta > 1.3

    data = runs(affine, static_loss, failed=fails)
    bad = int((~data.ok & data.fit).sum())
    assert bad > 0
    fits = fit_surrogates(data, "paper")
    assert sum(f.n_excluded for f in fits) == 2 * bad  # both targets
    assert all(f.tightening < 1e-12 for f in fits if f.target == "voltage"), "a failed run moved a fit"


@pytest.mark.parametrize("method", ["paper", "share"])
def test_a_failed_validation_run_that_is_passed_counts_as_a_false_pass(method: str) -> None:
    """Margins are affine and positive, so that all points are passed: false passes are the failed runs."""
    data = runs(lambda *a: 0.02, lambda *a: 0.05, failed=lambda H, beta: 60.0 < H[1] < 100.0)
    lost = ~data.ok & ~data.fit
    assert 0 < lost.sum() < (~data.fit).sum()
    for f in fit_surrogates(data, method):
        here = (
            (data.site == f.site)
            & ~data.fit
            & ((data.period == f.period) | (f.period == ""))
            & ((data.beta == f.beta) | (f.beta == 0))
        )
        assert (f.scores.n, f.scores.n_failed) == ((here & data.ok).sum(), (here & lost).sum())
        passed = f.predict(data.hosting[here], data.d[here], data.beta[here], SITES.index(f.site)) >= 0
        assert f.scores.violation_rate == pytest.approx((passed & lost[here]).sum() / here.sum())
        assert f.scores.violation_rate > 0
        assert f.scores.mae < 0.5
        assert np.isnan(f.validation[1]).sum() == f.scores.n_failed


def test_mixed_event_sequences_are_counted() -> None:
    data = runs(
        affine,
        static_loss,
        sequence=lambda H, beta: "NORMAL>BATTERY" if beta < 1.1 and H[0] > 15 else "NORMAL",
    )
    other = int(((data.sequence != "NORMAL") & data.fit & (data.site == 21)).sum())
    f = next(f for f in fit_surrogates(data, "paper") if f.site == 21)
    assert (f.n_mixed, f.n_sequences) == (other, 2)


@pytest.mark.parametrize("method", ["paper", "share"])
def test_too_few_good_runs_mean_that_nothing_passes(method: str) -> None:
    data = runs(affine, static_loss, betas=(1.2,), failed=lambda H, beta: H[0] > 0.31 or H[1] > 1.6)
    assert (data.ok & (data.site == 21)).sum() == 2  # one hosting vector in two periods
    fits = fit_surrogates(data, method)
    assert {(f.intercept, f.scores.n) for f in fits} == {(-np.inf, 0)}
    assert {place for f in fits for place in f.unknown} == {(1.2, "peak"), (1.2, "light")}
    vectors = int((data.fit & (data.site == 21) & (data.period == "peak")).sum())
    assert {why for f in fits for why in f.unknown.values()} <= {
        f"{good} of {vectors} runs in the fitting set have a margin, too few for a fit; "
        "the reason: gfl: no equilibrium at rest"
        for good in (1, 2)
    } | {"every run of the fitting set failed; the reason: gfl: no equilibrium at rest"}


def test_a_rating_without_any_good_run_is_unknown_and_the_others_are_fitted() -> None:
    data = runs(affine, static_loss, failed=lambda H, beta: beta == 1.0)
    why = "every run of the fitting set failed; the reason: gfl: no equilibrium at rest"
    for f in fit_surrogates(data, "paper"):
        assert f.unknown == {(1.0, "light"): why, (1.0, "peak"): why}
        assert f.scores.n_failed == 0, "where nothing is known nothing is passed"
        assert f.target == "loss" or f.slopes == pytest.approx([-3e-4, 1e-4], abs=1e-12)
    for f in fit_surrogates(data, "share"):
        assert f.unknown == ({(1.0, f.period): why} if f.beta == 1.0 else {})
        assert np.isfinite(f.intercept) == (f.beta != 1.0)


def test_a_run_marked_ok_without_a_margin_is_refused() -> None:
    data = runs(affine, static_loss)
    voltage = data.voltage.copy()
    voltage[3] = np.nan
    with pytest.raises(InputError) as caught:
        MarginData(**{**vars(data), "voltage": voltage})
    assert str(caught.value) == "margins: voltage is not finite in 1 run(s) that are marked ok."


def test_unknown_method_is_named() -> None:
    with pytest.raises(InputError) as caught:
        fit_surrogates(runs(affine, static_loss), "quadratic")
    assert str(caught.value) == "surrogate method 'quadratic': must be 'paper' or 'share'."


def test_scores_are_the_textbook_ones() -> None:
    s = score([0.3, -0.1, 0.2], [0.1, 0.1, -0.2])
    assert (s.n, s.mae, s.rmse) == (3, pytest.approx(0.8 / 3), pytest.approx(np.sqrt(0.24 / 3)))
    assert (s.worst_over, s.worst_under, s.violation_rate) == (
        pytest.approx(0.4),
        pytest.approx(0.2),
        pytest.approx(1 / 3),
    )
