"""What holds for every variant whose servers meet the grid's own voltage: names, rest, balance, scaling."""

from __future__ import annotations

import numpy as np
import pytest

from dcvrt import Criteria, Waveform, facility, margins
from dcvrt.models import Phasor
from tests.facility.rides import FIXED, SHORT, ride, sag, simulator, six_sags

VARIANTS = ("line-interactive", "eco-mode", "no-ups")
WAVES = {
    "shallow": sag(0.85),
    "deep": sag(0.2),
    "interruption": sag(0.0, 0.3),
    "swell": sag(1.2),
    "phase jump": Waveform.segments([(0.0, 1.0), (0.1, 0.7 * np.exp(0.35j)), (0.2, 1.0)], until=2.0),
    "six sags": six_sags(),
}
CASES = [(name, wave) for name in VARIANTS for wave in WAVES]


@pytest.fixture(scope="module")
def rides():
    return {(name, wave): ride(name, WAVES[wave]) for name, wave in CASES}


@pytest.mark.parametrize("name", VARIANTS)
def test_the_shared_parameters_come_first(name):
    dae = facility.get(name).compile()
    assert dae.p_names[:6] == ("H", "beta", "d", "pf", "PUE", "cooling_share")
    assert dae.z.numel() == 0


@pytest.mark.parametrize("name", VARIANTS)
def test_at_rest_the_facility_imports_its_demand_at_its_power_factor(name):
    run = simulator(name)(Waveform.segments([(0.0, 0.98)], until=0.1))
    start = {signal: run[signal][0] for signal in FIXED}
    assert start["p_g"] == pytest.approx(0.95, abs=1e-5)
    assert start["p_load"] == pytest.approx(0.95)
    assert start["p_out"] == pytest.approx(0.95, abs=1e-5)
    assert start["p_it"] == pytest.approx(0.95 / 1.3)
    assert start["p_cool"] == pytest.approx(0.95 * (1 - 1 / 1.3) * 0.74, abs=1e-5)
    assert start["q_g"] == pytest.approx(0.95 * np.sqrt(1 / 0.98**2 - 1), abs=1e-4)
    assert start["i_g"] == pytest.approx(0.95 / 0.98 / 0.98, abs=1e-4)
    assert (start["p_b"], start["p_loss"]) == pytest.approx((0, 0), abs=1e-9)
    assert start["w_dc"] == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize("case", CASES, ids=str)
def test_the_energy_balance_closes(rides, case):
    """d(stored)/dt = p_g - p_out - p_loss through every mode: integrated beside the facility."""
    run = rides[case]
    assert run.completed
    np.testing.assert_allclose(run["stored"] - run["stored"][0], run["net"], atol=1e-6)


@pytest.mark.parametrize("name", ["line-interactive", "eco-mode"])
def test_the_energy_balance_closes_with_losses(name):
    run = ride(name, WAVES["deep"], **{"battery.eta": 0.93})
    assert run["p_loss"].max() > 0.05
    np.testing.assert_allclose(run["stored"] - run["stored"][0], run["net"], atol=1e-6)


@pytest.mark.parametrize("case", CASES, ids=str)
def test_apparent_power_is_voltage_times_current(rides, case):
    run, wave = rides[case], WAVES[case[1]]
    inside = np.abs(np.subtract.outer(run.t, wave.jumps)).min(axis=1) > 1e-9
    apparent = np.hypot(run["p_g"], run["q_g"])[inside]
    assert apparent == pytest.approx((np.abs(wave.at(run.t)) * run["i_g"])[inside], abs=3e-6)


@pytest.mark.parametrize("case", CASES, ids=str)
def test_every_ride_ends_as_it_began(rides, case):
    """The timers are short: by the end the load is back and on the grid, the battery recharging."""
    run = rides[case]
    assert run["p_it"][-1] == pytest.approx(run["p_it"][0], rel=1e-9)
    assert run["mode"][-1] == 0
    assert run["p_g"][-1] + run["p_b"][-1] == pytest.approx(run["p_g"][0], abs=1e-3)
    assert run["w_dc"][-1] == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("name", VARIANTS)
@pytest.mark.parametrize("h", [0.02, 40.0])
def test_everything_scales_with_the_hosted_capacity(rides, name, h):
    run, base = ride(name, WAVES["deep"], H=h), rides[name, "deep"]
    assert [(e.automaton, e.target) for e in run.events] == [(e.automaton, e.target) for e in base.events]
    assert [e.time for e in run.events] == pytest.approx([e.time for e in base.events], abs=1e-7)
    units = {row.path: row.unit for row in simulator(name).dae.outputs}
    at = np.linspace(0.0, 1.99, 77)
    for signal in FIXED:
        scale = h if units[signal].startswith(("pu(S)", "pu(I)")) else 1.0
        rounding = 1e-6 / h if signal == "i_g" else 0.0  # |i| is rounded at 0 by a fixed width
        assert run.at(signal, at) / scale == pytest.approx(base.at(signal, at), abs=2e-6 + rounding), signal


@pytest.mark.parametrize("name", VARIANTS)
def test_margins_can_be_taken(rides, name):
    m = margins(rides[name, "deep"], Criteria(v_it_min=0.85, window=0.02, loss_share=0.25, loss_window=0.04))
    assert m.loss.value < 0  # every one of them leaves the grid in a deep sag
    assert (m.voltage.value > 0) == (name != "no-ups")


def test_only_the_battery_and_the_supplies_store():
    f = facility.get("line-interactive")
    assert f.port("battery.energy").declared.unit == "pu(S) s"
    run = ride("line-interactive", WAVES["shallow"])
    stored = 270.0 * run["soc"] + 0.010 / 0.41 / 1.3 * run["w_dc"]
    np.testing.assert_allclose(run["stored"], stored, rtol=1e-12)


@pytest.mark.parametrize("name", VARIANTS)
def test_nothing_breaks_without_voltage(name):
    """Derivatives at V = 0 are finite in every mode."""
    import casadi as ca

    dae = facility.get(name).compile()
    jacobian = ca.Function("J", [dae.x, dae.u, dae.p, dae.q, dae.clocks], [ca.jacobian(dae.f, dae.x), dae.f])
    rng = np.random.default_rng(3)
    for _ in range(20):
        flags = np.concatenate([a.flags[rng.integers(len(a.modes))] for a in dae.automata])
        x = np.array([row.value for row in dae.states]) + 0.1 * rng.standard_normal(len(dae.states))
        for u in ([0.0, 0.0, 1.0], [1e-6, -1e-6, 1.0], [1.3, 0.4, 0.5]):
            values = jacobian(x, u, dae.parameter_values(), flags, np.full(len(dae.automata), 0.1))
            assert all(np.isfinite(np.array(v)).all() for v in values)


def test_short_timers_are_parameters_of_the_variants():
    for name, changes in SHORT.items():
        assert set(changes) <= set(facility.get(name).compile().p_names)


def test_the_phasor_input_may_turn():
    """A facility on a turned network frame does the same: no angle is special."""
    for name in VARIANTS:
        turn = complex(Phasor.polar(1.0, 1.1))
        wave = Waveform.segments([(0.0, turn), (0.1, 0.6 * turn), (0.25, turn)], until=1.5)
        turned, plain = ride(name, wave), ride(name, sag(0.6, 0.15, 1.5))
        assert [e.time for e in turned.events] == pytest.approx([e.time for e in plain.events], abs=1e-7)
        assert turned["p_g"][-1] == pytest.approx(plain["p_g"][-1], abs=1e-7)
