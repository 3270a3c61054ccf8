"""Line-interactive UPS: in the window a conditioner, outside it an island."""

from __future__ import annotations

import numpy as np
import pytest

from dcvrt import Waveform
from tests.facility.rides import check_slopes, ride, sag, simulator, six_sags, walk, when

approx = pytest.approx
NAME = "line-interactive"


@pytest.mark.parametrize("voltage", [0.91, 0.95, 1.05, 1.09])
def test_within_the_window_the_bus_is_conditioned_and_the_import_stays(voltage):
    run = ride(NAME, sag(voltage, 0.5))
    assert not run.events
    assert run.at("v_it", 0.55) == approx(1.0, abs=1e-3)
    assert run.at("p_g", 0.55) == approx(0.95, abs=1e-4)
    assert run.at("i_g", 0.55) == approx(0.95 / 0.98 / voltage, rel=1e-3)


@pytest.mark.parametrize("retained", [0.0, 0.3, 0.85, 1.15])
def test_any_sag_or_swell_outside_it_takes_the_load_off_the_grid(retained):
    run = ride(NAME, sag(retained))
    assert walk(run, "control") == ["BATTERY", "SYNCHRONISE", "RETURN", "LINE"]
    assert walk(run, "switch") == ["OPEN", "INVERTER", "GRID"]
    assert when(run, "control", "BATTERY")[0] - 0.1 < 1e-3
    assert when(run, "switch", "INVERTER")[0] - when(run, "switch", "OPEN")[0] == approx(1.8e-3, abs=1e-9)
    island = (run.t > 0.11) & (run.t < when(run, "control", "RETURN")[0])
    assert np.abs(run["p_g"][island]).max() == 0
    assert run.at("p_b", 0.19) == approx(0.95, abs=2e-3)
    assert run["p_it"].min() == approx(0.95 / 1.3)  # the servers see nothing
    assert not walk(run, "supply")


def test_the_servers_bridge_the_transfer_from_their_capacitors():
    """P T_transfer is taken from what they store."""
    run = ride(NAME, sag(0.0))
    opened, closed = when(run, "switch", "OPEN")[0], when(run, "switch", "INVERTER")[0]
    before, after = run.at("w_dc", [opened, closed])
    lost = before - after
    assert lost == approx(0.95 * 1.8e-3 / 0.010 * 0.41, rel=1e-6)
    gap = (run.t > opened) & (run.t < closed)
    assert run["p_cool"][gap].max(initial=0.0) == 0
    assert run["v_it"][gap].max(initial=0.0) < 2e-3


def test_a_transfer_slower_than_the_hold_up_trips_the_servers():
    assert not walk(ride(NAME, sag(0.0), **{"switch.T_transfer": 0.009}), "supply").count("TRIPPED")
    run = ride(NAME, sag(0.0), **{"switch.T_transfer": 0.013})
    assert walk(run, "supply").count("TRIPPED") == 1
    assert run["p_it"].min() == 0


def test_qualification_walk_in_and_recharge_take_the_times_of_the_manual():
    run = simulator(NAME, tight=False)(sag(0.3, until=16.0))
    healthy = when(run, "control", "SYNCHRONISE")[0]
    back = when(run, "control", "RETURN")[0]
    assert healthy - 0.2 < 2e-3
    assert back - healthy == approx(3.0, abs=1e-6)
    assert when(run, "control", "LINE")[0] - back == approx(10.0, abs=1e-6)
    assert run.at("p_g", back + np.array([2.5, 7.5])) == approx([0.25 * 0.95, 0.75 * 0.95], rel=1e-3)
    assert run.at("p_b", back + 2.5) == approx(0.75 * 0.95, rel=1e-3)
    discharged = 0.95 * (back - 0.1 + 5.0)
    assert (0.8 - run["soc"].min()) * 270 == approx(discharged, rel=2e-3)
    assert run.at("p_b", 15.5) == approx(-0.1, abs=1e-3)  # recharge at its limit


