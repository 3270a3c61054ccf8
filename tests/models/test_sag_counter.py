"""The sag counter: its sliding window against a count done by hand."""

from __future__ import annotations

import numpy as np
import pytest

from dcvrt.models import SagCounter
from tests.models.alone import alone, flat, modes, rates, steps, times

SIM = alone(SagCounter(T_window=60.0, T_reset=100.0))


def ride(sags, until=400.0, **parameters):
    """Sags of 0.1 s at these times."""
    stair = [(0.0, 1.0)]
    for t in sags:
        stair += [(t, 0.5), (t + 0.1, 1.0)]
    values = {f"b.{name}": value for name, value in parameters.items()}
    return SIM(flat(until), inputs={"v_f": steps(*stair, until=until)}, **values)


def locks_by_hand(sags, n, window, reset):
    """Times at which the counter must lock, from the list of sags."""
    locked, kept, opens = [], [], 0.0
    for t in sags:
        if t < opens:
            opens = t + 0.1 + reset  # a sag while locked: the healthy time starts again
            continue
        kept = [s for s in kept if t - s < window] + [t]
        if len(kept) >= n:
            locked.append(t)
            kept, opens = [], t + 0.1 + reset
    return locked


def test_off_unless_set():
    run = ride(np.arange(1.0, 30.0, 1.0), until=40.0)
    assert SagCounter().N == 0
    assert not times(run, "LOCKED")
    assert run["lock"].max() == 0


@pytest.mark.parametrize("n", [1, 2, 3, 4, 5, 6])
def test_locks_as_the_nth_sag_in_the_window_begins(n):
    sags = 10.0 + 9.0 * np.arange(6)  # six in 45 s
    run = ride(sags, until=70.0, N=n)
    assert times(run, "LOCKED") == [pytest.approx(sags[n - 1], abs=1e-9)]
    assert modes(run)[-1] == "LOCKED"
    lock = run.at("lock", [sags[n - 1] - 1e-6, sags[n - 1] + 1e-6])
    assert lock.tolist() == [0, 1]


@pytest.mark.parametrize(("last", "locked"), [(70.0 - 1e-3, True), (70.0 + 1e-3, False)])
def test_the_window_slides_exactly(last, locked):
    """Sags at 10 and 40 s: the third locks within 60 s of the first, not of the second."""
    run = ride([10.0, 40.0, last], until=72.0, N=3)
    assert bool(times(run, "LOCKED")) == locked
    if not locked:  # but a fourth soon after the second does
        assert times(ride([10.0, 40.0, last, 99.0], until=120.0, N=3), "LOCKED") == [pytest.approx(99.0)]


@pytest.mark.parametrize("seed", range(6))
def test_any_series_of_sags_is_counted_as_by_hand(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 6))
    sags = np.cumsum(rng.uniform(1.0, 40.0, 12))
    run = ride(sags, until=sags[-1] + 5.0, N=n)
    assert times(run, "LOCKED") == pytest.approx(locks_by_hand(sags, n, 60.0, 100.0))


def test_the_lock_opens_after_the_healthy_time_and_the_count_starts_again():
    run = ride([10.0, 11.0, 50.0, 170.0, 171.0], until=180.0, N=2)
    assert times(run, "LOCKED") == pytest.approx([11.0, 171.0])
    assert times(run, "READY")[1] == pytest.approx(50.1 + 100.0)  # the sag at 50 s starts the time again


def test_a_long_sag_counts_once():
    run = SIM(
        flat(50.0), inputs={"v_f": steps((0.0, 1.0), (1.0, 0.5), (40.0, 1.0), until=50.0)}, **{"b.N": 2.0}
    )
    assert modes(run) == ["SAG", "READY"]


def test_at_rest_without_memory():
    counter = SagCounter()
    memories = {f"m_{k}": 0.0 for k in range(1, 6)}
    assert set(rates(counter, v_f=1.0, **memories).values()) == {0.0}
    assert rates(counter, v_f=1.0, **(memories | {"m_3": 0.6}))["m_3"] == pytest.approx(-0.01)


def test_rows_are_told_in_words():
    counter = SagCounter()
    rows = [str(row) for row in counter.transitions(counter.symbols("counter"))]
    assert "sag number" in rows[0]
    assert len(rows[0]) < 90
