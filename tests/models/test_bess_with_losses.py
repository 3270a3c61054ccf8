"""Battery with losses: efficiency both ways, ramp, and the block without losses as its limit."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dcvrt import Simulator
from dcvrt.models import Bess, BessWithLosses
from tests.models.sources import TIGHT, bench, play, steps

approx = pytest.approx
AT = dict(w=1.0, drain=0.9, p_g=0.9, assist=0.0, charge=1.0, p=0.0, soc=0.8)


def rates(**changes: float) -> tuple[BessWithLosses, object]:
    own = {k: v for k, v in changes.items() if k not in AT}
    bess = BessWithLosses(**own)
    return bess, bess.equations(bess.at(**(AT | {k: v for k, v in changes.items() if k in AT})))


def test_it_rests_without_loss():
    _, eq = rates(eps=1e-6)
    assert eq.der == {"p": approx(0.0, abs=1e-6), "soc": 0.0}
    assert eq.out["loss"] == 0.0


def test_losses_are_those_of_the_efficiencies():
    bess, eq = rates(p=0.9, eps=1e-6)
    assert eq.out["loss"] == approx(0.9 * (1 / 0.96 - 1))
    assert eq.der["soc"] == approx(-0.9 / 0.96 / bess.T_E)
    bess, eq = rates(p=-0.1, eps=1e-6)
    assert eq.out["loss"] == approx(0.1 * 0.04)
    assert eq.der["soc"] == approx(0.1 * 0.96 / bess.T_E)


@given(st.floats(-0.1, 1.2), st.floats(0.5, 1.0), st.floats(0.5, 1.0))
def test_losses_are_never_negative_and_the_energy_is_accounted_for(p, dis, ch):
    bess, eq = rates(p=p, eta_dis=dis, eta_ch=ch)
    assert eq.out["loss"] >= 0.0
    assert eq.der["soc"] * bess.T_E == approx(-p - eq.out["loss"], abs=1e-12)


@given(st.floats(0.5, 1.5), st.floats(0.0, 1.0), st.floats(0.0, 1.2), st.floats(0.05, 0.97),
       st.sampled_from([0.0, 1.0]))  # fmt: skip
def test_without_losses_and_with_a_fast_ramp_it_is_the_plain_battery(w, p_g, p, soc, flag):
    at = dict(w=w, drain=0.9, p_g=p_g, assist=flag, charge=1 - flag, p=p, soc=soc)
    plain, other = Bess(), BessWithLosses(eta_dis=1.0, eta_ch=1.0, R=1e4)
    one, two = plain.equations(plain.at(**at)), other.equations(other.at(**at))
    assert two.der["soc"] == one.der["soc"]
    assert two.der["p"] == approx(one.der["p"], rel=1e-4, abs=1e-2)
    assert two.out == one.out


@given(st.floats(0.0, 2.0), st.floats(0.0, 1.0), st.floats(-0.1, 1.2), st.floats(0.01, 1e3))
def test_power_never_changes_faster_than_its_limit(w, p_g, p, R):
    _, eq = rates(w=w, p_g=p_g, p=p, assist=1.0, R=R)
    assert abs(eq.der["p"]) <= R + 1e-11  # round-off of the rate that is cut, up to 200 1/s


def test_power_ramps_along_its_limit():
    """A step of the mismatch by 0.8: the ramp takes 0.8/R, then the lag closes in."""
    R, step = 5.0, 0.8
    bess = BessWithLosses(R=R, eps=1e-6)
    wires = dict(w=1.0, drain="power", p_g=0.1, assist=1.0, charge=0.0)
    run = play(bench(bess, wires, ("p",)), steps((0.0, 0.1), (0.1, 0.1 + step), until=0.5))
    lag = bess.T_b
    ramp = (run.t > 0.1) & (run.t < 0.1 + step / R - lag)
    np.testing.assert_allclose(run["p"][ramp], R * (run.t[ramp] - 0.1), atol=1e-5)
    assert run["p"][-1] == approx(step, abs=1e-4)


def test_a_round_trip_returns_the_product_of_the_efficiencies():
    """Energy at the link out over in, between two times of the same charge."""
    bess = BessWithLosses(T_E=10.0, eta_dis=0.9, eta_ch=0.8, P_ch=1.0, T_b=1e-3, eps=1e-6)
    wires = dict(w=1.0, drain="power", p_g=0.5, assist=1.0, charge=0.0)
    wave = steps((0.0, 0.5), (0.1, 1.0), (1.1, 0.0), until=4.0)
    run = Simulator(bench(bess, wires, ("p", "soc", "energy")).compile(), TIGHT, save_at=1e-3)(wave)
    back = np.flatnonzero((run.t > 1.2) & (run["soc"] >= 0.8))[0]
    p, t = run["p"][: back + 1], run.t[: back + 1]
    out, into = (float(np.trapezoid(np.maximum(side * p, 0.0), t)) for side in (1, -1))
    assert out / into == approx(0.9 * 0.8, rel=2e-3)
    assert run["energy"] == approx(10.0 * run["soc"])
