"""Blocks of the UPS that stand beside the grid: switch, walk-in, controls, inverter, battery, loads."""

from __future__ import annotations

from math import exp, pi, sin, sqrt

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dcvrt.models import (
    AcBus,
    AcLoad,
    EcoModeControl,
    LineConditioner,
    LineInteractiveControl,
    NoBattery,
    ParallelConverter,
    Phasor,
    Rectifier,
    StaticSwitch,
    UpsBattery,
    UpsInverter,
    WalkIn,
)
from dcvrt.models.automaton import check_table
from tests.models.alone import alone, flat, modes, rates, steps, times

approx = pytest.approx


def outputs(block, **values):
    return dict(block.equations(block.at(**values)).out)


# ---- switch and walk-in ---------------------------------------------------------------------------------


@pytest.mark.parametrize("gap", [0.0, 1.8e-3, 0.015])
def test_the_switch_leaves_a_gap_of_the_transfer_time_and_comes_back_without_one(gap):
    command = steps((0.0, 0.0), (0.1, 1.0), (0.4, 0.0), until=0.6)
    run = alone(StaticSwitch(T_transfer=gap))(flat(0.6), inputs={"transfer": command})
    assert modes(run) == ["OPEN", "INVERTER", "GRID"]
    assert [t for mode in ("OPEN", "INVERTER", "GRID") for t in times(run, mode)] == [
        approx(0.1), approx(0.1 + gap, abs=1e-9), approx(0.4)
    ]  # fmt: skip
    inside = (run.t > 0.1) & (run.t < 0.1 + gap)
    assert (run["on_grid"] + run["on_inverter"])[inside].max(initial=0.0) == 0
    assert (run["on_grid"] + run["on_inverter"])[(run.t < 0.1) | (run.t > 0.11 + gap)].min() == 1


def test_a_transfer_that_has_begun_is_completed():
    command = steps((0.0, 0.0), (0.1, 1.0), (0.101, 0.0), until=0.2)
    run = alone(StaticSwitch(T_transfer=5e-3))(flat(0.2), inputs={"transfer": command})
    assert modes(run) == ["OPEN", "INVERTER", "GRID"]
    assert times(run, "GRID") == [approx(0.105)]


def test_the_switch_passes_the_voltage_of_the_side_it_is_on():
    switch = StaticSwitch()
    sides = dict(v_grid=Phasor(0.9, 0.1), v_inverter=Phasor(1.0, -0.2), transfer=0.0)
    seen = {m: complex(outputs(switch, mode=m, **sides)["v"]) for m in switch.modes}
    assert seen == {"GRID": 0.9 + 0.1j, "OPEN": 0, "INVERTER": 1.0 - 0.2j}


def test_walk_in_is_a_straight_line_that_a_withdrawn_command_ends():
    command = steps((0.0, 0.0), (1.0, 1.0), (2.5, 0.0), (3.0, 1.0), until=8.0)
    run = alone(WalkIn(T_walk=4.0))(flat(8.0), inputs={"command": command})
    assert modes(run) == ["RAMP", "OFF", "RAMP", "FULL"]
    assert times(run, "FULL") == [approx(7.0, abs=1e-9)]
    assert run.at("share", [0.5, 2.0, 2.7, 4.0, 6.0, 7.5]) == approx([0, 0.25, 0, 0.25, 0.75, 1])
    assert run.at("done", [6.9, 7.1]).tolist() == [0, 1]


# ---- tables of the controls -----------------------------------------------------------------------------

CONTROLS = {"line": LineInteractiveControl, "eco": EcoModeControl}


@pytest.mark.parametrize("kind", [*CONTROLS.values(), StaticSwitch, WalkIn])
def test_the_tables_are_sound(kind):
    block = kind()
    assert not check_table(block.modes, block.start, block.transitions(block.symbols("b")))


