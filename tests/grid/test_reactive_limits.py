"""PV-PQ switching: a closed form, ANDES, complementarity everywhere, batches and sensitivities."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dcvrt.grid import andes, powerflow, schedule
from dcvrt.grid.network import Branches, Generators, Network
from dcvrt.grid.powerflow import PowerFlow
from dcvrt.planning import profiles

SITES = np.array([21, 75, 106, 108])


@pytest.fixture(scope="module")
def network() -> Network:
    return Network.ieee118()


@pytest.fixture(scope="module")
def flow(network: Network) -> PowerFlow:
    return PowerFlow(network, reactive_limits=True)


def condenser(x: float, q_max: float, q_min: float, load: complex, v_set: float = 1.0) -> Network:
    """A source of 1 pu feeds, through a reactance, a load with a condenser beside it."""
    pair = np.zeros(2)
    return Network(
        "condenser",
        100.0,
        np.array([1, 2]),
        ("slack", "pv"),
        np.full(2, 138.0),
        np.array([0.0, load.real]),
        np.array([0.0, load.imag]),
        pair,
        pair,
        np.array([1.0, v_set]),
        Branches(
            np.array([1]),
            np.array([2]),
            np.zeros(1),
            np.array([x]),
            np.zeros(1),
            np.ones(1),
            np.zeros(1),
            np.full(1, 500.0),
        ),
        Generators(
            np.array([1, 2]),
            np.array([100.0, 0.0]),
            pair,
            np.array([500.0, 0.0]),
            np.array([-999.0, q_min]),
            np.array([999.0, q_max]),
            ("G1", "G2"),
        ),
    )


def lossless(x: float, p: float, q: float) -> float:
    """Voltage behind a reactance x at load p + jq, source 1 pu: the upper root of a quadratic in V^2."""
    b = 1 - 2 * x * q
    return float(np.sqrt((b + np.sqrt(b * b - 4 * x * x * (p * p + q * q))) / 2))


@pytest.mark.parametrize(
    ("load", "q_max", "q_min", "v_set", "at"),
    [
        (120 + 40j, 30.0, -30.0, 1.0, 1),
        (20 - 60j, 30.0, -30.0, 1.0, -1),
        (50 + 10j, 30.0, -30.0, 1.0, 0),
    ],
)
def test_bus_switches_to_the_voltage_of_its_closed_form(
    load: complex, q_max: float, q_min: float, v_set: float, at: int
) -> None:
    case = condenser(0.2, q_max, q_min, load, v_set)
    injection = schedule.injections(case, np.ones(1), {})[:, 0]
    found = PowerFlow(case, reactive_limits=True).solve(injection)
    assert found.limited.tolist() == [0, at]
    limit = {1: q_max, -1: q_min, 0: np.nan}[at]
    expected = v_set if at == 0 else lossless(0.2, load.real / 100, (load.imag - limit) / 100)
    assert abs(found.v[1]) == pytest.approx(expected, abs=1e-8)
    batch = PowerFlow(case, reactive_limits=True).solve_hours(np.repeat(injection[:, None], 3, axis=1))
    assert abs(batch.require().v[1]) == pytest.approx(np.full(3, expected), abs=1e-8)


@pytest.mark.parametrize("q_max", [-5.0, 3.0, 7.0])
def test_the_slack_bus_lets_its_voltage_go_too(q_max: float) -> None:
    """Bus 2 holds 1 pu and takes P over x; with Q_1 given, u = V_1^2 solves
    u^2 - (1 + 2 x Q_1) u + x^2 (P^2 + Q_1^2) = 0."""
    x, p, q = 0.2, 1.2, q_max / 100
    wide = condenser(x, 999.0, -999.0, 100 * p + 20j)
    units = wide.generators
    case = replace(wide, generators=replace(units, q_max=np.array([q_max, 999.0])))
    found = PowerFlow(case, reactive_limits=True).solve(schedule.injections(case, np.ones(1), {})[:, 0])
    b = 1 + 2 * x * q
    assert found.limited.tolist() == [1, 0]
    assert abs(found.v[1]) == pytest.approx(1.0, abs=1e-12)
    assert abs(found.v[0]) ** 2 == pytest.approx(
        (b + np.sqrt(b * b - 4 * x * x * (p * p + q * q))) / 2, abs=1e-9
    )
    assert np.angle(found.v[0]) == 0.0


def test_without_limits_the_set_point_is_held_whatever_it_takes() -> None:
    case = condenser(0.2, 30.0, -30.0, 120 + 40j)
    found = PowerFlow(case).solve(schedule.injections(case, np.ones(1), {})[:, 0])
    assert abs(found.v[1]) == pytest.approx(1.0)
    assert not found.limited.size


def complementary(network: Network, flow: PowerFlow, v: np.ndarray, s: np.ndarray, at: np.ndarray) -> None:
    """Limits, and the three states of every bus that may hold its voltage."""
    q = (v * (network.admittance() @ v).conj()).imag - s.imag / network.base_mva
    for k, bus in enumerate(flow.pv):
        set_point, size = network.v_set[bus], abs(v[bus])
        assert flow.q_low[k] - 1e-7 <= q[bus] <= flow.q_high[k] + 1e-7
        if at[k] == 0:
            assert size == pytest.approx(set_point, abs=1e-12)
        elif at[k] > 0:
            assert q[bus] == pytest.approx(flow.q_high[k], abs=1e-8)
            assert size <= set_point + 1e-7
        else:
            assert q[bus] == pytest.approx(flow.q_low[k], abs=1e-8)
            assert size >= set_point - 1e-7


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), load=st.floats(0.35, 1.1), narrow=st.floats(0.3, 1.5))
def test_every_bus_holds_its_voltage_or_is_at_the_right_limit(seed: int, load: float, narrow: float) -> None:
    rng = np.random.default_rng(seed)
    whole = Network.ieee118()
    units = whole.generators
    network = replace(
        whole, generators=replace(units, q_min=narrow * units.q_min, q_max=narrow * units.q_max)
    )
    hosted = {int(b): np.array([(1 + 0.2j) * rng.uniform(0, 40)]) for b in SITES}
    s = schedule.injections(network, np.array([load]), {69: np.array([rng.uniform(0, 200)])}, hosted)
    flow = PowerFlow(network, reactive_limits=True)
    batch = flow.solve_hours(s)
    if not batch.converged[0]:
        assert "no solution" in batch.status
        return
    power = batch.v[:, 0] * (network.admittance() @ batch.v[:, 0]).conj() * 100
    assert power.real[flow.free] == pytest.approx(s[flow.free, 0].real, abs=1e-5)
    assert power.imag[flow.pq] == pytest.approx(s[flow.pq, 0].imag, abs=1e-5)
    complementary(network, flow, batch.v[:, 0], s[:, 0], batch.limited[:, 0])


def test_year_of_base_hours_is_at_limits_and_equals_single_solutions(
    network: Network, flow: PowerFlow
) -> None:
    year = profiles.ieee118()
    s = schedule.injections(network, year.load, year.wind)
    batch = flow.solve_hours(s).require()
    assert (batch.limited != 0).any(axis=0).all()  # no hour in which every unit is within its limits
    for k in (0, 1156, 6028, 8441):
        one = flow.solve(s[:, k])
        assert batch.v[:, k] == pytest.approx(one.v, abs=1e-8)
        assert (batch.limited[:, k] == one.limited).all()
        complementary(network, flow, batch.v[:, k], s[:, k], batch.limited[:, k])


def test_warm_start_gives_the_same_solution(network: Network, flow: PowerFlow) -> None:
    year = profiles.ieee118().window(range(8400, 8500))
    s = schedule.injections(network, year.load, year.wind)
    change = schedule.hosting_directions(network, SITES, 0.98)
    before = flow.solve_hours(s).require()
    moved = s + np.outer(change.T @ np.array([25.0, 90.0, 55.0, 60.0]), year.dc)
    cold = flow.solve_hours(moved).require()
    warm = flow.solve_hours(moved, start=before.v, limited=before.limited).require()
    assert (cold.limited != before.limited).any()
    assert warm.v == pytest.approx(cold.v, abs=1e-8)
    assert (warm.limited == cold.limited).all()


def test_sensitivities_equal_central_differences_at_limits(network: Network, flow: PowerFlow) -> None:
    d = np.array([0.9, 0.97])
    change = schedule.hosting_directions(network, SITES, 0.98)
    H = np.array([20.0, 60.0, 30.0, 40.0])
    base = schedule.injections(network, np.array([0.5, 0.98]), {})
    solved = flow.solve_hours(base + np.outer(change.T @ H, d)).require()
    slope = flow.sensitivities(solved.v, change, d, solved.limited)
    held = PowerFlow(network)
    free = held.sensitivities(solved.v, change, d)
    assert abs(slope[: len(flow.pq)]).max() > 1.05 * abs(free).max()  # without support voltages fall faster
    step = 1e-3
    for k in range(2):
        for j in range(4):
            ends = []
            for sign in (1, -1):
                there = flow.solve(base[:, k] + d[k] * (change.T @ (H + sign * step * np.eye(4)[j])))
                assert (there.limited == solved.limited[:, k]).all()
                ends.append(abs(there.v[flow.moving]))
            assert slope[:, k, j] == pytest.approx((ends[0] - ends[1]) / (2 * step), abs=2e-8)
    at_set_point = solved.limited == 0
    assert not slope[len(flow.pq) :][at_set_point].any()


def test_sparse_and_dense_matrices_give_the_same(network: Network, monkeypatch: pytest.MonkeyPatch) -> None:
    year = profiles.ieee118().window(range(8436, 8444))
    s = schedule.injections(network, year.load, year.wind)
    change = schedule.hosting_directions(network, SITES, 0.98)
    results = []
    for limit in (1000, 10):
        monkeypatch.setattr(powerflow, "DENSE", limit)
        flow = PowerFlow(network, reactive_limits=True)
        solved = flow.solve_hours(s).require()
        results.append((solved.v, flow.sensitivities(solved.v, change, year.dc, solved.limited)))
    assert results[0][0] == pytest.approx(results[1][0], abs=1e-9)
    assert results[0][1] == pytest.approx(results[1][1], abs=1e-10)


@pytest.mark.slow
def test_switched_power_flow_equals_andes(network: Network) -> None:
    import gc

    from andes import load

    with andes.quiet():
        system = load(
            str(andes.case118()),
            no_output=True,
            default_config=True,
            config_option=["PV.pv2pq=1", "PFlow.tol=1e-11"],
            pycode_path=str(andes.prepare()),
        )
        gc.collect()  # the pool of processes that it leaves open is told here, or in whatever test comes next
        assert system.PFlow.run()
    injection = schedule.injections(network, np.ones(1), {})[:, 0]
    demand = -injection.imag
    p = np.zeros(118)  # the schedule of the case itself
    np.add.at(p, network.generator_index, network.generators.p_set)
    s = (p - network.p_load) - 1j * network.q_load
    assert demand == pytest.approx(network.q_load)
    found = PowerFlow(network, reactive_limits=True).solve(s)
    theirs = dict(zip(system.Bus.idx.v, system.Bus.v.v, strict=True))
    volts = np.array([theirs[int(b)] for b in network.bus])
    assert (found.limited != 0).any()
    assert abs(found.v) == pytest.approx(volts, abs=1e-7)
