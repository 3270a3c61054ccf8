"""Surrogate margins in the hosting programme: site by site, never infeasible, capacity never falling with the
rating."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from dcvrt.grid.network import Network
from dcvrt.planning import profiles
from dcvrt.planning.hosting import HostingProblem
from dcvrt.planning.surrogate import Scores, Surrogate
from dcvrt.planning.sweep import margin_rows, sweep

SITES = (21, 75, 106, 108)
NOTHING = (np.array([], dtype=str), np.array([]), np.array([]))
D = {"peak": 1.0, "light": 0.9}


def surrogate(
    site: int,
    intercept: float,
    slopes=(0.0, 0.0, 0.0, 0.0),
    rating=0.0,
    method="paper",
    beta=0.0,
    mode="gfl",
    period="",
    target="loss",
    unknown=None,
    fault="bus 32, 100 ms",
) -> Surrogate:
    return Surrogate(
        method,
        site,
        fault,
        mode,
        target,
        period,
        beta,
        intercept,
        np.array(slopes),
        rating,
        0.0,
        unknown or {},
        10,
        0,
        0,
        1,
        Scores(0, 0, *[float("nan")] * 5),
        NOTHING,
    )


@pytest.fixture(scope="module")
def problem() -> HostingProblem:
    hours = profiles.ieee118().window(range(8400, 8424))
    return HostingProblem(Network.ieee118(), SITES, hours, rating_scale=0.6, voltage=None, h_max=200.0)


def test_rows_are_the_surrogate_in_every_period() -> None:
    fit = surrogate(75, -1.0, slopes=(0.0, -0.02, 0.01, 0.0), rating=0.05)
    rows, closed = margin_rows([fit], SITES, 1.2, D, np.full(4, 100.0))
    assert not closed
    assert [row.site for row in rows] == [75, 75]
    H = dict(zip(SITES, (10.0, 80.0, 30.0, 0.0), strict=True))
    for row, d in zip(rows, D.values(), strict=True):
        assert row.value(H) == pytest.approx(-1.0 + d * (-0.02 * 80 + 0.01 * 30) + 0.05 * 1.2 * 80)
    assert rows[0].label == "loss at bus 75, fault bus 32, 100 ms, peak, gfl, beta 1.2"
    assert [row.period for row in rows] == list(D)
    assert {(row.fault, row.mode, row.target) for row in rows} == {("bus 32, 100 ms", "gfl", "loss")}


@pytest.mark.parametrize(
    ("method", "target", "unit"),
    [
        ("paper", "voltage", "pu"),
        ("paper", "loss", "MW"),
        ("share", "voltage", "pu"),
        ("share", "loss", "share of load"),
    ],
)
def test_rows_have_the_unit_of_their_margin(method: str, target: str, unit: str) -> None:
    fit = replace(surrogate(75, 0.5, slopes=(0.0, -0.02, 0.0, 0.0)), method=method, target=target)
    rows, _ = margin_rows([fit], SITES, 1.2, D, np.full(4, 100.0))
    assert {row.unit for row in rows} == {unit}


def test_rows_that_hold_everywhere_are_left_out_and_hopeless_ones_close_their_site() -> None:
    fits = [
        surrogate(21, 0.5, slopes=(-1e-3, 0, 0, 0)),
        surrogate(75, -0.1, slopes=(0, 5e-4, 0, 0)),
        surrogate(106, -0.01, slopes=(0, 0, 5e-4, 0)),
    ]
    rows, closed = margin_rows(fits, SITES, 1.0, D, np.full(4, 100.0))
    assert closed == {
        75: "no capacity in the sampled box passes: loss at bus 75, fault bus 32, 100 ms, peak, gfl, beta 1"
    }
    assert {row.site for row in rows} == {106}


def test_a_site_whose_margin_is_unknown_is_closed() -> None:
    why = "every run of the fitting set failed; the reason: gfl: no equilibrium"
    fits = [
        surrogate(75, 1.0, unknown={(1.0, "light"): why}),
        surrogate(75, 1.0, fault="bus 9, 100 ms"),
        surrogate(21, 1.0, fault="bus 9, 100 ms", unknown={(1.2, "peak"): "of another site"}),
    ]
    rows, closed = margin_rows(fits, SITES, 1.0, D, np.full(4, 100.0))
    assert not rows
    assert closed == {75: f"no margin known at fault bus 32, 100 ms, light, gfl, beta 1: {why}"}
    assert margin_rows(fits[:2], SITES, 1.2, D, np.full(4, 100.0)) == ([], {})


def test_a_reason_that_holds_for_every_fault_names_none() -> None:
    fits = [
        surrogate(75, 1.0, unknown={(1.0, "light"): why}, fault=fault, target=target)
        for fault, why in (("bus 32, 100 ms", "rare"), ("bus 9, 100 ms", "usual"), ("bus 8, 100 ms", "usual"))
        for target in ("voltage", "loss")
    ]
    _, closed = margin_rows(fits, SITES, 1.0, D, np.full(4, 100.0))
    assert closed == {75: "no margin known at light, gfl, beta 1: usual"}


def test_a_site_without_a_passing_capacity_is_closed_and_the_others_stay(problem: HostingProblem) -> None:
    fits = [surrogate(site, 0.1 if site != 75 else -0.1) for site in SITES]
    (found,) = sweep(problem, fits, ["gfl"], [1.0], D, np.full(4, 30.0))
    assert found.plan.by_site[75] == 0.0
    assert 75 in found.closed
    assert found.plan.total_mw == pytest.approx(90.0, abs=1e-6)


def test_all_sites_closed_is_a_plan_of_nothing(problem: HostingProblem) -> None:
    (found,) = sweep(problem, [surrogate(site, -0.1) for site in SITES], ["gfl"], [1.0], D, np.full(4, 30.0))
    assert found.plan.total_mw == 0.0
    assert set(found.closed) == set(SITES)


def test_a_plan_stays_a_candidate_at_a_larger_rating(problem: HostingProblem) -> None:
    """Fits of separate ratings may disagree; what passes at 1.1 passes at 1.2."""
    fits = [
        surrogate(site, 0.1 if beta == 1.1 else -0.1, method="share", beta=beta, period=period)
        for site in SITES
        for beta in (1.0, 1.1, 1.2, 1.3)
        for period in D
    ]
    plans = list(sweep(problem, fits, ["gfl"], [1.0, 1.1, 1.2, 1.3], D, np.full(4, 30.0)))
    assert [round(p.plan.total_mw, 6) for p in plans] == [0.0, 120.0, 120.0, 120.0]
    assert [p.carried_from for p in plans] == [None, None, 1.1, 1.1]


def test_capacity_never_falls_as_the_rating_rises(problem: HostingProblem) -> None:
    """Margins of both signs in H, rating slopes of at least 0: the paper's rows loosen with beta."""
    rng = np.random.default_rng(4)
    for _ in range(5):
        fits = [
            surrogate(
                site, rng.uniform(-2, 1), slopes=rng.uniform(-0.03, 0.01, 4), rating=rng.uniform(0, 0.05)
            )
            for site in SITES
            for _ in range(3)
        ]
        totals = [
            p.plan.total_mw
            for p in sweep(problem, fits, ["gfl"], [1.0, 1.15, 1.3, 1.5], D, np.full(4, 100.0))
        ]
        assert all(b >= a - 1e-6 for a, b in itertools.pairwise(totals))
        assert all(p is not None for p in totals)