def line(stair, until, error=0.0, soc=0.8, done=0.0, **parameters):
    control = LineInteractiveControl(**parameters)
    inputs = dict(v_f=stair, error=((0.0, error),), soc=((0.0, soc),), walked=((0.0, 0.0),), done=done)
    inputs["done"] = ((0.0, 0.0), (done, 1.0)) if done else ((0.0, 0.0),)
    return alone(control)(flat(until), inputs={k: steps(*v, until=until) for k, v in inputs.items()})


def test_line_interactive_qualifies_the_line_for_the_whole_time():
    run = line(((0.0, 1.0), (1.0, 0.7), (1.5, 1.0)), until=8.0, done=6.0)
    assert modes(run) == ["BATTERY", "SYNCHRONISE", "RETURN", "LINE"]
    assert times(run, "BATTERY") == [approx(1.0)]
    assert times(run, "RETURN") == [approx(1.5 + 3.0, abs=1e-9)]
    assert times(run, "LINE") == [approx(6.0)]


def test_line_interactive_starts_the_qualification_again_after_another_sag():
    run = line(((0.0, 1.0), (1.0, 0.7), (1.5, 1.0), (3.0, 0.8), (3.1, 1.0)), until=7.0)
    assert modes(run) == ["BATTERY", "SYNCHRONISE", "BATTERY", "SYNCHRONISE", "RETURN"]
    assert times(run, "RETURN") == [approx(3.1 + 3.0)]


def test_line_interactive_does_not_return_out_of_step():
    run = line(((0.0, 1.0), (1.0, 0.7), (1.5, 1.0)), until=8.0, error=0.06)
    assert modes(run) == ["BATTERY", "SYNCHRONISE"]


@pytest.mark.parametrize("voltage", [0.905, 1.095])
def test_line_interactive_stays_within_its_window(voltage):
    assert not line(((0.0, 1.0), (1.0, voltage)), until=5.0).events


def test_line_interactive_drops_the_load_when_the_battery_is_empty_and_waits_for_the_line():
    run = line(((0.0, 1.0), (1.0, 0.0), (3.0, 1.0)), until=8.0, soc=0.05)
    assert modes(run) == ["BATTERY", "DOWN", "LINE"]
    assert times(run, "LINE") == [approx(6.0)]


def eco(stair, until, error=0.0, soc=0.8, done=(), **parameters):
    control = EcoModeControl(**parameters)
    inputs = dict(v_f=stair, error=((0.0, error),), soc=((0.0, soc),), walked=((0.0, 0.0),))
    inputs["done"] = ((0.0, 0.0), *((t, 1.0) for t in done))
    return alone(control)(flat(until), inputs={k: steps(*v, until=until) for k, v in inputs.items()})


def test_eco_mode_goes_through_battery_to_double_conversion_and_requalifies():
    run = eco(((0.0, 1.0), (1.0, 0.3), (1.2, 1.0)), until=330.0, done=(14.2,))
    assert modes(run) == ["BATTERY", "WALK_IN", "DOUBLE", "ECO"]
    assert times(run, "WALK_IN") == [approx(1.2 + 3.0)]
    assert times(run, "DOUBLE") == [approx(14.2)]
    assert times(run, "ECO") == [approx(14.2 + 300.0)]


def test_eco_mode_walks_in_during_a_shallow_sag_that_only_the_bypass_minds():
    run = eco(((0.0, 1.0), (1.0, 0.85)), until=20.0, done=(14.0,))
    assert modes(run) == ["BATTERY", "WALK_IN", "DOUBLE"]
    assert times(run, "WALK_IN") == [approx(4.0)]


def test_eco_mode_in_double_conversion_leaves_the_grid_in_a_deep_sag_only():
    stair = ((0.0, 1.0), (1.0, 0.3), (1.2, 1.0), (20.0, 0.85), (20.2, 1.0), (30.0, 0.7), (30.1, 1.0))
    run = eco(stair, until=32.0, done=(14.2,))
    assert modes(run) == ["BATTERY", "WALK_IN", "DOUBLE", "BATTERY"]
    assert times(run, "BATTERY")[1] == approx(30.0)


