"""Margins: the functional in closed form, every kind of gradient against differences, the diagnostics."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dcvrt import facility
from dcvrt.criteria import LIMITED_BEFORE_FAULT, Criteria, Curve, Extremum, margins, sustained_minimum
from dcvrt.errors import InputError
from dcvrt.integrators import Casadi, Simulator
from dcvrt.trajectory import Event, Signals, Trajectory
from dcvrt.waveform import Waveform

Function = Callable[[np.ndarray, float], np.ndarray]


def sampled(
    pieces: list[tuple[Callable[[float], float], Function]], theta: float, end: float, h: float = 1e-3
) -> Trajectory:
    """Run whose output `y` is given by pieces (begin(theta), y(t, theta)); derivatives by differences."""
    eps = 1e-6
    t, y, rate, sens, rate_sens, breaks, events = [], [], [], [], [], [], []
    begins = [b(theta) for b, _ in pieces]
    for k, (begin, (when, f)) in enumerate(zip(begins, pieces, strict=True)):
        stop = begins[k + 1] if k + 1 < len(begins) else end
        grid = np.linspace(begin, stop, max(int((stop - begin) / h), 1) + 1)

        def slope(at: np.ndarray, p: float, f: Function = f) -> np.ndarray:
            return (f(at + eps, p) - f(at - eps, p)) / (2 * eps)

        t.append(grid)
        y.append(f(grid, theta))
        rate.append(slope(grid, theta))
        sens.append((f(grid, theta + eps) - f(grid, theta - eps)) / (2 * eps))
        rate_sens.append((slope(grid, theta + 1e-4) - slope(grid, theta - 1e-4)) / 2e-4)
        if k:
            moved = (when(theta + eps) - when(theta - eps)) / (2 * eps)
            breaks.append([moved])
            if moved:
                events.append(Event(begin, "a", "x", "y", "row"))
    join = np.concatenate
    signals = Signals(
        ("y",),
        join(y)[:, None],
        join(rate)[:, None],
        join(sens)[:, None, None],
        join(rate_sens)[:, None, None],
    )
    empty = Signals((), np.zeros((len(join(t)), 0)))
    return Trajectory(
        join(t),
        signals,
        empty,
        empty,
        tuple(events),
        "completed",
        {},
        ("theta",),
        {},
        np.array(breaks).reshape(-1, 1),
    )


def at(pieces: list, theta: float, window: float, end: float = 1.0) -> Extremum:
    return sustained_minimum(Curve.of(sampled(pieces, theta, end), "y"), window)


def check_gradient(
    pieces: list, theta: float, window: float, kind: str, end: float = 1.0, h: float = 1e-4
) -> Extremum:
    found = at(pieces, theta, window, end)
    difference = (at(pieces, theta + h, window, end).value - at(pieces, theta - h, window, end).value) / (
        2 * h
    )
    assert found.kind == kind
    assert found.gradient[0] == pytest.approx(difference, rel=2e-5, abs=1e-8)
    return found


def start(theta: float) -> float:
    return 0.0


# -- where the value is reached, and its gradient
# -------------------------------------------------------------


def test_plain_minimum_inside() -> None:
    """y = 1 - theta exp(-((t - theta)/0.1)^2): the minimum moves, the envelope theorem does not care."""
    y = [(start, lambda t, p: 1 - p * np.exp(-(((t - p) / 0.1) ** 2)))]
    found = check_gradient(y, 0.4, 0.0, "extremum")
    assert found.value == pytest.approx(0.6, abs=1e-7)
    assert found.gradient[0] == pytest.approx(-1.0, abs=1e-5)
    assert found.time == pytest.approx(0.4, abs=1e-6)


def test_plain_minimum_at_an_event() -> None:
    """y falls until the event at theta^2 and rises after it: a corner that moves."""
    y = [(start, lambda t, p: 1 - t), (lambda p: p * p, lambda t, p: 1 - p * p + 2 * (t - p * p))]
    found = check_gradient(y, 0.6, 0.0, "event")
    assert found.value == pytest.approx(1 - 0.36, abs=1e-12)
    assert found.gradient[0] == pytest.approx(-2 * 0.6, abs=1e-6)


def test_plain_minimum_just_after_an_input_jump() -> None:
    y = [(start, lambda t, p: 1 + 0 * t), (lambda p: 0.3, lambda t, p: 0.2 + p + p * (t - 0.3))]
    found = check_gradient(y, 0.5, 0.0, "jump")
    assert found.value == pytest.approx(0.7, abs=1e-12)


def test_window_with_two_free_ends() -> None:
    """A parabola: y* = c + a (D/2)^2 for the symmetric one; here skewed by a cubic term."""
    y = [(start, lambda t, p: 0.5 + p * (t - 0.5) ** 2 * (1 + 0.3 * (t - p)))]
    check_gradient(y, 2.0, 0.2, "window")
    symmetric = [(start, lambda t, p: 0.5 + p * (t - 0.5) ** 2)]
    found = check_gradient(symmetric, 2.0, 0.2, "window")
    assert found.value == pytest.approx(0.5 + 2.0 * 0.01, abs=1e-10)
    assert found.gradient[0] == pytest.approx(0.01, abs=1e-7)
    assert found.time == pytest.approx(0.4, abs=1e-8)


def test_window_held_at_an_input_jump_free_at_the_other_end() -> None:
    y = [(start, lambda t, p: 1 + 0 * t), (lambda p: 0.3, lambda t, p: 1 - 0.5 * np.exp(-(t - 0.3) / p))]
    found = check_gradient(y, 0.2, 0.05, "window")
    assert found.value == pytest.approx(1 - 0.5 * np.exp(-0.25), abs=1e-9)
    assert found.time == pytest.approx(0.3, abs=1e-12)


def test_window_held_at_an_event_with_a_jump_of_the_signal() -> None:
    y = [
        (start, lambda t, p: 1 + 0 * t),
        (lambda p: p * p, lambda t, p: 0.5 + 0.4 * t + 0.3 * (t - p * p) ** 2),
    ]
    check_gradient(y, 0.6, 0.1, "window")


def test_window_held_at_its_end_by_a_jump_upwards() -> None:
    y = [(start, lambda t, p: 1 - p * t**2), (lambda p: 0.6, lambda t, p: 1 + 0 * t)]
    found = check_gradient(y, 0.8, 0.1, "window")
    assert found.value == pytest.approx(1 - 0.8 * 0.25, abs=1e-9)


def test_window_held_at_its_end_by_an_event_upwards() -> None:
    y = [(start, lambda t, p: 1 - 0.5 * t**2), (lambda p: p * p, lambda t, p: 1 + 0 * t)]
    check_gradient(y, 0.8, 0.1, "window")


def test_window_parted_by_an_interior_maximum() -> None:
    """Two dips of 0.08 s with a hump between them: a window of 0.12 s has to climb over the hump."""
    y = [
        (
            start,
            lambda t, p: (
                1 - 0.4 * np.exp(-(((t - 0.45) / 0.04) ** 2)) - p * np.exp(-(((t - 0.57) / 0.04) ** 2))
            ),
        )
    ]
    found = check_gradient(y, 0.42, 0.12, "extremum")
    assert 0.45 < found.time < 0.57


def test_window_parted_by_a_corner_at_an_event() -> None:
    """The hump is a corner whose time depends on theta: the envelope form alone would be wrong."""
    y = [
        (start, lambda t, p: 0.5 + 8 * (t - 0.3) ** 2),
        (lambda p: 0.3 + p, lambda t, p: 0.5 + 8 * p * p - 3 * (t - 0.3 - p) + 30 * (t - 0.3 - p) ** 2),
    ]
    found = check_gradient(y, 0.1, 0.25, "event", h=1e-5)
    assert found.value == pytest.approx(0.58, abs=1e-9)
    assert found.gradient[0] == pytest.approx(16 * 0.1, rel=1e-6)


def test_a_tie_is_flagged() -> None:
    def dips(t: np.ndarray, p: float) -> np.ndarray:
        return 1 - 0.4 * np.exp(-(((t - 0.3) / 0.05) ** 2)) - p * np.exp(-(((t - 0.7) / 0.05) ** 2))

    y = [(start, dips)]
    for window in (0.0, 0.04):
        assert at(y, 0.4, window).tie
        assert not at(y, 0.39, window).tie
        assert not at(y, 0.41, window).tie


@given(
    st.lists(st.floats(0.0, 1.0), min_size=4, max_size=30),
    st.floats(0.02, 0.5),
)
def test_the_functional_is_the_brute_force_one(levels: list[float], window: float) -> None:
    """Straight lines between levels: min over s of max over the window on a fine grid, at most a step off."""
    n = len(levels)
    t = np.repeat(np.arange(n) * 0.1, 2)[1:-1]
    y = np.repeat(levels, 2)[1:-1].astype(float)
    slope = np.repeat(np.diff(levels) / 0.1, 2)
    zero = np.zeros((len(t), 0))
    curve = Curve.with_extrema(t, y, slope, zero, zero, zero, np.full(len(t), "jump"))
    if t[-1] < window:
        return
    value = sustained_minimum(curve, window).value
    starts = np.linspace(0.0, t[-1] - window, 1500)
    inside = np.linspace(0.0, 1.0, 400) * window
    brute = np.interp(starts[:, None] + inside, np.arange(n) * 0.1, levels).max(axis=1).min()
    steepest = np.abs(slope).max(initial=0.0)
    assert brute - steepest * 2e-3 - 1e-9 <= value <= brute + steepest * window / 400 + 1e-9


# -- margins of a facility
# --------------------------------------------------------------------------------------


THETAS = ("beta", "dc.T_hold", "bess.T_b", "sup.w_sag")


@cache
def simulators(mode: str) -> tuple[Simulator, Simulator]:
    dae = getattr(facility, mode)().compile()
    return (
        Simulator(dae, Casadi("erk", 1e-9, 1e-11), wrt=THETAS, save_at=5e-4),
        Simulator(dae, Casadi("erk", 1e-12, 1e-14), save_at=5e-4),
    )


@pytest.mark.parametrize("mode", ["gfl", "gfm"])
@pytest.mark.parametrize("criterion", ["sustained", "instantaneous"])
def test_gradients_of_a_facility_equal_central_differences(mode: str, criterion: str) -> None:
    """A deep fault on a small converter, energy guards first: event times depend on every parameter."""
    wave = Waveform.segments(
        [(0.0, 1.0), (0.1, 0.4 * np.exp(-0.3j)), (0.25, 0.97, 1.0), (0.6, 1.0)], until=0.7
    )
    values = {
        "beta": 1.05,
        "sup.V_dip": 0.3,
        "sup.V_low": 0.25,
        "sup.V_deep": 0.2,
        "sup.V_back": 0.9,
        "bus.k_line": 0.0,
    }
    values["bess.T_b"] = {"gfl": 0.05, "gfm": 0.01}[mode]  # slow enough that the DC energy sags below w_sag
    criteria = Criteria(criterion=criterion, loss_window=0.040 if criterion == "sustained" else 0.0)  # type: ignore[arg-type]
    smooth, oracle = simulators(mode)
    m = margins(smooth(wave, **values), criteria)
    compared = 0
    for theta in THETAS:
        value = values.get(theta, smooth.dae.parameter_rows[smooth.dae.parameter_number(theta)].value)
        h = 2e-5 * value
        up, down = (margins(oracle(wave, **{**values, theta: value + s * h}), criteria) for s in (1, -1))
        assert up.sequence == down.sequence == m.sequence
        for margin, above, below in ((m.voltage, up.voltage, down.voltage), (m.loss, up.loss, down.loss)):
            difference = (above.value - below.value) / (2 * h)
            if abs(difference * value) > 1e-3:  # smaller ones are below the digits of the differences
                assert margin.grad[theta] == pytest.approx(difference, rel=1e-4), (theta, margin.kind)
                compared += 1
    assert compared >= 4


@pytest.mark.parametrize("mode", ["gfl", "gfm"])
def test_static_loss_law(mode: str) -> None:
    """In a long fault the import settles at beta V / P_0 of what it was: full current, lower voltage."""
    wave = Waveform.sag(0.6, 0.1, 0.2, until=0.6)
    smooth, _ = simulators(mode)
    run = smooth(wave, beta=1.2)
    m = margins(run, Criteria(loss_window=0.1))
    assert m.loss.value == pytest.approx(0.25 - (1 - 1.2 * 0.6 / run["p_g"][0]), abs=0.02)
    assert m.diagnostics["peak_loading"] == pytest.approx(1.0, abs=2e-3)
    fine = np.unique(np.concatenate([run.t[:-1] + f * np.diff(run.t) for f in np.arange(20) / 20]))
    energy = float(np.trapezoid(np.maximum(run.at("p_b", fine), 0), fine))
    assert m.diagnostics["bess_energy"] == pytest.approx(energy, rel=1e-6)


# -- diagnostics and messages
# -------------------------------------------------------------------------------------


def import_run(
    power: Callable[[np.ndarray], np.ndarray], voltage: Callable[[np.ndarray], np.ndarray]
) -> Trajectory:
    t = np.linspace(0.0, 2.0, 2001)
    values = np.column_stack((voltage(t), power(t)))
    rates = np.column_stack([(f(t + 1e-6) - f(t - 1e-6)) / 2e-6 for f in (voltage, power)])
    empty = Signals((), np.zeros((len(t), 0)))
    return Trajectory(
        t,
        Signals(("v_it", "p_g"), values, rates),
        empty,
        empty,
        (),
        "completed",
        {},
        (),
        {"sup": "NORMAL"},
        np.zeros((0, 0)),
    )


def dip(depth: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda t: 1 - depth * np.exp(-(((t - 1.0) / 0.1) ** 2))


def test_diagnostics_in_closed_form() -> None:
    m = margins(import_run(dip(0.5), dip(0.3)), Criteria(v_it_min=0.9, recovery_share=0.9))
    half = 0.1 * np.sqrt(np.log(3.0))
    assert m.diagnostics["time_below"] == pytest.approx(2 * half, abs=1e-6)
    assert m.diagnostics["recovery_time"] == pytest.approx(0.2 * np.sqrt(np.log(5.0)), abs=1e-6)
    assert m.diagnostics["v_it_min"] == pytest.approx(0.7, abs=1e-7)
    assert m.voltage.value == pytest.approx(1 - 0.3 * np.exp(-(0.1**2)) - 0.9, abs=1e-6)
    assert m.loss.value == pytest.approx(0.25 - 0.5 * np.exp(-(0.2**2)), abs=1e-6)
    assert m.diagnostics["peak_loss_share"] == pytest.approx(0.5, abs=1e-7)
    assert not m.passed


@pytest.mark.parametrize("mode", ["gfl", "gfm"])
@pytest.mark.parametrize("voltage", [1.0, 0.96])
def test_preload_tells_a_limiter_that_is_active_before_the_fault(mode: str, voltage: float) -> None:
    """It is active below beta = d/(pf V_0), and what it cuts first is reactive current."""
    d, pf = 0.95, 0.98
    wave = Waveform.segments([(0.0, voltage), (0.1, 0.8), (0.2, voltage)], until=0.4)
    smooth, _ = simulators(mode)
    enough = d / (pf * voltage)
    above = smooth(wave, H=1.0, d=d, pf=pf, beta=1.01 * enough)
    below = smooth(wave, H=1.0, d=d, pf=pf, beta=0.99 * enough)
    q_wanted = d * np.tan(np.arccos(pf))
    assert margins(above).diagnostics["preload"] == pytest.approx(1 / 1.01, abs=1e-4)
    assert margins(above).diagnostics["preload"] < LIMITED_BEFORE_FAULT
    assert above["q_g"][0] == pytest.approx(q_wanted, rel=1e-3)
    assert margins(below).diagnostics["preload"] > LIMITED_BEFORE_FAULT
    assert below["p_g"][0] == pytest.approx(d, rel=1e-4)
    current = 0.99 * enough * voltage
    left = np.sqrt(current**2 - d**2)
    smoothed = 2e-4  # share by which the smooth limiter stays below the limit
    assert below["q_g"][0] == pytest.approx(left, abs=smoothed * current**2 / left)
    assert below["q_g"][0] < 0.75 * q_wanted


def test_recovery_may_be_demanded() -> None:
    run = import_run(dip(0.2), dip(0.0))
    assert margins(run, Criteria(recovery_time=0.5)).passed
    assert not margins(run, Criteria(recovery_time=0.1)).passed
    lost = margins(import_run(lambda t: 1 - 0.2 * (t > 1), dip(0.0)), Criteria(recovery_time=5.0))
    assert lost.diagnostics["recovery_time"] == np.inf
    assert not lost.passed


def test_flat_rows_carry_everything() -> None:
    smooth, _ = simulators("gfl")
    row = margins(smooth(Waveform.sag(0.5, 0.1, 0.15, until=0.5), beta=1.1)).flat()
    assert {"voltage", "loss", "d_voltage/d_beta", "d_loss/d_sup.w_sag", "sequence", "peak_loading"} <= set(
        row
    )
    assert row["sequence"].startswith("sup: NORMAL | sup: NORMAL -> MIXED")


def test_criteria_out_of_range_are_told_at_once() -> None:
    with pytest.raises(InputError) as error:
        Criteria(v_it_min=-1.0, loss_share=2.0, criterion="sometimes", recovery_time=0.0)  # type: ignore[arg-type]
    assert str(error.value) == (
        "criteria: 4 problems\n"
        "  v_it_min = -1 must lie in [0, 2].\n"
        "  loss_share = 2 must lie in [0, 1].\n"
        "  criterion = 'sometimes' must be 'sustained' or 'instantaneous'.\n"
        "  recovery_time = 0 s must be positive."
    )


def test_runs_that_cannot_be_judged() -> None:
    run = import_run(dip(0.5), dip(0.3))
    with pytest.raises(InputError) as error:
        margins(run, Criteria(window=5.0))
    assert str(error.value) == "margins: the run lasts 2 s, less than the window of 5 s."
    with pytest.raises(InputError) as error:
        margins(import_run(lambda t: 0 * t, dip(0.3)))
    assert (
        str(error.value)
        == "margins: the import before the fault is p_g = 0 pu; a load loss has no reference."
    )
    object.__setattr__(run, "status", "DC link collapsed at 0.320 s")
    with pytest.raises(InputError) as error:
        margins(run)
    assert str(error.value) == "margins: the run has no result to judge: DC link collapsed at 0.320 s."
