"""Droop control: steady state, slope, equivalence with the virtual machine, freeze."""

from __future__ import annotations

from math import pi, sin

import numpy as np
import pytest

from dcvrt import Simulator, Waveform
from dcvrt.errors import ModelError
from dcvrt.models import Block, Diagram, Droop, Phasor, Vsm
from tests.models.sources import TIGHT, Constant, DqPower, Signal, play, steps

approx = pytest.approx
OMEGA_B = 2 * pi * 60.0


def at_rest(p: float = 0.9, q: float = 0.2, **changes: float) -> tuple[Droop, dict[str, object]]:
    droop = Droop(**changes)
    v = Phasor.polar(0.95, 0.7)
    values = dict(v=v, v_f=0.95, p_c=p, q_c=q, p_g=p, q_g=q, shortfall=-0.3, resync=0.0, trim=1.0)
    return droop, values | droop.rest(droop.at(**values))


def rates(droop: Droop, at: dict[str, object], **changes: object) -> dict[str, float]:
    return droop.equations(droop.at(**(at | changes))).der


def test_it_rests_where_its_current_draws_the_commanded_power():
    droop, at = at_rest()
    eq = droop.equations(droop.at(**at))
    # the smooth clip of E is off by eps^2/4 over its distance to the bounds, seen through 1/X_v
    slack = droop.eps**2 / 0.2 / droop.X_v
    assert complex(eq.out["v_dq"] * eq.out["i"].conj()) == approx(complex(0.9, 0.2), abs=slack)
    assert eq.out["omega"] == approx(1.0, abs=1e-6)
    assert eq.der == {
        "p_f": 0.0, "q_f": 0.0, "delta": approx(0.0, abs=OMEGA_B * 1e-6), "E_0": approx(0.0, abs=slack)
    }  # fmt: skip


def test_frequency_falls_with_the_power_that_is_missing():
    droop, at = at_rest()
    out = droop.equations(droop.at(**(at | dict(p_f=0.8)))).out
    assert out["omega"] == approx(1 - droop.m_p * 0.1, rel=1e-4)
    assert rates(droop, at, p_f=0.8)["delta"] == approx(-OMEGA_B * droop.m_p * 0.1, rel=1e-3)


def test_magnitude_rises_with_the_reactive_power_that_is_too_much():
    droop, at = at_rest()
    E = droop.equations(droop.at(**at)).out["E"]
    assert droop.equations(droop.at(**(at | dict(q_f=0.4)))).out["E"] == approx(E + 0.2 * droop.K_Q, rel=1e-5)


def test_measurements_are_lags():
    droop, at = at_rest()
    assert rates(droop, at, p_g=0.5)["p_f"] == approx((0.5 - 0.9) / droop.T_f)
    assert rates(droop, at, q_g=0.5)["q_f"] == approx((0.5 - 0.2) / droop.T_f)


def test_power_is_matched_only_where_the_command_cannot_be_met():
    droop, at = at_rest()
    slip = lambda **c: droop.equations(droop.at(**(at | c))).out["omega"] - 1  # noqa: E731
    assert slip(p_f=0.5, shortfall=-0.3) == approx(-0.4 * droop.m_p, rel=1e-3)
    assert slip(p_f=0.5, shortfall=0.3) == approx(0.0, abs=1e-5)
    assert slip(p_f=1.2, shortfall=0.3) == approx(0.3 * droop.m_p, rel=1e-3)
    assert slip(p_f=0.0, resync=1.0) == approx(0.0, abs=1e-12)


def test_it_turns_onto_the_grid_voltage_while_it_resynchronises():
    droop, at = at_rest()
    assert rates(droop, at, delta=0.2, resync=1.0)["delta"] == approx(droop.K_s * 0.95 * sin(0.5))


def test_frozen_it_stands_still_but_may_resynchronise():
    droop, at = at_rest()
    away = dict(p_g=0.3, q_g=0.4, p_f=0.7, q_f=0.1, free=0)
    assert rates(droop, at, **away) == {k: approx(0.0) for k in ("p_f", "q_f", "delta", "E_0")}
    assert rates(droop, at, **away, resync=1.0)["delta"] != 0.0