def test_eco_mode_on_an_empty_battery():
    run = eco(((0.0, 1.0), (1.0, 0.0), (3.0, 1.0)), until=8.0, soc=0.05)
    assert modes(run) == ["BATTERY", "DOWN", "ECO"]


@pytest.mark.parametrize("kind", CONTROLS.values())
def test_what_the_controls_say_in_their_modes(kind):
    control = kind()
    quiet = dict(v_f=1.0, error=0.0, soc=0.8, walked=0.3, done=0.0)
    said = {m: outputs(control, mode=m, **quiet) for m in control.modes}
    assert [said[m]["mode"] for m in control.modes] == [0, 1, 2, 3, 4]
    for mode, out in said.items():
        on_battery = mode in ("BATTERY", "SYNCHRONISE", "DOWN")
        assert out["share"] == (0.3 if out["walk"] else 0.0 if on_battery or mode == "ECO" else 1.0), mode
        assert not (out["charge"] and on_battery)
        assert out["on"] == (mode != "DOWN")
    assert said["BATTERY"]["align"] == 0  # runs free


# ---- inverter -------------------------------------------------------------------------------------------


def inverter_at(**changes):
    values = dict(
        v_grid=Phasor.polar(1.0, 0.2), i=Phasor(0.9, -0.2), on=1.0, on_inverter=0.0, align=1.0,
        magnitude=1.0, delta=0.2, omega=0.0,
    )  # fmt: skip
    return values | changes


def test_inverter_at_rest_on_the_grid():
    inverter = UpsInverter()
    assert list(rates(inverter, **inverter_at()).values()) == approx([0.0] * 3, abs=1e-9)
    assert inverter.rest(inverter.at(**inverter_at()))["delta"] == approx(0.2)
    assert complex(outputs(inverter, **inverter_at())["v"]) == approx(complex(Phasor.polar(1.0, 0.2)))


def test_inverter_turns_onto_the_grid_no_faster_than_loads_bear_and_runs_free_without():
    inverter = UpsInverter()
    der = rates(inverter, **inverter_at(delta=-0.1))
    assert der["delta"] == approx(3.0 * sin(0.3))
    assert der["omega"] == approx(2.0 * sin(0.3))
    assert inverter.K_p / (2 * pi) < 0.5  # Hz, at any angle
    free = rates(inverter, **inverter_at(delta=-0.1, align=0.0, omega=0.4))
    assert (free["delta"], free["omega"]) == (0.4, 0.0)


def test_inverter_follows_a_grid_off_frequency_without_an_angle_left_over():
    """Type 2: linear closed form of angle and frequency, s^2 + K_p s + K_i."""
    inverter = UpsInverter()
    s = inverter.symbols("b")
    der = inverter.equations(s).der
    jacobian = ca.jacobian(ca.vertcat(der["delta"], der["omega"]), ca.vertcat(s.delta, s.omega))
    a = ca.Function("a", [s.delta, s.omega, s.v_grid.re, s.v_grid.im, s.align, s.K_p, s.K_i], [jacobian])
    eigenvalues = np.linalg.eigvals(np.array(a(0, 0, 1, 0, 1, 3.0, 2.0)))
    assert np.sort(eigenvalues) == approx(np.sort(np.roots([1.0, 3.0, 2.0])))


@pytest.mark.parametrize(("i", "expected"), [(0.9, 1.0), (1.15, 1.0), (1.38, 1.15 / 1.38), (2.3, 0.5)])
def test_inverter_folds_back_beyond_its_rating_when_it_carries_the_bus(i, expected):
    inverter = UpsInverter(eps=1e-6)
    target = lambda **v: rates(inverter, **inverter_at(i=Phasor(i, 0.0), **v))["magnitude"] * inverter.T_v + 1  # noqa: E731
    assert target(on_inverter=1.0) == approx(expected, abs=1e-5)
    assert target(on_inverter=0.0) == approx(1.0)  # the grid's current is none of its business
    assert target(on=0.0) == approx(0.0)


