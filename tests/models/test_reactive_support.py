"""Reactive support: deadband, slope, limit, and nothing when it is off."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dcvrt.models import ReactiveSupport

approx = pytest.approx


def command(v_f: float, q_c: float = 0.2, **changes: float) -> float:
    support = ReactiveSupport(**({"eps": 1e-6} | changes))
    return support.equations(support.at(q_c=q_c, v_f=v_f)).out["q"]


@pytest.mark.parametrize("v_f", [0.9001, 1.0, 1.0999])
def test_nothing_is_added_within_the_deadband(v_f):
    assert command(v_f) == approx(0.2, abs=1e-6)


@pytest.mark.parametrize(("v_f", "current"), [(0.7, 0.4), (0.5, 0.8), (1.2, -0.2)])
def test_beyond_it_the_current_grows_with_the_gain(v_f, current):
    """i_q = K (V_ref - V_f -+ dV), and the power is that current at the voltage that there is."""
    assert command(v_f) == approx(0.2 - v_f * current, abs=1e-5)


def test_support_is_limited():
    assert command(0.2) == approx(0.2 - 0.2 * 1.0, abs=1e-5)
    assert command(0.2, I_q=0.3) == approx(0.2 - 0.2 * 0.3, abs=1e-5)


@given(st.floats(0.0, 1.3), st.floats(-1.0, 1.0), st.floats(0.01, 50.0))
def test_a_gain_of_zero_adds_nothing(v_f, q_c, h):
    assert command(v_f, q_c, K=0.0, H=h) == approx(q_c, abs=1e-14 * h)


@given(st.floats(0.0, 0.5), st.floats(0.0, 10.0))
def test_a_sag_never_adds_import_and_a_swell_never_takes_any_away(depth, gain):
    assert command(1 - depth, K=gain) <= 0.2 + 1e-9
    assert command(1 + depth, K=gain) >= 0.2 - 1e-9
