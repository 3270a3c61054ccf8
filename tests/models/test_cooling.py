"""Cooling: contactors, drives, and the split into fans, pumps and chillers."""

from __future__ import annotations

from math import hypot, sqrt

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dcvrt.errors import ModelError
from dcvrt.facility import double_conversion
from dcvrt.models import ContactorCooling, Cooling, DriveCooling, Phasor, SplitCooling
from tests.models.sources import bench, play, steps, walk

approx = pytest.approx
P = 0.17  # cooling at rest over H, d = 1


# ---- contactors ------------------------------------------------------------------------------------------


def contactor(*levels: tuple[float, float], until: float, **parameters: float):
    block = ContactorCooling(T_drop=0.03, T_off=1.0, T_stage=0.5, **parameters)
    return play(bench(block, dict(v="volts", g_it=1.0), ("p",)), steps((0.0, 1.0), *levels, until=until))


def test_contactors_drop_out_and_restart_in_stages_at_the_times_of_their_timers():
    run = contactor((0.1, 0.5), (0.2, 1.0), until=3.0)
    times, modes = zip(*walk(run, "block"), strict=True)
    assert modes == ("OUT", "STAGE_1", "STAGE_2", "RUNNING")
    assert times == approx((0.1 + 0.03, 0.2 + 1.0, 0.2 + 1.5, 0.2 + 2.0), abs=1e-9)
    for after, groups in zip((0.15, 1.3, 1.8, 2.5), (0, 1, 2, 3), strict=True):
        assert run["p"][np.searchsorted(run.t, after)] == approx(P * groups / 3)


def test_contactors_hold_through_a_sag_that_is_short_or_shallow():
    assert contactor((0.1, 0.5), (0.129, 1.0), until=0.5).events == ()
    assert contactor((0.1, 0.56), until=2.0).events == ()


def test_contactors_wait_for_a_healthy_voltage_and_fall_out_again():
    run = contactor((0.1, 0.3), (0.2, 0.7), (1.0, 1.0), (2.2, 0.4), (2.3, 1.0), until=5.0)
    times, modes = zip(*walk(run, "block"), strict=True)
    assert modes == ("OUT", "STAGE_1", "OUT", "STAGE_1", "STAGE_2", "RUNNING")
    assert times == approx((0.13, 2.0, 2.23, 3.3, 3.8, 4.3), abs=1e-9)


def test_contactors_need_hysteresis():
    with pytest.raises(ModelError, match=r"V_drop = 0\.8, V_pick = 0\.7"):
        contactor(until=0.1, V_drop=0.8, V_pick=0.7)


def test_contactor_cooling_takes_the_place_of_the_plain_one():
    """On the protected bus: the UPS keeps the contactors in through a sag of the grid."""
    f = double_conversion.gfl()
    f.replace("cooling", ContactorCooling())
    f.connect(f.port("bus.v"), f.port("cooling.v"))
    run = play(f, steps((0.0, 1.0), (0.1, 0.3), (0.3, 1.0), until=1.0), d=0.9)
    assert walk(run, "cooling") == []
    assert run["p_cool"] == approx(run["p_cool"][0])
    assert [m for _, m in walk(run, "sup")][:2] == ["MIXED", "BATTERY"]


# ---- drives ----------------------------------------------------------------------------------------------


def drive(*levels: tuple[float, float], until: float, **parameters: float):
    block = DriveCooling(T_restart=0.5, T_ramp=1.0, **parameters)
    outputs = ("p", "i", "energy", "loss", "demand", "i_max", "w", "mode")
    d = bench(block, dict(v="v", g_it=1.0), outputs)
    return block, play(d, steps((0.0, 1.0), *levels, until=until))


@given(st.floats(0.85, 1.15), st.floats(-3.0, 3.0), st.floats(0.5, 1.3))
def test_a_drive_rests_where_its_rectifier_feeds_the_motor(voltage, angle, g_it):
    block = DriveCooling(eps=1e-6, eps_v=1e-6)
    at = dict(v=Phasor.polar(voltage, angle), g_it=g_it)
    rest = block.rest(block.at(**at))
    eq = block.equations(block.at(**at, **rest))
    g = 1 + 0.6 * (g_it - 1)
    assert eq.der == {"g": approx(0.0, abs=1e-12), "w": approx(0.0, abs=1e-6)}
    assert sqrt(rest["w"]) == approx(voltage - g / (20.0 * voltage), abs=1e-6)
    power = complex(at["v"] * eq.out["i"].conj())
    assert power.real == approx(P * g, rel=1e-6)
    assert power.real / abs(power) == approx(0.98, abs=1e-5)
    assert eq.out["p"] == eq.out["demand"] == approx(P * g)


def test_a_drive_without_grid_holds_up_for_the_time_of_its_energy():
    """t = (w_0 - w_trip) T_dc P_r/P: constant power from the DC bus alone."""
    block, run = drive((0.1, 0.0), until=0.5)
    w_0 = run["w"][0]
    ((time, mode),) = walk(run, "block")
    assert mode == "TRIPPED"
    assert time - 0.1 == approx((w_0 - block.w_trip) * block.T_dc, rel=1e-6)
    after = run.t > time
    assert np.abs(run["p"][after]).max() == 0.0
    assert run["demand"][after] == approx(P)