# ---- battery --------------------------------------------------------------------------------------------


def test_battery_covers_what_the_grid_does_not_give():
    battery = UpsBattery()
    at = dict(p_load=0.9, p_g=0.3, charge=0.0, soc=0.8)
    assert outputs(battery, **at)["p"] == approx(0.6)
    assert rates(battery, **at)["soc"] == approx(-0.6 / 270)
    rest = dict(p_load=0.9, p_g=0.9, charge=1.0, soc=battery.soc_ref)
    assert rates(battery, **rest)["soc"] == 0
    assert outputs(battery, **rest)["ask"] == approx(0.0, abs=1e-15)


def test_battery_loses_in_both_directions():
    battery = UpsBattery(eta=0.95, eps=1e-6)
    out = outputs(battery, p_load=0.95, p_g=0.0, charge=0.0, soc=0.8)
    assert out["p"] + out["loss"] == approx(0.95 / 0.95, abs=1e-5)
    back = outputs(battery, p_load=0.0, p_g=1.0, charge=0.0, soc=0.8)
    assert back["p"] + back["loss"] == approx(-0.95, abs=1e-5)
    assert outputs(battery, p_load=0.4, p_g=0.4, charge=0.0, soc=0.8)["loss"] == 0


@given(st.floats(-1, 1), st.floats(0.5, 1.0))
def test_battery_gains_nothing(p, eta):
    battery = UpsBattery(eta=eta)
    assert outputs(battery, p_load=p, p_g=0.0, charge=0.0, soc=0.5)["loss"] >= -battery.eps


def test_battery_asks_for_charge_within_its_limit_and_when_told():
    battery = UpsBattery()
    ask = lambda **v: outputs(battery, p_load=0.0, p_g=0.0, **v)["ask"]  # noqa: E731
    assert ask(charge=1.0, soc=0.795) == approx(0.025, abs=1e-5)
    assert ask(charge=1.0, soc=0.2) == approx(0.1, abs=1e-5)
    assert ask(charge=0.0, soc=0.2) == 0


def test_no_battery():
    assert outputs(NoBattery()) == {"p": 0.0, "soc": 0.0}


# ---- conditioner, converter, rectifier, loads -----------------------------------------------------------


@given(st.floats(0.3, 1.3), st.floats(-3, 3), st.floats(0.85, 1.15))
def test_conditioner_keeps_power(v, angle, a):
    cond = LineConditioner()
    v_in, i_out = Phasor.polar(v, angle), Phasor(0.8, -0.3)
    out = outputs(cond, v=v_in, v_f=v, i_out=i_out, a=a)
    assert complex(v_in * out["i"].conj()) == approx(complex(out["v_out"] * i_out.conj()), abs=1e-12)


@pytest.mark.parametrize(
    ("voltage", "behind"), [(1.0, 1.0), (0.92, 1.0), (1.09, 1.0), (0.8, 0.896), (1.2, 1.056)]
)
def test_conditioner_settles_at_its_set_point_within_its_reach(voltage, behind):
    cond = LineConditioner(eps=1e-6)
    values = dict(v=Phasor(voltage, 0.0), v_f=voltage, i_out=Phasor(0.9, 0.0))
    a = cond.rest(cond.at(**values))["a"]
    assert rates(cond, a=a, **values)["a"] == approx(0.0, abs=1e-12)
    assert complex(outputs(cond, a=a, **values)["v_out"]) == approx(behind, abs=1e-4)


def test_conditioner_without_reach_is_a_wire():
    cond = LineConditioner(k=0.0)
    assert cond.rest(cond.at(v=Phasor(0.8, 0.0), v_f=0.8, i_out=Phasor(1.0, 0.0)))["a"] == approx(1.0)


