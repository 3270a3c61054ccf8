"""Scenarios: published figures are met, seeds are obeyed, rotating phasors turn as they say."""

from __future__ import annotations

import itertools
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dcvrt import facility, scenarios
from dcvrt.errors import InputError
from dcvrt.integrators import Simulator
from dcvrt.waveform import Waveform


def error_of(call) -> str:
    with pytest.raises(InputError) as error:
        call()
    return str(error.value)


def sags_of(w: Waveform, below: float = 0.95) -> list[tuple[float, float, float]]:
    """Begin, end and voltage of every stretch below a level of a stepped waveform."""
    pieces = [
        (a, b, abs(v))
        for (a, v), (b, _) in itertools.pairwise(zip(w.t.tolist(), w.v.tolist(), strict=True))
        if b > a
    ]
    return [piece for piece in pieces if piece[2] < below]


def mean_frequency(w: Waveform) -> tuple[np.ndarray, np.ndarray]:
    """Middle of every step between samples, and the mean deviation over it in Hz, from the angle."""
    step = np.diff(w.t)
    k = np.flatnonzero(step > 0)
    turned = np.angle(w.v[k + 1] * w.v[k].conj())
    return w.t[k] + step[k] / 2, turned / (2 * np.pi * step[k])


# -- rotating phasors ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "steps",
    [
        [(0.0, 0.0), (0.5, 0.0, -3.0), (3.5, -3.0), (6.0, -3.0, 0.0), (9.0, 0.0)],
        [(0.0, 0.0), (0.5, 0.0, 5.0), (0.6, 5.0)],
        [(0.0, 0.0), (0.5, -0.01), (0.9, 8.0)],
        [(0.0, 0.0), (0.5, -2.5, 2.5), (1.0, 2.5)],
    ],
    ids=["slow ramp", "fast ramp", "steps", "through zero"],
)
def test_a_rotating_phasor_keeps_its_magnitude_between_samples(steps: list) -> None:
    w = Waveform.rotating(steps, until=10.0, magnitude=0.9)
    assert np.abs(np.abs(w.at(np.linspace(0, 10, 200_003))) - 0.9).max() < 1e-6


@given(st.floats(-6, 6), st.floats(-6, 6), st.floats(0.01, 5))
@settings(max_examples=60, deadline=None)
def test_no_ramp_bends_the_magnitude(f_from: float, f_to: float, length: float) -> None:
    w = Waveform.rotating([(0.0, f_from, f_to)], until=length)
    assert np.abs(np.abs(w.at(np.linspace(0, length, 20_001))) - 1.0).max() < 1e-6


def test_the_frequency_of_a_rotating_phasor_is_that_of_its_steps() -> None:
    w = Waveform.rotating([(0.0, 0.0), (0.5, 0.0, -3.0), (2.0, -3.0), (4.0, 1.5)], until=5.0)
    t, f = mean_frequency(w)
    expected = np.select([t < 0.5, t < 2.0, t < 4.0], [0.0, -2.0 * (t - 0.5), -3.0], 1.5)
    assert np.abs(f - expected).max() < 1e-6
    assert np.abs(np.diff(w.v[np.flatnonzero(np.diff(w.t) == 0)[:, None] + [0, 1]])).max() < 1e-12  # no jump


def test_the_interpolated_speed_ripples_by_the_stated_share() -> None:
    """At the samples the cubic's speed falls short by a sixth of the square of the angle between them."""
    w = Waveform.rotating([(0.0, 2.0)], until=1.0)
    p = w.pieces()
    phi = 2 * np.pi * 2.0 * p.length[0]
    inner = slice(1, -1)
    speed = np.abs(p.coefficients[inner, 1]) / p.length[inner]
    assert phi <= 0.05
    assert speed / (2 * np.pi * 2.0) - 1 == pytest.approx(-(phi**2) / 6, rel=1e-3)


def test_rotating_needs_steps_that_follow_each_other() -> None:
    assert error_of(lambda: Waveform.rotating([(0.0, 0.0), (1.0, 1.0)], until=0.5)) == (
        "waveform: segment 1 begins at 1 s and ends at 0.5 s; times must increase."
    )
    assert error_of(lambda: Waveform.rotating([])).startswith("waveform: no segments given")


@pytest.mark.parametrize("rocof", [-1.0, 5.0])
def test_the_pll_follows_a_frequency_ramp_with_the_error_of_its_closed_form(rocof: float) -> None:
    """With dw/dt = a the PLL settles at e = a / K_i and its integral lags behind the frequency by K_p e."""
    dae = facility.gfl().compile()
    w = scenarios.get("frequency-ramp", rocof=rocof, deviation=2.0, hold=0.5, back=False)
    run = Simulator(dae, save_at=1e-3)(w, H=1.0, beta=1.15)
    K_p, K_i = run.parameters["pll.K_p"], run.parameters["pll.K_i"]
    end = 0.5 + 2.0 / abs(rocof) - 1e-3
    a = 2 * np.pi * rocof
    omega, xi, delta = a * (end - 0.5), float(run.at("pll.xi", end)), float(run.at("pll.delta", end))
    theta = 0.5 * a * (end - 0.5) ** 2
    # a transient of the PLL (33 1/s) is gone after 2 s, not quite after 0.4 s
    settled = np.exp(-0.5 * K_p * (end - 0.5))
    error = np.sin((theta - delta + np.pi) % (2 * np.pi) - np.pi)
    assert error == pytest.approx(a / K_i, rel=2e-3 + 20 * settled)
    assert K_i * xi == pytest.approx(omega - K_p * a / K_i, rel=2e-3 + 20 * settled)