def test_open_sites_meet_their_rows_and_the_choice_of_sites_is_the_best(problem: HostingProblem) -> None:
    """Against an enumeration of open sites with one linear programme each."""
    from itertools import product

    from scipy.optimize import linprog

    rng = np.random.default_rng(8)
    for _ in range(6):
        fits = [surrogate(site, rng.uniform(-1.5, 0.5), slopes=rng.uniform(-0.03, 0.03, 4)) for site in SITES]
        (found,) = sweep(
            problem, fits, ["gfl"], [1.2], {"peak": 1.0}, np.full(4, 25.0)
        )  # no line binds in this box
        best = 0.0
        for is_open in product((0, 1), repeat=4):
            here = [f for f in fits if is_open[SITES.index(f.site)]]
            answer = linprog(
                -np.ones(4),
                A_ub=[-f.slopes for f in here] or None,
                b_ub=[f.intercept for f in here] or None,
                bounds=[(0, 25.0 * o) for o in is_open],
            )
            best = max(best, -answer.fun) if answer.status == 0 else best
        assert found.plan.total_mw == pytest.approx(best, abs=1e-5)
        H = np.array([found.plan.by_site[site] for site in SITES])
        for f in fits:
            if H[SITES.index(f.site)] > 1e-9:
                assert f.predict(H[None], 1.0, 1.2, SITES.index(f.site))[0] >= -1e-9