def test_it_returns_in_step_with_a_grid_that_has_turned():
    """The angle jumps by 40 degrees with the sag and stays: the inverter has to slip."""
    turned = complex(np.exp(0.7j))
    wave = Waveform.segments([(0.0, 1.0), (0.1, 0.4 * turned), (0.2, turned)], until=6.0)
    run = ride(NAME, wave)
    (back,) = when(run, "control", "RETURN")
    in_step = back - 0.2  # qualification time of the test
    assert in_step - 0.2 > 0.5  # it took time to slip
    assert abs(np.sin(0.7 - run.at("inverter.delta", in_step))) == approx(0.052, rel=0.02)
    assert run.at("v_it", back + 1e-4) == approx(1.0, abs=2e-3)
    assert run["p_it"].min() == approx(0.95 / 1.3)


def test_six_sags_keep_it_away_until_the_line_is_quiet():
    run = ride(NAME, six_sags(0.6), **{"control.T_qualify": 0.5})
    assert walk(run, "control").count("BATTERY") == 6
    assert when(run, "control", "RETURN")[0] > 0.1 + 5 * 0.4 + 0.06 + 0.5
    away = (run.t > 0.11) & (run.t < when(run, "control", "RETURN")[0])
    assert run["p_g"][away].max() == 0


def test_a_sag_during_the_walk_in_sends_it_back():
    wave = Waveform.segments([(0.0, 1.0), (0.1, 0.5), (0.2, 1.0), (0.5, 0.5), (0.6, 1.0)], until=2.0)
    run = ride(NAME, wave)
    assert walk(run, "control")[:5] == ["BATTERY", "SYNCHRONISE", "RETURN", "BATTERY", "SYNCHRONISE"]
    assert walk(run, "walk") == ["RAMP", "OFF", "RAMP", "FULL", "OFF"]
    assert run["p_it"].min() == approx(0.95 / 1.3)


def test_an_empty_battery_drops_the_load():
    run = ride(NAME, sag(0.0, 1.0, until=3.0), **{"battery.T_E": 1.0, "control.soc_min": 0.3})
    assert walk(run, "control") == ["BATTERY", "DOWN", "LINE"]
    assert when(run, "control", "DOWN")[0] == approx(0.1 + 0.5 / 0.95, abs=3e-3)
    assert walk(run, "supply")[:2] == ["HOLD_UP", "TRIPPED"]
    assert run["soc"].min() == approx(0.3, abs=2e-3)


def test_an_inverter_too_small_folds_back():
    run = ride(NAME, sag(0.0), beta=0.85)
    assert run.at("v_it", 0.19) < 0.9
    assert ride(NAME, sag(0.0), beta=1.15).at("v_it", 0.19) == approx(1.0, abs=1e-3)


@pytest.mark.parametrize("theta", ["control.V_low", "d"])
def test_sensitivities_cross_transfer_return_and_walk_in(theta):
    """A ramp into the sag, so that the time of the transfer depends on the threshold."""
    thetas = ("control.V_low", "d")
    steps = [(0.0, 1.0), (0.1, 1.0, 0.6), (0.14, 0.6), (0.2, 0.6, 1.0), (0.24, 1.0)]
    wave = Waveform.segments(steps, until=1.2)
    run = ride(NAME, wave, *thetas)
    base, step = run.parameters[theta], 1e-5
    up, down = (ride(NAME, wave, *thetas, **{theta: base + s * step}) for s in (1, -1))
    first = run.events[0]
    assert first.target == "BATTERY"
    slope = (up.events[0].time - down.events[0].time) / (2 * step)
    assert first.grad[theta] == approx(slope, rel=1e-5, abs=1e-7)
    assert (abs(slope) > 0.05) == (theta == "control.V_low")
    check_slopes(run, up, down, step, theta, ("soc", "net"))
