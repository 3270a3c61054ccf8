"""Faults, periods and redispatch: values are checked where they enter, and the balance of power holds."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dcvrt.errors import InfeasibleError, InputError
from dcvrt.grid import BusFault, Period
from dcvrt.grid.redispatch import share


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (
            {"clear": -0.1},
            "fault at bus 23: clear = -0.1 s: the fault would be cleared before it starts. `clear` is the "
            "time from "
            "inception to clearing and must be positive.",
        ),
        (
            {"start": 0.0},
            "fault at bus 23: start = 0 s must be after 0 s, where the simulation begins before the fault.",
        ),
        ({"x_f": -1.0}, "fault at bus 23: x_f = -1, r_f = 0 pu: neither may be negative."),
        (
            {"x_f": 0.0},
            "fault at bus 23: x_f and r_f are both 0: the power balance at the bus has no solution in "
            "voltage magnitude "
            "and angle. Way out: x_f = 1e-4 pu is a bolted fault for every purpose.",
        ),
        (
            {"start": float("nan"), "clear": float("inf")},
            "fault at bus 23: 2 problems\n  start = nan is not a finite number.\n  clear = inf is not a "
            "finite number.",
        ),
    ],
)
def test_bad_fault(values: dict[str, float], message: str) -> None:
    with pytest.raises(InputError) as failure:
        BusFault(23, **values)
    assert str(failure.value) == message


def test_bad_period_names_everything_at_once() -> None:
    with pytest.raises(InputError) as failure:
        Period("night", load_scale=-1.0, wind={69: float("nan")}, dc_factor=float("inf"))
    assert str(failure.value) == (
        "period 'night': 3 problems\n"
        "  load_scale = -1.0 must be a number of at least 0.\n"
        "  dc_factor = inf must be a number of at least 0.\n"
        "  wind at bus 69 = nan MW must be a number of at least 0."
    )


def test_period_and_fault_travel_to_workers() -> None:
    period, fault = Period("light", 0.5, {69: 180.0}, 0.8, 12), BusFault(23, 0.2, 0.15)
    assert pickle.loads(pickle.dumps((period, fault))) == (period, fault)
    assert hash(pickle.loads(pickle.dumps(period))) == hash(period)


MEGAWATT = st.one_of(st.just(0.0), st.floats(1.0, 500.0), st.floats(-50.0, -1.0))
UNITS = st.lists(st.tuples(MEGAWATT, st.floats(1.0, 2.0)), min_size=2, max_size=30).filter(
    lambda units: sum(p for p, _ in units if p > 0) > 1
)


@given(UNITS, st.floats(0.0, 1.0))
def test_redispatch_balances_within_limits(units: list[tuple[float, float]], fill: float) -> None:
    p_set = np.array([p for p, _ in units])
    p_max = np.maximum(p_set, 0.0) * np.array([room for _, room in units])
    fixed = p_set[p_set <= 0].sum()
    total = fixed + fill * p_max[p_set > 0].sum()
    p = share(p_set, p_max, total)
    assert p.sum() == pytest.approx(total, abs=1e-7)
    follows = p_set > 0
    np.testing.assert_array_equal(p[~follows], p_set[~follows])
    assert (p[follows] >= 0).all()
    assert (p[follows] <= p_max[follows] * (1 + 1e-12)).all()
    free = follows & (p < p_max * (1 - 1e-9))
    ratio = p[free] / p_set[free]
    np.testing.assert_allclose(ratio, ratio[:1].repeat(len(ratio)), rtol=1e-9)  # all free units at one factor
    if free.any():  # and a unit at its limit would have gone further
        assert (p[follows & ~free] / p_set[follows & ~free] <= ratio[0] * (1 + 1e-6)).all()


def test_redispatch_returns_the_schedule_for_the_scheduled_total() -> None:
    p_set, p_max = np.array([4.5, 0.0, 2.2]), np.array([5.5, 1.0, 3.2])
    np.testing.assert_allclose(share(p_set, p_max, 6.7), p_set, rtol=1e-15)


@pytest.mark.parametrize(
    ("total", "message"),
    [
        (
            9.0,
            "redispatch: the 2 units that follow the load can generate 0 to 8.7 MW together, 9 MW are "
            "needed. Way out: host less, lower load_scale or raise p_max of some unit.",
        ),
        (
            -0.5,
            "redispatch: the 2 units that follow the load can generate 0 to 8.7 MW together, -0.5 MW are "
            "needed. Way out: more wind than load and losses: lower the wind or raise load_scale.",
        ),
    ],
)
def test_redispatch_that_cannot_be(total: float, message: str) -> None:
    with pytest.raises(InfeasibleError) as failure:
        share(np.array([4.5, 0.0, 2.2]), np.array([5.5, 1.0, 3.2]), total)
    assert str(failure.value) == message
