"""Eco-mode UPS: a wire, then an island, then double conversion, then a wire again."""

from __future__ import annotations

import numpy as np
import pytest

from dcvrt import Waveform
from tests.facility.rides import check_slopes, ride, sag, simulator, six_sags, walk, when

approx = pytest.approx
NAME = "eco-mode"


@pytest.mark.parametrize("voltage", [0.91, 1.09])
def test_within_the_window_it_is_a_wire(voltage):
    run = ride(NAME, sag(voltage, 0.5))
    assert not run.events
    assert run.at("v_it", 0.55) == approx(voltage, abs=1e-5)
    assert run.at("p_g", 0.55) == approx(0.95, abs=1e-4)


@pytest.mark.parametrize("retained", [0.0, 0.3, 0.7])
def test_a_deep_sag_walks_through_battery_and_double_conversion(retained):
    run = ride(NAME, sag(retained))
    assert walk(run, "control") == ["BATTERY", "WALK_IN", "DOUBLE", "ECO"]
    assert walk(run, "switch") == ["OPEN", "INVERTER", "GRID"]
    assert when(run, "switch", "INVERTER")[0] - 0.1 < 2.6e-3  # 2 ms of transfer after detection
    assert not walk(run, "supply")
    battery = (run.t > 0.11) & (run.t < when(run, "control", "WALK_IN")[0])
    assert np.abs(run["p_g"][battery]).max() == 0
    assert run["p_it"].min() == approx(0.95 / 1.3)


def test_a_shallow_sag_takes_the_load_off_the_grid_too_although_the_rectifier_could_work():
    run = ride(NAME, sag(0.85, 1.0, until=3.0))
    assert walk(run, "control") == ["BATTERY", "WALK_IN", "DOUBLE", "ECO"]
    assert when(run, "control", "WALK_IN")[0] < 0.25  # during the sag: T_start of the test is 0.1 s
    assert run.at("p_g", 0.15) == 0
    during = run.at("p_g", 1.0)  # double conversion at 0.85 pu: import and recharge within beta V pf
    assert 0.95 * 0.85 < during <= 1.15 * 0.85 * 0.98 + 1e-6
    assert when(run, "control", "ECO")[0] > 1.1 + 0.3


def test_in_double_conversion_a_sag_is_met_by_the_rectifier():
    steps = [(0.0, 1.0), (0.1, 0.5), (0.2, 1.0), (0.8, 0.82), (1.0, 1.0)]
    run = ride(NAME, Waveform.segments(steps, until=3.0), **{"control.T_requalify": 1.0})
    assert walk(run, "control") == ["BATTERY", "WALK_IN", "DOUBLE", "ECO"]
    assert run.at("p_g", 0.95) == approx(1.15 * 0.82 * 0.98, rel=2e-3)  # its current limit
    assert run.at("p_b", 0.95) == approx(0.95 - 1.15 * 0.82 * 0.98, abs=3e-3)
    assert run.at("v_it", 0.95) == approx(1.0, abs=1e-4)
    assert when(run, "control", "ECO")[0] > 1.0 + 1.0


def test_a_deep_sag_in_double_conversion_goes_back_to_battery():
    steps = [(0.0, 1.0), (0.1, 0.5), (0.2, 1.0), (0.9, 0.3), (1.0, 1.0)]
    run = ride(NAME, Waveform.segments(steps, until=3.0), **{"control.T_requalify": 0.5})
    assert walk(run, "control") == ["BATTERY", "WALK_IN", "DOUBLE", "BATTERY", "WALK_IN", "DOUBLE", "ECO"]
    assert walk(run, "switch") == ["OPEN", "INVERTER", "GRID"]  # the load stays on the inverter


def test_start_and_walk_in_take_the_times_of_the_manuals():
    run = simulator(NAME, tight=False)(sag(0.3, until=45.0), **{"control.T_requalify": 30.0})
    (start,) = when(run, "control", "WALK_IN")
    assert start == approx(0.2 + 3.0, abs=5e-3)
    assert run.at("p_g", start + np.array([2.5, 7.5])) == approx([0.25 * 0.95, 0.75 * 0.95], rel=1e-3)
    (double,) = when(run, "control", "DOUBLE")
    assert double - start == approx(10.0, abs=1e-6)
    assert when(run, "control", "ECO")[0] - double == approx(30.0, abs=1e-6)
    assert run.at("p_b", 16.0) == approx(-0.1, abs=1e-3)  # recharging


def test_the_return_to_bypass_has_no_gap():
    run = ride(NAME, sag(0.5, until=2.0))
    (back,) = when(run, "switch", "GRID")
    near = (run.t > back - 0.05) & (run.t < back + 0.05)
    assert run["v_it"][near].min() > 0.99


def test_six_sags_cost_one_transfer_when_it_stays_in_double_conversion():
    """That is why vendors let it stay: sags two to six are not transfers of the load."""
    run = ride(NAME, six_sags(0.85), **{"control.T_requalify": 2.0})
    assert walk(run, "switch").count("OPEN") == 1
    often = ride(NAME, six_sags(0.85, apart=1.0), **{"control.T_requalify": 0.05})
    assert walk(often, "switch").count("OPEN") == 6


def test_a_phase_jump_alone_changes_nothing():
    wave = Waveform.segments([(0.0, 1.0), (0.1, complex(np.exp(0.35j)))], until=1.0)
    run = ride(NAME, wave)
    assert not run.events
    assert run["p_g"][-1] == approx(0.95, abs=1e-5)


def test_an_empty_battery_drops_the_load_and_bypass_brings_it_back():
    run = ride(NAME, sag(0.0, 1.0, until=3.0), **{"battery.T_E": 1.0, "control.soc_min": 0.3})
    assert walk(run, "control") == ["BATTERY", "DOWN", "ECO"]
    assert walk(run, "supply") == ["HOLD_UP", "TRIPPED", "PRECHARGE", "RESTART", "RUN"]


@pytest.mark.parametrize("theta", ["control.V_low", "walk.T_walk"])
def test_sensitivities_cross_transfer_and_walk_in(theta):
    thetas = ("control.V_low", "walk.T_walk")
    steps = [(0.0, 1.0), (0.1, 1.0, 0.5), (0.14, 0.5), (0.2, 0.5, 1.0), (0.24, 1.0)]
    wave = Waveform.segments(steps, until=1.6)
    run = ride(NAME, wave, *thetas)
    base, step = run.parameters[theta], 1e-5
    up, down = (ride(NAME, wave, *thetas, **{theta: base + s * step}) for s in (1, -1))
    slopes = []
    for event, later, sooner in zip(run.events, up.events, down.events, strict=True):
        slopes.append((later.time - sooner.time) / (2 * step))
        assert event.grad[theta] == approx(slopes[-1], rel=1e-4, abs=1e-6), event
    assert max(map(abs, slopes)) > 0.05
    check_slopes(run, up, down, step, theta, ("soc", "net"))
