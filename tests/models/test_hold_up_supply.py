"""Server power supplies: hold-up, trip and restart in closed form."""

from __future__ import annotations

from itertools import pairwise
from math import hypot, log, sqrt

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dcvrt import Waveform
from dcvrt.models import HoldUpSupply, Phasor
from tests.models.alone import alone, modes, rates, steps, times

approx = pytest.approx
SIM = alone(HoldUpSupply(share=1.0, T_restart=0.5, T_ramp=0.8))
"""Rated power 1; restarts so fast that a test can wait for it."""
EMPTY = 0.010
"""Hold-up time at rated power, s."""


def ride(retained, length, until=1.0, load=1.0, **parameters):
    """Sag at 0.1 s."""
    sag = Waveform.sag(retained, 0.1, length, until=until)
    measured = steps((0.0, 1.0), (0.1, retained), (0.1 + length, 1.0), until=until)
    demand = steps((0.0, load), until=until)
    return SIM(
        sag, inputs={"v_f": measured, "demand": demand}, **{f"b.{k}": v for k, v in parameters.items()}
    )


@pytest.mark.parametrize("load", [0.25, 0.7, 1.0])
def test_hold_up_time_is_inverse_to_the_load(load):
    run = ride(0.0, 0.5, load=load)
    assert modes(run) == ["HOLD_UP", "TRIPPED"]
    assert times(run, "HOLD_UP") == [approx(0.1)]
    assert times(run, "TRIPPED") == [approx(0.1 + EMPTY / load, abs=1e-7)]


def test_hold_up_time_is_what_the_parameter_says_whatever_the_depth_of_discharge():
    for e_min in (0.3, 0.8):
        run = ride(0.0, 0.5, e_min=e_min, T_hold=0.02)
        assert times(run, "TRIPPED") == [approx(0.12, abs=1e-6)]


@pytest.mark.parametrize("length", [0.004, 0.0099])
def test_a_gap_within_the_hold_up_is_not_seen_by_the_servers(length):
    run = ride(0.0, length)
    assert modes(run) == ["HOLD_UP", "RUN"]
    assert run["p"].min() == 1.0
    assert run["b.e"].min() == approx(1 - 0.41 * length / EMPTY, abs=1e-5)
    assert run["b.e"][-1] == approx(1.0, abs=1e-5)


@pytest.mark.parametrize("retained", [0.4, 0.6, 0.7])
def test_a_shallow_sag_empties_the_capacitors_as_the_current_limit_leaves_it(retained):
    """P - I_lim V is missing, and (1 - e_min) E_N is there."""
    run = ride(retained, 0.5)
    assert times(run, "TRIPPED") == [approx(0.1 + EMPTY / (1 - 1.28 * retained), rel=1e-4)]


def test_above_the_current_limit_they_ride_for_any_time():
    run = ride(1 / 1.28 + 0.005, 0.8)
    assert not run.events
    assert run["drawn"][-1] == approx(1.0, abs=1e-4)
    assert run["b.e"].min() > 0.99


def test_restart_in_closed_form():
    """Wait, fill up through the inrush limit, come back linearly."""
    run = ride(0.0, 0.2, until=2.5, load=0.9)
    assert modes(run) == ["HOLD_UP", "TRIPPED", "PRECHARGE", "RESTART", "RUN"]
    (begin,), (start,), (end,) = (times(run, mode) for mode in ("PRECHARGE", "RESTART", "RUN"))
    assert begin == approx(0.3 + 0.5, abs=1e-9)
    nominal = EMPTY / 0.41
    linear = (1 - 0.15 / 2.0) - 0.59  # up to the energy at which the recharge law leaves its limit
    fill = nominal * linear / 0.15 + nominal / 2.0 * log(0.075 / 0.05)
    assert start - begin == approx(fill, rel=3e-3)
    assert end - start == approx(0.8, abs=1e-9)
    off = (run.t > times(run, "TRIPPED")[0]) & (run.t < start)
    assert np.abs(run["p"][off]).max() == 0
    assert run.at("p", [start + 0.2, start + 0.6]) == approx([0.9 * 0.25, 0.9 * 0.75])
    assert run["p"][-1] == approx(0.9)


def test_a_second_sag_during_the_restart_begins_it_anew():
    stair = ((0.0, 1.0), (0.1, 0.0), (0.2, 1.0), (1.0, 0.0), (1.1, 1.0))
    run = SIM(
        Waveform.segments(list(stair), until=3.0),
        inputs={"v_f": steps(*stair, until=3.0), "demand": steps((0.0, 1.0), until=3.0)},
    )
    assert modes(run)[:5] == ["HOLD_UP", "TRIPPED", "PRECHARGE", "RESTART", "TRIPPED"]
    assert times(run, "TRIPPED")[1] == approx(1.0)
    assert times(run, "PRECHARGE")[1] == approx(1.6)


def test_at_rest_full_and_drawing_what_the_servers_ask_for():
    supply = HoldUpSupply(H=2.0, share=0.5)
    values = dict(v=Phasor.polar(0.95, 0.4), v_f=0.95, demand=0.9)
    assert rates(supply, e=1.0, **values)["e"] == approx(0.0, abs=2e-4)
    out = supply.equations(supply.at(e=1.0, **values)).out
    power = complex(values["v"] * out["i"].conj())
    assert power.real == approx(out["drawn"], rel=1e-12)
    assert power.real == approx(0.9, abs=1e-5)
    assert power.real / abs(power) == approx(0.98, abs=1e-5)
    assert out["p"] == 0.9


@given(st.floats(0, 1.2), st.floats(-3, 3), st.floats(0, 1.2), st.floats(0.5, 1.1), st.sampled_from(range(5)))
def test_current_stays_within_its_limit_and_power_is_that_of_the_current(v, angle, demand, e, mode):
    supply = HoldUpSupply()
    mode = supply.modes[mode]
    values = dict(v=Phasor.polar(v, angle), v_f=v, demand=demand, e=e, clock=0.1, mode=mode)
    out = supply.equations(supply.at(**values)).out
    rated = supply.share * supply.H
    assert hypot(out["i"].re, out["i"].im) * supply.pf <= supply.I_lim * rated * (1 + 1e-5)
    power = complex(values["v"] * out["i"].conj())
    assert power.real == approx(out["drawn"], abs=1e-12)
    assert out["drawn"] >= 0
    assert power.imag == approx(power.real * sqrt(1 / 0.98**2 - 1), abs=1e-6 * (1 + power.real))
    if mode in ("HOLD_UP", "TRIPPED"):
        assert out["drawn"] == 0
    if mode in ("TRIPPED", "PRECHARGE"):
        assert out["p"] == 0


def test_deeper_sags_trip_sooner():
    trips = [times(ride(v, 0.5), "TRIPPED")[0] for v in (0.0, 0.4, 0.5, 0.6, 0.7)]
    assert all(a < b for a, b in pairwise(trips))
