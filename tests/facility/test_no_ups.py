"""Servers straight on the grid: what trips, when, and what comes back."""

from __future__ import annotations

import numpy as np
import pytest

from dcvrt import Waveform, facility
from tests.facility.rides import check_slopes, ride, sag, simulator, six_sags, walk, when

approx = pytest.approx


@pytest.mark.parametrize("retained", [0.75, 0.85, 0.95, 1.15, 1.3])
def test_sags_above_the_current_limit_and_swells_mean_nothing_to_the_servers(retained):
    """d/beta = 0.742: the static law, with the input current limit of the supplies as rating."""
    run = ride("no-ups", sag(retained, 1.5, until=2.0))
    assert not run.events
    assert run["p_it"].min() == approx(0.95 / 1.3)
    assert run["w_dc"].min() > 0.99


@pytest.mark.parametrize("retained", [0.4, 0.5, 0.6, 0.7])
def test_a_sag_below_it_trips_when_the_capacitors_are_empty(retained):
    """T_hold/(d - beta V), above the input undervoltage."""
    run = ride("no-ups", sag(retained, 0.5))
    (trip,) = when(run, "supply", "TRIPPED")
    assert trip - 0.1 == approx(0.010 / (0.95 - 1.28 * retained), rel=2e-4)


def test_an_interruption_trips_after_the_hold_up():
    run = ride("no-ups", sag(0.0, 0.3))
    assert walk(run, "supply") == ["HOLD_UP", "TRIPPED", "PRECHARGE", "RESTART", "RUN"]
    assert when(run, "supply", "TRIPPED") == [approx(0.1 + 0.010 / 0.95, abs=1e-5)]


@pytest.mark.parametrize(("length", "rides"), [(0.009, True), (0.012, False)])
def test_an_interruption_shorter_than_the_hold_up_is_ridden_through(length, rides):
    run = ride("no-ups", sag(0.0, length, until=0.3))
    assert ("TRIPPED" not in walk(run, "supply")) == rides


def test_contactors_drop_out_and_close_in_stages():
    run = ride("no-ups", sag(0.2, 0.2))
    assert walk(run, "cooling") == ["OUT", "STAGE_1", "STAGE_2", "RUNNING"]
    p_cool = 0.95 * (1 - 1 / 1.3) * 0.74
    closed = [when(run, "cooling", mode)[0] for mode in ("STAGE_1", "STAGE_2", "RUNNING")]
    assert run.at("p_cool", np.array(closed) + 0.05) == approx(p_cool * np.array([1, 2, 3]) / 3, rel=1e-5)
    assert run["p_load"] == approx(np.full(len(run.t), 0.95))  # what it would draw does not change


def test_the_load_stays_away_for_the_restart_time_of_the_manual():
    """25 s after the voltage is back nothing runs; half of the servers 137.5 s later; all after 300 s."""
    run = simulator("no-ups", tight=False)(sag(0.0, 0.1, until=310.0))
    assert when(run, "supply", "PRECHARGE")[0] == approx(0.2 + 25.0, abs=0.01)
    (begin,) = when(run, "supply", "RESTART")
    full = 0.95 / 1.3
    assert run.at("p_it", [20.0, begin + 137.5, 308.0]) == approx([0.0, full / 2, full], abs=1e-6)


def test_the_power_lost_to_the_grid_is_that_of_servers_and_cooling():
    run = ride("no-ups", sag(0.0, 0.1))
    after = run.at("p_g", [0.21])[0]
    assert after == approx(0.95 * (1 - 1 / 1.3) * 0.26, rel=1e-4)  # auxiliaries alone


def test_six_sags_trip_once_and_keep_the_servers_away():
    run = ride("no-ups", six_sags(0.2), **{"supply.T_restart": 0.5})
    assert walk(run, "supply").count("TRIPPED") == 1
    assert when(run, "supply", "PRECHARGE")[0] > 0.1 + 5 * 0.4 + 0.06 + 0.5


def test_supplies_that_hold_up_longer_ride_longer():
    f = facility.get("no-ups")
    f.set("supply.T_hold", 0.020, "Intel SR2625UR: 20 ms at 75 %")
    assert f.compile().parameter_values()[f.compile().parameter_number("supply.T_hold")] == 0.020
    for hold in (0.010, 0.016, 0.020):
        run = ride("no-ups", sag(0.0, 0.3), **{"supply.T_hold": hold})
        assert when(run, "supply", "TRIPPED")[0] - 0.1 == approx(hold / 0.95, rel=1e-5)


@pytest.mark.parametrize("theta", ["d", "supply.T_hold"])
def test_sensitivities_cross_the_trip(theta):
    """The trip is located on a state: its time moves with load and hold-up, and energy with it."""
    thetas = ("d", "supply.T_hold")
    wave = sag(0.5, 0.2, until=0.6)
    run = ride("no-ups", wave, *thetas)
    base, step = run.parameters[theta], 1e-5 * run.parameters[theta]
    up, down = (ride("no-ups", wave, *thetas, **{theta: base + s * step}) for s in (1, -1))
    trip = next(e for e in run.events if e.target == "TRIPPED")
    slope = (when(up, "supply", "TRIPPED")[0] - when(down, "supply", "TRIPPED")[0]) / (2 * step)
    assert trip.grad[theta] == approx(slope, rel=1e-5)
    assert abs(slope) > 0.05
    check_slopes(run, up, down, step, theta, ("net", "w_dc"))


def test_a_flat_voltage_below_what_the_supplies_can_live_on_is_no_start():
    from dcvrt.errors import SimulationError

    with pytest.raises(SimulationError, match="no equilibrium at the first value of the waveform"):
        ride("no-ups", Waveform.segments([(0.0, 0.6)], until=1.0))
