"""The fault screen: the rank-1 formula against a direct solution, and the rule that chooses."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from dcvrt.errors import InfeasibleError, InputError
from dcvrt.grid import BusFault, Grid, Network, Period
from dcvrt.grid.screening import FaultScreen, ScreenRow, _choose, retained_voltage, screen_faults

SITES = (21, 75, 106, 108)


def test_rank_one_formula_equals_the_faulted_network() -> None:
    network = Network.ieee118()
    rng = np.random.default_rng(2)
    n = len(network.bus)
    shunt = rng.uniform(0.1, 4, n) - 1j * rng.uniform(0.1, 8, n)
    y = sp.csc_matrix(network.admittance() + sp.diags(shunt))
    v0 = rng.uniform(0.95, 1.05, n) * np.exp(1j * rng.uniform(-0.5, 0.5, n))
    current = y @ v0  # Norton currents of the machines: the same before and after
    sites, z_f = network.indices(SITES), 2e-3 + 5e-3j
    retained = retained_voltage(y, v0, sites, z_f)
    for f in (0, 40, 117):
        faulted = y + sp.csc_matrix(([1 / z_f], ([f], [f])), shape=(n, n))
        np.testing.assert_allclose(retained[f], spla.spsolve(faulted, current)[sites], rtol=0, atol=1e-11)


def test_a_bolted_fault_at_a_site_leaves_nothing_there() -> None:
    network = Network.ieee118()
    v0 = np.ones(len(network.bus), dtype=complex)
    y = network.admittance() + sp.diags(np.full(len(v0), 1 - 2j))
    sites = network.indices(SITES)
    retained = np.abs(retained_voltage(y, v0, sites, 1e-9j))
    np.testing.assert_allclose(np.diag(retained[sites]), 0.0, atol=1e-6)


def row(bus: int, beta: tuple[float, float], closes: tuple[int, ...] = ()) -> ScreenRow:
    return ScreenRow(bus, tuple(0.75 / b for b in beta), (1, 2)[int(np.argmax(beta))], beta, closes)


def test_rule_takes_the_fault_nearest_each_target_and_then_milder_ones() -> None:
    rows = [
        row(10, (1.8, 0.9), closes=(1,)),
        row(11, (1.12, 0.9)),
        row(12, (1.20, 0.9)),
        row(13, (1.15, 1.31)),  # nearest the second target, but asks more of site 1 than it has
        row(14, (1.11, 1.33)),
        row(15, (0.9, 1.15)),
        row(16, (0.8, 0.9)),
    ]
    chosen = _choose(rows, (1, 2), (1.1, 1.3), 4)
    assert chosen == {
        11: "limits site 1 at beta 1.12",
        14: "limits site 2 at beta 1.33",
        15: "milder fault at site 2, beta 1.15",
    }


def test_rule_does_not_depend_on_the_order_of_rows() -> None:
    rng = np.random.default_rng(5)
    rows = [row(bus, tuple(rng.uniform(0.85, 1.45, 2))) for bus in range(40)]
    first = _choose(rows, (1, 2), (1.1, 1.3), 6)
    assert len(first) == 6
    assert _choose([rows[k] for k in rng.permutation(40)], (1, 2), (1.1, 1.3), 6) == first


def test_a_site_that_nothing_limits() -> None:
    with pytest.raises(InfeasibleError) as failure:
        _choose([row(11, (1.2, 0.9))], (1, 2), (1.1, 1.3), 2)
    assert str(failure.value) == (
        "screen_faults: no fault limits site 2 without asking more of the others. Way out: a wider range of "
        "beta, a larger beta_max, or faults of your own."
    )


def test_bad_request_names_everything_at_once() -> None:
    with pytest.raises(InputError) as failure:
        screen_faults(Grid.from_case("ieee118"), [], loss_share=1.0, beta=(1.4, 1.2), count=3)
    assert str(failure.value) == (
        "screen_faults: 4 problems\n"
        "  periods is empty: at least one is needed.\n"
        "  loss_share = 1.0 must be at least 0 and below 1.\n"
        "  beta = (1.4, 1.2) and beta_max = 1.5 must increase: lowest target, highest target, "
        "largest ratio.\n"
        "  count = 3 is less than one fault for each of the 4 sites."
    )


@pytest.mark.slow
def test_screen_of_ieee118_is_what_andes_finds_at_clearing() -> None:
    grid, period = Grid.from_case("ieee118"), Period("peak")
    screen = screen_faults(grid, [period], confirm_until=None)
    by_bus = {r.bus: r for r in screen.rows}
    assert len(by_bus) == 114
    for fault, run in grid.waveforms_of({}, period, screen.faults, until=0.3, engine="andes").items():
        for k, site in enumerate(grid.sites):
            w = run[site]
            at_clearing = w.v[np.flatnonzero(w.t == fault.cleared_at)[0]]
            assert abs(at_clearing) == pytest.approx(by_bus[fault.bus].retained[k], abs=0.015)


@pytest.mark.slow
def test_chosen_faults_limit_different_sites_and_survive() -> None:
    grid = Grid.from_case("ieee118")
    wind = {69: 180.0, 80: 180.0, 89: 180.0}
    screen: FaultScreen = screen_faults(grid, [Period("peak"), Period("light", 0.45, wind, 0.8)])
    chosen = [r for r in screen.rows if r.chosen]
    assert 6 <= len(screen.faults) <= 7
    assert not screen.rejected
    assert {f.bus for f in screen.faults}.isdisjoint(grid.sites)
    assert {r.limits for r in chosen if r.chosen.startswith("limits")} == set(grid.sites)
    assert all(max(r.beta) <= 1.5 and not r.closes for r in chosen)
    assert screen.faults == tuple(BusFault(f.bus) for f in sorted(screen.faults, key=lambda f: f.bus))
    assert list(screen.table().columns[:2]) == ["bus", "v_21_pu"]