def grid(source: Block, power: float = 0.8, trim: float = 0.0) -> Diagram:
    """A grid-forming control straight on the grid, its current followed at once."""
    d = Diagram("straight")
    v = d.input("v_poi", "pu(V)", Phasor)
    d.add("source", source)
    meter, fixed = d.add("meter", DqPower()), d.add("fixed", Constant(value=power))
    off, on = d.add("off", Constant(value=0.0)), d.add("on", Constant(value=trim))
    d.connect(v, source.v)
    d.connect(source.i, meter.i)
    d.connect(source.v_dq, meter.v)
    d.connect(meter.p, source.p_g)
    d.connect(meter.q, source.q_g)
    d.connect(fixed.power, source.p_c)
    d.connect(off.power, source.q_c)
    d.connect(d.add("room", Constant(value=-1.0)).current, source.shortfall)
    d.connect(off.ratio, source.resync)
    d.connect(on.ratio, source.trim)
    if isinstance(source, Droop):
        signal = d.add("signal", Signal())
        d.connect(v, signal.v)
        d.connect(signal.volts, source.v_f)
    d.output("p", meter.p)
    d.output("delta", source.delta)
    d.output("E", source.E)
    return d


@pytest.mark.parametrize(("m_p", "T_f", "power"), [(0.033, 5e-3, 0.8), (0.05, 0.02, 0.3), (0.01, 0.05, 1.0)])
def test_it_has_the_eigenvalues_of_the_virtual_machine_that_it_is(m_p, T_f, power):
    """H_v = T_f/(2 m_p), D = 1/m_p: the swing of the one is the filtered droop of the other."""
    # nearly sharp blends: at the defaults the two roots are almost one, and so sensitive to everything
    common = dict(R_v=0.0, X_v=0.25, K_Q=0.0, eps=1e-5)
    found = []
    for source in (Droop(m_p=m_p, T_f=T_f, **common), Vsm(H_v=T_f / (2 * m_p), D=1 / m_p, **common)):
        dae = grid(source, power).compile()
        at = Simulator(dae, TIGHT).equilibrium(1.0)
        run = Simulator(dae, TIGHT)(steps((0.0, 1.0), until=0.01))
        found.append((dae.linearise(at).eigenvalues(), run))
    (droop, run), (machine, _) = found
    E, delta = run["E"][0], run["delta"][0]
    stiffness = E * np.cos(delta) / 0.25
    for root in np.roots([T_f / m_p, 1 / m_p, OMEGA_B * stiffness]):
        assert np.abs(droop - root).min() < 1e-6 * abs(root)
        assert np.abs(machine - root).min() < 1e-6 * abs(root)


def test_a_grid_at_another_frequency_draws_power_by_the_slope():
    """P = P_c + H (omega_grid - 1)/m_p; at nominal frequency P = P_c."""
    offset = 5e-4
    t = np.linspace(0.0, 1.5, 1501)
    angle = OMEGA_B * offset * np.where(t < 0.1, 0.0, t - 0.1)
    wave = Waveform.from_samples(t, np.exp(1j * angle), jumps=(0.1,))
    # the measured voltage of this bench is the real part: keep it from freezing
    run = play(grid(Droop(V_freeze=0.0, V_thaw=0.01)), wave)
    droop = Droop()
    assert run["p"][0] == approx(0.8, abs=1e-9)
    assert run["p"][-1] == approx(0.8 + offset / droop.m_p, abs=1e-6)


def test_it_freezes_and_thaws_at_its_two_voltages():
    """A straight line of the measured voltage, so that the times are known."""
    t = np.linspace(0.0, 0.3, 31)
    wave = Waveform.from_samples(t, np.interp(t, [0.0, 0.1, 0.2, 0.3], [1.0, 1.0, 0.6, 1.0]))
    run = play(grid(Droop()), wave)
    (down, first), (up, second) = [(e.time, e.target) for e in run.events]
    assert (first, second) == ("FROZEN", "FREE")
    signal = lambda time: abs(wave.at(time))  # noqa: E731
    assert signal(down) == approx(0.8, abs=1e-9)
    assert signal(up) == approx(0.85, abs=1e-9)
    held = (run.t > down) & (run.t < up)
    assert np.ptp(run["delta"][held]) < 1e-12


def test_the_thaw_is_above_the_freeze():
    with pytest.raises(ModelError, match=r"V_freeze = 0\.8, V_thaw = 0\.7"):
        grid(Droop(V_thaw=0.7)).compile()
