"""Synchronised training: event times, levels, mean, phase."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dcvrt import Simulator, Waveform
from dcvrt.facility import double_conversion
from dcvrt.models import TrainingLoad, workload
from tests.models.sources import bench, play, steps, walk

approx = pytest.approx
FLAT = Waveform.segments([(0.0, 1.0)], until=60.0)


def train(until: float = 40.0, save_at: float = 5e-3, **parameters: float):
    block = TrainingLoad(**parameters)
    return block, play(bench(block, dict(g_it=1.0), ("p", "g")), steps((0.0, 1.0), until=until), save_at)


def test_steps_and_checkpoints_come_at_the_times_of_the_schedule():
    _, run = train(until=14.0, cycle=2.0, low=0.25, steps=3.0, T_cp=1.5, phase=0.4, depth=0.5, depth_cp=0.2)
    expected = [
        (0.8, "COMMUNICATE"), (1.3, "COMPUTE"), (2.8, "COMMUNICATE"), (3.3, "COMPUTE"), (4.8, "COMMUNICATE"),
        (5.3, "CHECKPOINT"), (6.8, "COMPUTE"), (8.3, "COMMUNICATE"), (8.8, "COMPUTE"), (10.3, "COMMUNICATE"),
        (10.8, "COMPUTE"), (12.3, "COMMUNICATE"), (12.8, "CHECKPOINT"),
    ]  # fmt: skip
    found = walk(run, "block")
    assert [m for _, m in found] == [m for _, m in expected]
    np.testing.assert_allclose([t for t, _ in found], [t for t, _ in expected], atol=1e-9)
    assert not any(event.tie for event in run.events)


def test_a_checkpoint_after_every_step():
    _, run = train(until=10.0, cycle=2.0, steps=1.0, T_cp=1.0)
    modes = [m for _, m in walk(run, "block")]
    assert modes[:6] == ["COMMUNICATE", "CHECKPOINT", "COMPUTE"] * 2


def test_levels_keep_their_depths():
    block, run = train()
    mean = (2 * 3.5 * (1 - 0.3 * 0.5) + 6.0 * (1 - 0.16)) / 13.0
    before = {m: run["g"][np.searchsorted(run.t, t) - 2] for t, m in walk(run, "block")}
    assert run["g"][0] == approx(1 / mean)
    assert before["COMPUTE"] == approx((1 - 0.16) / mean, abs=1e-6)  # the last COMPUTE ends a checkpoint
    assert before["COMMUNICATE"] == approx(1 / mean, abs=1e-6)
    assert before["CHECKPOINT"] == approx(0.5 / mean, abs=1e-6)
    assert run["p"] == approx(block.share * run["g"])


def test_the_mean_over_steps_and_checkpoint_is_one():
    _, run = train(until=50.0, save_at=1e-3)
    starts = [t for t, m in walk(run, "block") if m == "CHECKPOINT"]
    period = starts[2] - starts[1]
    assert period == approx(13.0, abs=1e-9)
    inside = (run.t >= starts[1]) & (run.t <= starts[2])
    assert np.trapezoid(run["g"][inside], run.t[inside]) / period == approx(1.0, abs=1e-4)


def test_the_gain_scales_the_fluctuation():
    _, none = train(until=10.0, gain=0.0)
    assert none["g"] == approx(1.0, abs=1e-12)
    (_, half), (_, full) = (train(until=10.0, gain=gain) for gain in (0.5, 1.0))
    np.testing.assert_allclose(half["g"] - 1, 0.5 * (full["g"] - 1), atol=1e-9)


def test_edges_are_exponentials():
    block, run = train(until=4.0, save_at=1e-3, T_edge=0.05)
    t_0 = walk(run, "block")[0][0]
    edge = (run.t > t_0) & (run.t < t_0 + 0.5)
    high = run["g"][0]
    np.testing.assert_allclose(
        run["g"][edge], high * (0.5 + 0.5 * np.exp(-(run.t[edge] - t_0) / block.T_edge)), rtol=1e-8
    )


@given(st.floats(0.0, 1.0))
def test_the_phase_moves_the_first_low_phase(phase):
    _, run = train(until=6.0, phase=phase)
    assert walk(run, "block")[0] == (approx(phase * 3.5, abs=1e-9), "COMMUNICATE")


def test_two_sites_out_of_phase_never_fall_together():
    one, other = (train(until=4.0, steps=1000.0, phase=phase)[1] for phase in (0.2, 0.7))
    times = [[t for t, _ in walk(run, "block")][:2] for run in (one, other)]
    assert times[0][1] < times[1][0]


def test_names_are_those_of_the_stochastic_workload():
    """Same parameters, same default figures where both have them."""
    training = next(c for c in workload.DEFAULT if c.name == "training")
    assert TrainingLoad().depth_cp == training.depth
    assert TrainingLoad().T_cp == approx(training.low * training.cycle, abs=0.05)
    short = next(c for c in workload.DEFAULT if "short" in c.name)
    assert (TrainingLoad().cycle, TrainingLoad().low, TrainingLoad().depth) == (
        short.cycle,
        short.low,
        short.depth,
    )


def test_it_takes_the_place_of_the_servers_of_a_variant():
    f = double_conversion.gfl()
    f.replace("it", TrainingLoad(gain=0.8))
    run = Simulator(f.compile(), save_at=5e-3)(FLAT, beta=1.5)
    plain = Simulator(double_conversion.gfl().compile(), save_at=5e-3)(FLAT, beta=1.5)
    assert run["p_it"].min() < 0.65 * run["p_it"].max()
    assert np.ptp(run["p_cool"]) < 1e-9
    # what the servers draw, the grid supplies: the same energy as a constant load over whole periods
    starts = [t for t, m in walk(run, "it") if m == "CHECKPOINT"]
    inside = (run.t >= starts[0]) & (run.t <= starts[2])
    mean = np.trapezoid(run["p_g"][inside], run.t[inside]) / (starts[2] - starts[0])
    assert mean == approx(plain["p_g"][0], rel=2e-3)