def test_conditioner_lags():
    cond = LineConditioner(eps=1e-6)
    sim = alone(cond)
    run = sim(flat(0.2), inputs={"v_f": steps((0.0, 1.0), (0.1, 0.95), until=0.2)})
    ratio = lambda t: 1 + (1 / 0.95 - 1) * (1 - exp(-t / 0.02))  # noqa: E731
    at = np.array([0.11, 0.13, 0.18])
    assert run.at("v_out.re", at) == approx([ratio(t - 0.1) for t in at], abs=2e-4)


def test_parallel_converter_leaves_the_line_its_share_and_the_charge():
    converter = ParallelConverter(eps=1e-6)
    v, i = Phasor.polar(1.0, 0.3), Phasor(0.9, -0.1)
    at = dict(v=v, i=i, ask=0.08)
    out = outputs(converter, on_grid=1.0, share=0.25, **at)["i_line"]
    assert complex(v * (out - i * 0.25).conj()) == approx(0.08)
    assert complex(outputs(converter, on_grid=0.0, share=0.0, **at)["i_line"]) == 0


def rectifier_at(**changes):
    values = dict(
        v=Phasor.polar(1.0, 0.5), i_bus=Phasor(0.9, -0.2), p_bus=0.9, on_grid=0.0, on_inverter=1.0,
        share=1.0, rectify=1.0, ask=0.05,
    )  # fmt: skip
    return values | changes


def test_rectifier_draws_the_load_of_the_inverter_and_the_charge_at_its_power_factor():
    rectifier = Rectifier(eps=1e-6, eps_v=1e-6)
    v = Phasor.polar(1.0, 0.5)
    power = complex(v * outputs(rectifier, **rectifier_at())["i"].conj())
    assert power.real == approx(0.95, abs=1e-5)
    assert power.real / abs(power) == approx(0.98, abs=1e-5)
    half = complex(v * outputs(rectifier, **rectifier_at(share=0.5))["i"].conj())
    assert half.real == approx(0.5, abs=1e-5)
    bypass = outputs(rectifier, **rectifier_at(on_grid=1.0, on_inverter=0.0, ask=0.0))["i"]
    assert complex(bypass) == approx(0.9 - 0.2j, abs=1e-9)
    assert complex(outputs(rectifier, **rectifier_at(rectify=0.0))["i"]) == 0


@given(st.floats(0, 1.2), st.floats(0, 2.0))
def test_rectifier_stays_within_its_rating(v, p):
    rectifier = Rectifier()
    i = outputs(rectifier, **rectifier_at(v=Phasor.polar(v, 1.0), p_bus=p))["i"]
    assert abs(complex(i)) <= 1.15 * (1 + 1e-5)


def test_ac_load_is_constant_power_above_and_constant_admittance_below():
    load = AcLoad(eps=1e-6)

    def power(v):
        at = dict(v=Phasor.polar(v, -0.7), cooling_demand=0.16, auxiliary_demand=0.06)
        out = outputs(load, **at)
        drawn = complex(at["v"] * out["i"].conj())
        assert drawn.real == approx(out["cooling"] + out["auxiliary"], abs=1e-12)
        assert drawn.imag == approx(drawn.real * sqrt(1 / 0.98**2 - 1), abs=1e-5)
        return drawn.real

    assert power(1.0) == approx(0.22, rel=1e-6)
    assert power(0.9) == approx(0.22, rel=1e-5)
    assert power(0.425) == approx(0.22 / 4, rel=1e-5)
    assert power(0.0) == 0


def test_bus_adds_currents():
    out = outputs(AcBus(H=2.0), v=Phasor(0.0, 1.0), servers=Phasor(0.2, 0.5), others=Phasor(0.0, 0.1))
    assert complex(out["i"]) == approx(0.2 + 0.6j)
    assert out["p"] == approx(0.6)
    assert out["i_max"] == approx(2.3)
