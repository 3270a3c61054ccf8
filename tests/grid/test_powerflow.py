"""AC power flow: equations hold, batches equal single solutions, sensitivities equal differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dcvrt.errors import InputError, SimulationError
from dcvrt.grid import schedule
from dcvrt.grid.network import Branches, Generators, Network
from dcvrt.grid.powerflow import PowerFlow

SITES = np.array([21, 75, 106, 108])


@pytest.fixture(scope="module")
def network() -> Network:
    return Network.ieee118()


@pytest.fixture(scope="module")
def flow(network: Network) -> PowerFlow:
    return PowerFlow(network)


def line(x: float, load_mw: float) -> Network:
    """A source of 1 pu that feeds a load at unity power factor through a reactance."""
    zero = np.zeros(2)
    return Network(
        "line",
        100.0,
        np.array([1, 2]),
        ("slack", "pq"),
        np.full(2, 138.0),
        np.array([0.0, load_mw]),
        zero,
        zero,
        zero,
        np.ones(2),
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
            np.array([1]),
            np.array([100.0]),
            np.zeros(1),
            np.full(1, 500.0),
            np.full(1, -99.0),
            np.full(1, 99.0),
            ("G1",),
        ),
    )


def test_two_bus_voltage_has_its_closed_form() -> None:
    x, p = 0.2, 1.5  # pu; V^2 = 1/2 + sqrt(1/4 - (x p)^2) for unity power factor
    found = PowerFlow(line(x, 150.0)).solve(np.array([0.0, -150.0], dtype=complex))
    assert abs(found.v[1]) == pytest.approx(np.sqrt(0.5 + np.sqrt(0.25 - (x * p) ** 2)), abs=1e-9)


def test_beyond_the_transfer_limit_the_message_names_the_bus() -> None:
    with pytest.raises(SimulationError) as error:  # the limit is 1/(2 x) = 2.5 pu
        PowerFlow(line(0.2, 300.0)).solve(np.array([0.0, -300.0], dtype=complex))
    text = str(error.value)
    assert text.startswith("line: power flow did not settle in ")
    assert "MVA, largest at bus 2. Way out: host less there, or check loads and voltage set points." in text


def test_hour_without_a_solution_is_labelled_and_the_others_stay() -> None:
    flow = PowerFlow(line(0.2, 300.0))
    demand = np.array([100.0, 240.0, 300.0, 320.0])
    injection = np.vstack([np.zeros(4), -demand]).astype(complex)
    solved = flow.solve_hours(injection, hours=np.array([7, 8, 9, 10]))
    assert solved.converged.tolist() == [True, True, False, False]
    expected = np.sqrt(0.5 + np.sqrt(0.25 - (0.2 * demand[:2] / 100) ** 2))
    assert abs(solved.v[1, :2]) == pytest.approx(expected, abs=1e-7)
    assert solved.worst_bus[2] == 2
    with pytest.raises(SimulationError) as error:
        solved.require()
    assert str(error.value) == (
        "Power flow has no solution in 2 of 4 hours; the first is hour 9: mismatch "
        f"{solved.mismatch_mva[2]:.3g} MVA, largest at bus 2. Way out: host less there, or check the load "
        "and the voltage set points of that hour."
    )


def test_solution_meets_the_equations(network: Network, flow: PowerFlow) -> None:
    injection = schedule.injections(network, np.ones(1), {})[:, 0]
    v = flow.solve(injection).v
    power = v * (network.admittance() @ v).conj() * network.base_mva
    assert power.real[flow.free] == pytest.approx(injection.real[flow.free], abs=1e-6)
    assert power.imag[flow.pq] == pytest.approx(injection.imag[flow.pq], abs=1e-6)
    held = np.array(network.kind) != "pq"
    assert abs(v[held]) == pytest.approx(network.v_set[held], abs=1e-14)
    losses = power.real.sum()
    assert 50 < losses < 250  # the slack takes them, all of them
    assert power.real[network.slack] - injection.real[network.slack] == pytest.approx(losses, abs=1e-6)


def test_units_share_load_and_hosted_load_by_schedule(network: Network) -> None:
    hosted = {75: np.array([100 + 20j])}
    injection = schedule.injections(network, np.array([0.8]), {80: np.array([60.0])}, hosted)
    assert injection.real.sum() == pytest.approx(0.0, abs=1e-9)
    assert injection.imag.sum() == pytest.approx(-0.8 * network.q_load.sum() - 20)
    units = schedule.dispatch(network, 0.8 * network.p_load.sum() + 100 - 60)
    scheduled = network.generators.p_set > 0
    ratio = units[scheduled] / network.generators.p_set[scheduled]
    assert ratio == pytest.approx(np.full(len(ratio), ratio[0]))
    assert not units[~scheduled].any()


def test_no_scheduled_unit_is_refused(network: Network) -> None:
    idle = replace(network, generators=replace(network.generators, p_set=np.zeros(54)))
    with pytest.raises(InputError) as error:
        schedule.participation(idle)
    assert str(error.value) == (
        "ieee118: no generator is scheduled to generate, so none can follow the load. "
        "Way out: give p_set of at least one unit."
    )


def test_batch_equals_single_solutions(network: Network, flow: PowerFlow) -> None:
    rng = np.random.default_rng(3)
    load, wind = rng.uniform(0.35, 1.0, 150), {69: rng.uniform(0, 200, 150), 89: rng.uniform(0, 200, 150)}
    injection = schedule.injections(network, load, wind)
    batch = flow.solve_hours(injection).require()
    for k in (0, 57, 149):
        assert batch.v[:, k] == pytest.approx(flow.solve(injection[:, k]).v, abs=1e-8)


def test_sensitivities_equal_central_differences(network: Network, flow: PowerFlow) -> None:
    load, d = np.array([0.5, 0.98]), np.array([0.9, 0.97])
    change = schedule.hosting_directions(network, SITES, 0.95)
    H = np.array([30.0, 120.0, 60.0, 80.0])
    base = schedule.injections(network, load, {})

    def voltage(h: np.ndarray, k: int) -> np.ndarray:
        return abs(flow.solve(base[:, k] + d[k] * (change.T @ h)).v[flow.pq])

    v = flow.solve_hours(base + np.outer(change.T @ H, d)).require().v
    slope = flow.sensitivities(v, change, d)
    step = 0.05
    for k in range(2):
        for j in range(4):
            move = step * np.eye(4)[j]
            difference = (voltage(H + move, k) - voltage(H - move, k)) / (2 * step)
            assert slope[:, k, j] == pytest.approx(difference, abs=1e-9 * 1e-2)  # slopes are about 1e-4 pu/MW


def test_hosting_direction_is_the_change_of_the_schedule(network: Network) -> None:
    change = schedule.hosting_directions(network, SITES, 0.98)
    factor = 1 + 1j * np.tan(np.arccos(0.98))
    hosted = {int(b): np.array([10.0 * factor]) for b in SITES}
    with_sites = schedule.injections(network, np.ones(1), {}, hosted)[:, 0]
    without = schedule.injections(network, np.ones(1), {})[:, 0]
    assert with_sites - without == pytest.approx(10.0 * change.sum(axis=0), abs=1e-10)
