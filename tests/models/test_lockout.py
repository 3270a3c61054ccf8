"""Supervisor with a lock: out at once, back only when it is open."""

from __future__ import annotations

import numpy as np
import pytest

from dcvrt.models import Supervisor, SupervisorWithLockout
from tests.models.sources import bench, play, steps, walk

approx = pytest.approx


def locked(*levels: tuple[float, float], until: float, v_f: float = 1.0):
    """The lock follows the waveform, from 0; voltage, energy and angle stay where they are."""
    sup = SupervisorWithLockout()
    wires = dict(v_f=v_f, w=1.0, error=0.0, lock="ratio")
    return play(bench(sup, wires, ("share", "mode")), steps((0.0, 0.0), *levels, until=until))


def test_a_lock_leaves_for_battery_at_once_and_stays():
    run = locked((1.0, 1.0), until=10.0)
    assert walk(run, "block") == [(approx(1.0, abs=1e-9), "BATTERY")]
    assert np.abs(run["share"][run.t > 1.0]).max() == 0.0


def test_it_returns_a_healthy_time_after_the_lock_opens():
    run = locked((1.0, 1.0), (3.0, 0.0), until=5.0)
    times, modes = zip(*walk(run, "block"), strict=True)
    assert modes == ("BATTERY", "RETURN", "NORMAL")
    assert times == approx((1.0, 3.0 + 0.4, 3.0 + 0.9), abs=1e-9)


def test_a_lock_in_return_goes_back_to_battery():
    run = locked((1.0, 1.0), (2.0, 0.0), (2.6, 1.0), until=4.0)
    assert [m for _, m in walk(run, "block")] == ["BATTERY", "RETURN", "BATTERY"]


def test_without_a_lock_it_is_the_plain_supervisor():
    runs = []
    for sup, extra in ((Supervisor(), {}), (SupervisorWithLockout(), {"lock": 0.0})):
        wires: dict[str, str | float] = dict(v_f="volts", w=1.0, error=0.0) | extra
        wave = steps((0.0, 1.0), (0.1, 0.7), (0.2, 1.0), (0.5, 0.3), (0.8, 1.0), until=3.0)
        runs.append(play(bench(sup, wires, ("share",)), wave))
    assert [(e.time, e.target) for e in runs[0].events] == [(e.time, e.target) for e in runs[1].events]
    np.testing.assert_array_equal(runs[0]["share"], runs[1]["share"])
    assert [m for _, m in walk(runs[0], "block")] == [
        "MIXED", "NORMAL", "MIXED", "BATTERY", "RETURN", "NORMAL",
    ]  # fmt: skip