def test_a_frequency_step_turns_the_phasor_and_comes_back() -> None:
    w = scenarios.get("frequency-step", deviation=0.5, hold=2.0)
    t, f = mean_frequency(w)
    assert f == pytest.approx(np.where((t > 0.5) & (t < 2.5), 0.5, 0.0), abs=1e-9)
    assert w.at(3.0) == pytest.approx(1.0, abs=1e-9)  # one whole turn


# -- sequences of sags --------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(5))
def test_six_sags_are_within_what_is_published(seed: int) -> None:
    sags = sags_of(scenarios.get("six-sags", seed=seed))
    assert len(sags) == 6
    assert sags[-1][1] - sags[0][0] == pytest.approx(82.0)
    assert all(0.25 <= depth <= 0.40 for _, _, depth in sags)
    assert all(0.042 - 1e-12 <= b - a <= 0.066 + 1e-12 for a, b, _ in sags)
    assert len({round(depth, 6) for _, _, depth in sags}) == 6


def test_six_sags_are_the_same_for_the_same_seed_and_others_for_another() -> None:
    first, again, other = (scenarios.get("six-sags", seed=s) for s in (3, 3, 4))
    assert np.array_equal(first.t, again.t)
    assert np.array_equal(first.v, again.v)
    assert not np.array_equal(first.v, other.v)
    code = "from dcvrt import scenarios; print(scenarios.get('six-sags', seed=3).v.sum())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=None)
    assert complex(done.stdout) == first.v.sum()


def test_the_spacing_of_six_sags_is_a_parameter() -> None:
    sags = sags_of(scenarios.get("six-sags", spacing=(1.0, 2.0, 3.0, 4.0, 5.0)))
    begins = [a for a, _, _ in sags]
    assert np.diff(begins) == pytest.approx([1, 2, 3, 4, 5])
    assert error_of(lambda: scenarios.get("six-sags", spacing=(1.0,))) == (
        "six-sags: spacing has 1 times; 6 sags need 5."
    )


def test_reclosing_shots_have_their_length_and_dead_times() -> None:
    sags = sags_of(scenarios.get("reclosing", shots=4, length=0.07, dead_times=(0.5, 1.0, 2.0)))
    assert [b - a for a, b, _ in sags] == pytest.approx([0.07] * 4)
    assert [c[0] - a[1] for a, c in itertools.pairwise(sags)] == pytest.approx([0.5, 1.0, 2.0])
    assert error_of(lambda: scenarios.get("reclosing", dead_times=(1.0,))) == (
        "reclosing: dead_times has 1 times; 3 shots need 2."
    )


# -- single events ------------------------------------------------------------------------------------------


def test_a_phase_jump_turns_without_changing_the_magnitude() -> None:
    w = scenarios.get("phase-jump", degrees=-20.0)
    assert np.abs(np.abs(w.at(np.linspace(0, w.until, 4001))) - 1.0).max() < 1e-15
    assert np.angle(w.at(1.0), deg=True) == pytest.approx(-20.0)
    assert w.jumps == (0.5,)


def test_an_unbalanced_sag_is_its_positive_sequence_and_says_so() -> None:
    a = np.exp(2j * np.pi / 3)
    for phases in (1, 2, 3):
        w = scenarios.get("unbalanced-sag", phases=phases, retained=0.3)
        abc = np.array([1, a**2, a]) * np.where(np.arange(3) < phases, 0.3, 1.0)
        assert w.at(0.55) == pytest.approx(complex(abc @ [1, a, a**2]) / 3, abs=1e-12)
        assert w.name.startswith("positive sequence")


def test_swell_interruption_and_staircase() -> None:
    assert scenarios.get("swell").at(1.0) == 1.2
    assert sags_of(scenarios.get("interruption", length=0.2)) == [(0.5, 0.7, 0.0)]
    stairs = sags_of(scenarios.get("undervoltage-steps"))
    assert [(round(a - 0.5, 9), v) for a, _, v in stairs] == [
        (0.0, 0.90), (10.0, 0.85), (17.0, 0.80), (25.0, 0.70), (32.0, 0.60)
    ]  # fmt: skip


# -- names --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", scenarios.names())
def test_every_scenario_starts_at_rest_at_nominal_voltage(name: str) -> None:
    w = scenarios.get(name)
    assert (w.v[0], w.start) == (1.0, 0.0)
    assert w.at(0.05) == 1.0
    assert w.name


def test_what_is_refused_and_how() -> None:
    assert error_of(lambda: scenarios.get("six-sag")).startswith(
        "there is no scenario 'six-sag'. Did you mean 'six-sags'? Known: ercot-style, "
    )
    assert error_of(lambda: scenarios.get("swell", levle=1.1)) == (
        "scenario 'swell': no option 'levle'. Did you mean 'level'? Known: level, length, start, after."
    )
    assert error_of(lambda: scenarios.get("ercot-style", seed=1)) == (
        "scenario 'ercot-style': no option 'seed'. It has none."
    )
    assert error_of(lambda: scenarios.get("swell", level=0.9)) == "swell: level = 0.9 must lie in [1, 2]."
    assert error_of(lambda: scenarios.get("frequency-ramp", rocof=0.0)) == (
        "frequency-ramp: rocof = 0 must lie in [0.001, 100]."
    )
    assert error_of(lambda: scenarios.get("frequency-ramp", rocof="1")) == (
        "frequency-ramp: rocof = '1' is not a number."
    )


def test_names_are_listed_without_numpy() -> None:
    code = (
        "import sys; from dcvrt import envelopes, scenarios\n"
        "scenarios.names(); envelopes.names()\n"
        "print([m for m in ('numpy', 'casadi', 'pandas') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