def test_losses_shorten_the_hold_up():
    block, run = drive((0.1, 0.0), until=0.5, eta=0.9)
    assert walk(run, "block")[0][0] - 0.1 == approx((run["w"][0] - 0.5) * block.T_dc * 0.9, rel=1e-6)
    assert run["loss"][0] == approx(P * (1 / 0.9 - 1))


@pytest.mark.parametrize("retained", [0.8, 0.9, 1.15])
def test_a_drive_rides_through_what_leaves_enough_on_its_bus(retained):
    _, run = drive((0.1, retained), (0.6, 1.0), until=1.0)
    assert run.events == ()
    end = np.searchsorted(run.t, 0.59)
    assert sqrt(run["w"][end]) == approx(retained - 1 / (20 * retained), abs=1e-4)
    assert run["p"] == approx(P)


def test_a_drive_trips_on_a_swell():
    _, run = drive((0.1, 1.35), (0.2, 1.0), until=0.3)
    time, mode = walk(run, "block")[0]
    assert mode == "TRIPPED"
    assert run["w"][np.searchsorted(run.t, time)] == approx(1.56, abs=1e-6)


def test_a_tripped_drive_waits_and_ramps_up():
    block, run = drive((0.1, 0.0), (0.3, 1.0), until=3.0)
    (_, trip), (ramp, up), (done, run_) = walk(run, "block")
    assert (trip, up, run_) == ("TRIPPED", "RAMP", "RUN")
    healthy = run.t[(run.t > 0.3) & (run["w"] > block.w_back)][0]
    assert ramp == approx(healthy + 0.5, abs=1.1e-3)  # the sample after the DC bus is back
    assert done - ramp == approx(1.0, abs=1e-9)
    rising = (run.t > ramp) & (run.t < done)
    np.testing.assert_allclose(run["p"][rising], P * (run.t[rising] - ramp), atol=1e-12)
    assert run["p"][-1] == approx(P)


@given(st.tuples(st.floats(-1.3, 1.3), st.floats(-1.3, 1.3)), st.floats(0.0, 1.7), st.floats(0.01, 10.0))
def test_a_drive_never_exceeds_its_current_nor_exports(v, w, h):
    block = DriveCooling(H=h)
    out = block.equations(block.at(v=Phasor(*v), g_it=1.0, g=1.0, w=w)).out
    assert hypot(out["i"].re, out["i"].im) <= out["i_max"] * (1 + 1e-12)
    assert (Phasor(*v) * out["i"].conj()).re >= 0.0


def test_a_drive_keeps_its_own_balance():
    _, run = drive((0.1, 0.6), (0.2, 1.0), until=1.2)
    p_in = (np.array([1.0 if t < 0.1 or t > 0.2 else 0.6 for t in run.t])) * run["i.re"]
    balance = p_in - run["p"] - run["loss"]
    for a, b in ((0.0, 0.099), (0.101, 0.199), (0.201, 1.2)):
        part = (run.t >= a) & (run.t <= b)
        stored = run["energy"][part]
        assert stored[-1] - stored[0] == approx(float(np.trapezoid(balance[part], run.t[part])), abs=2e-5)


# ---- fans, pumps, chillers -------------------------------------------------------------------------------


def test_the_parts_answer_a_step_each_with_its_own_exponential():
    block = SplitCooling()
    run = play(bench(block, dict(g_it="ratio"), ("p",)), steps((0.0, 1.0), (1.0, 1.2), until=60.0), 0.05)
    t = np.maximum(run.t - 1.0, 0.0)
    parts = ((0.25, 1.0, 2.0), (0.15, 0.5, 10.0), (0.60, 0.5, 60.0))
    expected = P * sum(a * (1 + rho * 0.2 * (1 - np.exp(-t / T))) for a, rho, T in parts)
    np.testing.assert_allclose(run["p"], expected, rtol=1e-8)


@given(st.floats(0.0, 1.0), st.floats(0.0, 1.0), st.floats(1e-3, 1.0))
def test_at_rest_the_parts_add_up_to_the_plain_cooling(fan, pump, chiller):
    split, plain = SplitCooling(a_fan=fan, a_pump=pump, a_chiller=chiller), Cooling()
    rest = split.rest(split.at(g_it=1.0))
    assert split.equations(split.at(g_it=1.0, **rest)).out["p"] == approx(
        plain.equations(plain.at(g_it=1.0, g=1.0)).out["p"]
    )


def test_with_equal_lags_it_is_the_plain_cooling():
    lags = dict(T_fan=30.0, T_pump=30.0, T_chiller=30.0, rho_fan=0.6, rho_pump=0.6, rho_chiller=0.6)
    wave = steps((0.0, 1.0), (1.0, 1.3), until=40.0)
    one, other = (
        play(bench(block, dict(g_it="ratio"), ("p",)), wave, 0.05)
        for block in (SplitCooling(**lags), Cooling())
    )
    np.testing.assert_allclose(one["p"], other["p"], rtol=1e-9)


def test_split_cooling_takes_the_place_of_the_plain_one():
    f = double_conversion.gfl()
    f.replace("cooling", SplitCooling())
    run = play(f, steps((0.0, 1.0), until=0.1))
    plain = play(double_conversion.gfl(), steps((0.0, 1.0), until=0.1))
    assert run["p_g"][-1] == approx(plain["p_g"][-1], abs=1e-9)
