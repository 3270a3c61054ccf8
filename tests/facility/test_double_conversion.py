"""The double-conversion variants: rest, energy, limits, sensitivities, and what each is for."""

from __future__ import annotations

from collections.abc import Callable
from math import log

import casadi as ca
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from dcvrt import Criteria, Simulator, Waveform, facility, margins
from dcvrt.dae import Dae
from dcvrt.facility import double_conversion
from dcvrt.integrators import Casadi, Kernel
from dcvrt.models import (
    ActivePriorityLimiter,
    BessWithLosses,
    ContactorCooling,
    Diagram,
    ReactivePriorityLimiter,
    TrainingLoad,
)
from tests.facility.rides import FIXED
from tests.models.sources import TIGHT, Audit, walk

approx = pytest.approx
NAMES = tuple(name for name in facility.names() if "lim" in facility.get(name).blocks)
"""Every variant whose import passes a current limiter."""
BUILDERS: dict[str, Callable[[], Diagram]] = {name: facility.VARIANTS[name] for name in NAMES}


def with_losses() -> Diagram:
    f = double_conversion.gfl()
    f.replace("bess", BessWithLosses())
    f.set("dc.eta", 0.95)
    return f


def with_contactors() -> Diagram:
    f = double_conversion.gfl()
    f.replace("cooling", ContactorCooling(T_off=0.3, T_stage=0.2))
    f.connect(f.port("meter.v_f"), f.port("cooling.v"))
    return f


def with_drive_losses() -> Diagram:
    f = double_conversion.gfl_vfd_cooling()
    f.set("cooling.eta", 0.95)
    f.set("cooling.T_restart", 0.2)
    f.set("cooling.T_ramp", 0.5)
    return f


def with_training() -> Diagram:
    f = double_conversion.gfm()
    f.replace("it", TrainingLoad(cycle=0.4, T_cp=0.6, depth=0.3))
    return f


CHANGED: dict[str, Callable[[], Diagram]] = {
    "losses": with_losses,
    "contactors": with_contactors,
    "drive losses": with_drive_losses,
    "training": with_training,
}
EVERY = BUILDERS | CHANGED


def audited(f: Diagram) -> Diagram:
    """With the integral of what is neither served nor lost beside the ledger."""
    audit = f.add("audit", Audit())
    for port, name in ((audit.p_g, "p_g"), (audit.p_out, "p_out"), (audit.loss, "p_loss")):
        f.connect(f.port(".".join(f.outputs[name])), port)
    return f


@pytest.fixture(scope="module")
def daes() -> dict[str, Dae]:
    return {name: audited(build()).compile() for name, build in EVERY.items()}


@pytest.fixture(scope="module")
def simulators(daes) -> dict[str, Simulator]:
    return {name: Simulator(dae, save_at=2e-3) for name, dae in daes.items()}


def sag(retained: float, length: float = 0.15, until: float = 2.0) -> Waveform:
    return Waveform.sag(retained, 0.1, length, until)


def six_sags(spacing: float = 0.5) -> Waveform:
    levels = [(0.0, 1.0)]
    for k, retained in enumerate((0.40, 0.30, 0.35, 0.25, 0.40, 0.30)):
        levels += [(0.1 + k * spacing, retained), (0.155 + k * spacing, 1.0)]
    return Waveform.segments(levels, until=6 * spacing + 1.0)


SCENARIOS = {
    "sag": sag(0.65),
    "deep sag": sag(0.2, 0.2),
    "interruption": sag(0.0, 0.4),
    "swell": sag(1.2, 0.2),
    "six sags": six_sags(),
    "phase jump": Waveform.segments([(0.0, 1.0), (0.1, 0.6 * np.exp(0.4j)), (0.2, 1.0)], until=1.5),
}


@pytest.mark.parametrize("name", [name for name in CHANGED if name != "training"])
def test_a_flat_start_of_a_changed_variant_stays_flat(name, daes):
    run = Simulator(daes[name], Casadi("erk", 1e-11, 1e-12), save_at=0.05)(
        Waveform.segments([(0.0, 0.97 * np.exp(0.5j))], until=1.0)
    )
    assert run.events == ()
    for path in daes[name].x_names:
        assert np.ptp(run[path]) < 1e-8, path


# ---- energy ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", EVERY)
def test_the_ledger_closes_at_every_point_of_every_mode(name, daes):
    """d(stored)/dt = p_g - p_out - p_loss as functions, at random states, voltages, parameters, modes."""
    dae = daes[name]
    stored, p_g, p_out, p_loss = (dae.y[dae.y_names.index(k)] for k in ("stored", "p_g", "p_out", "p_loss"))
    gap = ca.jacobian(stored, dae.x) @ dae.f - (p_g - p_out - p_loss)
    residual = ca.Function("gap", [dae.x, dae.u, dae.p, dae.q, dae.clocks], [gap, p_g])
    rng = np.random.default_rng(1)
    start = np.array([row.value for row in dae.states])
    for _ in range(300):
        x = start + rng.uniform(-0.4, 0.4, len(start))
        flags = [a.flags[rng.integers(len(a.modes))] for a in dae.automata]
        u = np.append(rng.uniform(-1.2, 1.2, 2), rng.uniform(0.5, 1.2))
        p = dae.parameter_values(H=rng.uniform(0.5, 5.0))
        found, size = residual(x, u, p, np.concatenate(flags), rng.uniform(0, 0.5, len(flags)))
        assert abs(float(found)) < 1e-10 * (1 + abs(float(size)))


@pytest.mark.parametrize("scenario", SCENARIOS)
@pytest.mark.parametrize("name", EVERY)
def test_the_ledger_closes_over_every_scenario(name, scenario, simulators):
    run = simulators[name](SCENARIOS[scenario])
    change = run["stored"] - run["stored"][0]
    np.testing.assert_allclose(change, run["audit.net"], atol=1e-9 * abs(run["stored"]).max())
    assert run["p_loss"].min() >= 0.0
    # and by quadrature of the outputs, which knows nothing of the integrator; jumps stand twice in t
    net = run["p_g"] - run["p_out"] - run["p_loss"]
    assert change[-1] == approx(float(np.trapezoid(net, run.t)), abs=2e-4)


@pytest.mark.parametrize("name", ["losses", "drive losses"])
def test_losses_are_drawn_from_the_grid(name, simulators):
    run = simulators[name](Waveform.segments([(0.0, 1.0)], until=0.01))
    assert run["p_loss"][0] > 0.005
    assert run["p_g"][0] == approx(run["p_out"][0] + run["p_loss"][0], abs=1e-6)


# ---- size and sensitivities --------------------------------------------------------------------------------


@pytest.mark.parametrize("name", EVERY)
def test_everything_scales_with_the_hosted_capacity(name, daes):
    """Powers, currents and energies times h, all else the same."""
    dae = daes[name]
    f = ca.Function("f", [dae.x, dae.u, dae.p, dae.q, dae.clocks], [dae.f, dae.y])
    rng = np.random.default_rng(2)
    start = np.array([row.value for row in dae.states])
    of = lambda rows, h: np.array([h if r.unit in ("pu(S)", "pu(I)", "pu(S) s") else 1.0 for r in rows])  # noqa: E731
    for h in (0.02, 7.0, 40.0):
        x = start + rng.uniform(-0.2, 0.2, len(start))
        u = np.append(rng.uniform(-1.1, 1.1, 2), 1.1)
        q = np.concatenate([a.flags[rng.integers(len(a.modes))] for a in dae.automata])
        c = rng.uniform(0, 0.4, len(dae.automata))
        small = f(x, u, dae.parameter_values(H=1.0), q, c)
        big = f(x * of(dae.states, h), u, dae.parameter_values(H=h), q, c)
        for one, other, rows in zip(small, big, (dae.states, dae.outputs), strict=True):
            rounded = [r.path in ("i_g", "i_ups") for r in rows]  # at 0 by a fixed width
            np.testing.assert_allclose(
                np.array(other).ravel()[~np.array(rounded)],
                (np.array(one).ravel() * of(rows, h))[~np.array(rounded)],
                rtol=1e-9,
                atol=1e-9 * max(h, 1.0),
            )


THETAS = {
    "gfm-droop": ("beta", "droop.m_p", "droop.T_f", "dc.T_hold"),
    "gfl-vfd-cooling": ("beta", "cooling.T_dc", "cooling.K_r", "H"),
    "gfl-support": ("beta", "support.K", "d"),
    "losses": ("bess.R", "bess.eta_dis", "beta"),
}


@pytest.mark.parametrize("until", [0.155, 0.24, 0.6])
@pytest.mark.parametrize("name", THETAS)
def test_sensitivities_are_central_differences(name, until, sensitive):
    """At the end of runs through supervisor, freeze and thaw, or trip; event times too."""
    with_sens, plain, values = sensitive[name]
    levels = [(0.0, 1.0), (0.1, 0.6), (0.16, 0.9), (0.25, 1.0)]
    wave = Waveform.segments([level for level in levels if level[0] < until], until=until)
    run = with_sens(wave)
    assert run.events
    for theta in THETAS[name]:
        h = 1e-5 * values[theta]
        up, down = (plain(wave, **{theta: values[theta] + side * h}) for side in (1, -1))
        assert up.sequence == run.sequence == down.sequence
        for signal in ("p_g", "w_dc", "v_it", "p_b"):
            # per relative change of the parameter, so that all are in pu
            found = values[theta] * run.sens[signal, theta]
            expected = values[theta] * (up[signal][-1] - down[signal][-1]) / (2 * h)
            assert found[-1] == approx(expected, abs=1e-5 * np.abs(found).max() + 1e-7), (signal, theta)
        for event, late, early in zip(run.events, up.events, down.events, strict=True):
            expected = (late.time - early.time) / (2 * h)
            assert event.grad[theta] == approx(expected, rel=1e-4, abs=1e-7), (event.row, theta)


@pytest.fixture(scope="module")
def sensitive() -> dict[str, tuple[Simulator, Simulator, dict[str, float]]]:
    tight = Casadi("erk", 1e-11, 1e-13)
    found = {}
    for name, wrt in THETAS.items():
        dae = EVERY[name]().compile()
        values = dict(zip(dae.p_names, dae.parameter_values(), strict=True))
        found[name] = Simulator(dae, tight, wrt=wrt), Simulator(dae, tight), values
    return found


def test_some_event_times_do_depend_on_parameters(sensitive):
    """The trip of the drives does: without its jump term the test above would say nothing."""
    with_sens, _, values = sensitive["gfl-vfd-cooling"]
    run = with_sens(sag(0.0, until=0.3))
    trip = next(e for e in run.events if e.target == "TRIPPED")
    # the bus falls from w_0 at a constant rate: t = (w_0 - w_trip) T_dc
    assert trip.grad["cooling.T_dc"] == approx((trip.time - 0.1) / values["cooling.T_dc"], rel=1e-5)


# ---- properties --------------------------------------------------------------------------------------------

sags = st.tuples(st.floats(0.0, 1.25), st.floats(0.03, 0.4), st.floats(-0.5, 0.5))


def shaped(retained: float, length: float, jump: float, until: float = 1.0) -> Waveform:
    return Waveform.segments(
        [(0.0, 1.0), (0.1, retained * np.exp(1j * jump)), (0.1 + length, 1.0)], until=until
    )


@pytest.mark.parametrize("name", NAMES)
@settings(max_examples=15)
@given(sag=sags, beta=st.floats(1.05, 1.6))
def test_current_charge_and_link_stay_within_their_limits(name, sag, beta, simulators):
    run = simulators[name].attempt(shaped(*sag), beta=beta)
    assert (run["i_g"] / run["i_max"]).max() <= 1 + 1e-5
    assert run["soc"].min() >= 0.0
    assert run["soc"].max() <= 1.0
    # no export is ever asked for; when the voltage turns, the lag keeps the old current for a few tau_I
    exporting = (run["p_g"] < -1e-5).astype(float)
    assert np.trapezoid(exporting, run.t) < 2 * 5 * run.parameters["lag.tau"]
    if run.completed:
        assert run["w_dc"].min() >= 0.36
        assert run["w_dc"].max() <= 1.44


@settings(max_examples=25)
@given(sag=sags, beta=st.floats(1.05, 1.6))
def test_both_limiters_keep_the_rating_in_every_sag(sag, beta, both_limiters):
    for simulator in both_limiters:
        run = simulator.attempt(shaped(*sag), beta=beta)
        assert (run["i_g"] / run["i_max"]).max() <= 1 + 1e-5


@pytest.fixture(scope="module")
def both_limiters() -> tuple[Simulator, Simulator]:
    found = []
    for limiter in (ActivePriorityLimiter, ReactivePriorityLimiter):
        f = double_conversion.gfl_support()
        f.replace("lim", limiter())
        found.append(Simulator(f.compile(), save_at=2e-3))
    return found[0], found[1]


@settings(max_examples=15)
@given(retained=st.floats(0.5, 0.85), beta=st.floats(1.05, 1.5))
def test_priority_decides_between_import_and_support(retained, beta, both_limiters):
    """Late in a sag one of the two powers is what was asked for, the other what the rating leaves."""
    active, reactive = (s(Waveform.sag(retained, 0.1, 0.2, 0.29), beta=beta) for s in both_limiters)
    top = beta * retained
    tan = np.sqrt(1 / 0.98**2 - 1)
    support = retained * 2.0 * max(0.9 - retained, 0.0)

    def late(run, signal):
        return float(run[signal][-1])

    # active first: all the import that the rating carries, or all that is needed
    p = late(active, "p_g")
    assert p == approx(min(late(active, "p_out"), top), abs=0.04)
    assert abs(late(active, "q_g")) <= np.sqrt(max(top**2 - p**2, 0.0)) + 1e-3
    # reactive first: all of the support; the command of active power lies between what is got and the top
    q, p = late(reactive, "q_g"), late(reactive, "p_g")
    assert p * tan - support - 0.02 <= q <= top * tan - support + 0.02
    assert p <= np.sqrt(top**2 - q**2) + 1e-3


@pytest.mark.parametrize("name", [name for name in NAMES if name.startswith("gfl")])
@settings(max_examples=15)
@given(sag=sags, beta=st.floats(1.05, 1.5), more=st.floats(0.01, 0.4))
def test_a_larger_rating_never_worsens_the_loss_margin_of_a_grid_following_facility(
    name, sag, beta, more, simulators
):
    """While the event sequence is the same; to 0.2 % of the load, by which control answers differently."""
    small, large = (simulators[name].attempt(shaped(*sag), beta=b) for b in (beta, beta + more))
    assume(small.completed and large.completed)
    one, other = margins(small, Criteria()), margins(large, Criteria())
    assume(one.sequence == other.sequence)
    assert other.loss.value >= one.loss.value - 2e-3


@pytest.mark.parametrize("name", ["gfm", "gfm-droop"])
def test_a_larger_rating_can_worsen_the_loss_margin_of_a_grid_forming_facility(name, simulators):
    """In a phase jump the limit holds back the swing: more rating, more swing, at the same event sequence."""
    jump = shaped(0.98, 0.15, 0.43)
    small, large = (margins(simulators[name](jump, beta=beta), Criteria()) for beta in (1.05, 1.15))
    assert small.sequence == large.sequence
    assert large.loss.value < small.loss.value - 0.1


# ---- what each is for --------------------------------------------------------------------------------------


def test_support_with_no_gain_and_active_priority_is_the_plain_variant():
    f = double_conversion.gfl_support()
    f.replace("lim", ActivePriorityLimiter())
    f.set("support.K", 0.0)
    wave = sag(0.6)
    one, other = (Simulator(g.compile(), TIGHT)(wave) for g in (f, double_conversion.gfl()))
    for signal in FIXED:
        np.testing.assert_allclose(one[signal], other[signal], rtol=1e-9, atol=1e-9, err_msg=signal)


def test_support_injects_reactive_power_in_a_sag_and_costs_import(simulators):
    wave = Waveform.sag(0.7, 0.1, 0.2, 0.29)
    plain, support = (simulators[n](wave) for n in ("gfl", "gfl-support"))
    assert plain["q_g"][-1] > 0
    assert support["q_g"][-1] < -0.05
    assert support["p_g"][-1] < plain["p_g"][-1] + 1e-3


def test_droop_freezes_when_the_measured_voltage_falls(simulators):
    """V_f = V + (1 - V) exp(-t/T_m) reaches 0.8 at T_m ln((1 - V)/(0.8 - V))."""
    retained, T_m = 0.5, 5e-3
    run = simulators["gfm-droop"](sag(retained))
    (frozen, first), (free, second) = walk(run, "droop")
    assert (first, second) == ("FROZEN", "FREE")
    assert frozen == approx(0.1 + T_m * log((1 - retained) / (0.8 - retained)), abs=1e-6)
    assert free == approx(0.25 + T_m * log((1 - retained) / (1 - 0.85)), abs=1e-5)
    held = (run.t > frozen) & (run.t < free)
    assert np.ptp(run["droop.delta"][held]) < 1e-12


def test_droop_is_the_virtual_machine_while_the_command_stands_still():
    """H_v = T_f/(2 m_p), D = 1/m_p; DC loop nearly off, since the filter of the droop is on P_g alone."""
    wave = Waveform.segments([(0.0, 1.0), (0.1, 0.97)], until=0.5)
    slow = {"dc_loop.K_p": 0.01, "dc_loop.K_i": 0.01}
    droop = Simulator(double_conversion.gfm_droop().compile(), TIGHT)(wave, **slow, **{"droop.K_Q": 0.0})
    same = {"vsm.H_v": 5e-3 / (2 * 0.033), "vsm.D": 1 / 0.033, "vsm.K_Q": 0.0, "vsm.tau_E": 1e-3}
    machine = Simulator(double_conversion.gfm().compile(), TIGHT)(wave, **slow, **same)
    assert np.ptp(droop["p_g"]) > 0.03
    np.testing.assert_allclose(droop["p_g"], machine["p_g"], atol=1e-4)


def test_drives_trip_where_the_servers_ride_through(simulators):
    run, gfl = (simulators[n](Waveform.sag(0.7, 0.1, 0.15, 20.0)) for n in ("gfl-vfd-cooling", "gfl"))
    times, modes = zip(*walk(run, "cooling"), strict=True)
    assert modes == ("TRIPPED", "RAMP", "RUN")
    assert times[2] - times[1] == approx(10.0, abs=1e-9)
    assert run["v_it"].min() == approx(gfl["v_it"].min(), abs=1e-3)
    assert run["p_it"].min() == approx(run["p_it"][0], abs=1e-6)
    cooling = run["p_cool"][0]
    waiting = (run.t > 1.0) & (run.t < times[1])
    assert run["p_g"][waiting] == approx(run["p_g"][0] - cooling, abs=5e-3)
    assert gfl["p_g"][np.searchsorted(gfl.t, 3.0)] == approx(gfl["p_g"][0], abs=2e-3)
    assert run["p_g"][-1] == approx(run["p_g"][0], abs=2e-3)
    assert run["p_load"] == approx(run["p_load"][0])


def test_the_site_draws_what_ups_and_drives_draw(simulators):
    run = simulators["gfl-vfd-cooling"](sag(0.65))
    drive = run["p_g"] - run["p_ups"]
    late = run.t > 1.9
    assert drive[0] == approx(run["p_cool"][0], abs=1e-6)
    assert np.abs(drive[late]).max() < 1e-3  # tripped
    v = np.array([0.65 if 0.1 < t < 0.25 else 1.0 for t in run.t])
    inside = (np.abs(run.t - 0.1) > 1e-9) & (np.abs(run.t - 0.25) > 1e-9)
    np.testing.assert_allclose(np.hypot(run["p_g"], run["q_g"])[inside], (v * run["i_g"])[inside], rtol=1e-6)


def test_contactors_on_the_grid_lose_their_load_in_stages(simulators):
    run = simulators["contactors"](sag(0.4))
    assert [m for _, m in walk(run, "cooling")] == ["OUT", "STAGE_1", "STAGE_2", "RUNNING"]
    levels = np.unique(np.round(run["p_cool"] / run["p_cool"][0], 6))
    np.testing.assert_allclose(levels, [0.0, 1 / 3, 2 / 3, 1.0], atol=1e-6)


COUNTED = Waveform.segments(
    [(0.0, 1.0), *(pair for k in range(4) for pair in ((0.1 + 2 * k, 0.7), (0.16 + 2 * k, 1.0)))], until=9.0
)


def test_the_third_sag_locks_out_for_good(simulators):
    run = simulators["gfl-sag-counter"](COUNTED)
    plain = simulators["gfl"](COUNTED)
    assert {m for _, m in walk(plain, "sup")} == {"MIXED", "NORMAL"}
    time, mode = walk(run, "sup")[-1]
    assert mode == "BATTERY"
    assert walk(run, "counter")[-1] == (time, "LOCKED")
    assert 4.1 < time < 4.11
    assert np.abs(run["p_g"][run.t > time + 0.1]).max() < 1e-3
    assert run["v_it"].min() > 0.9


def test_a_lock_out_ends_after_its_healthy_time(simulators):
    run = simulators["gfl-sag-counter"](COUNTED, **{"counter.T_reset": 1.0})
    times = {m: t for t, m in walk(run, "sup")}
    opened = next(t for t, m in walk(run, "counter") if m == "READY" and t > 4.2)
    assert opened == approx(5.16 + 0.0, abs=0.02)
    returned = next(t for t, m in walk(run, "sup") if m == "RETURN")
    assert returned == approx(opened + 0.4, abs=1e-6)
    assert times["NORMAL"] > returned


def test_two_sags_or_no_counting_leave_the_plain_variant(daes):
    """At 1e-8: the two systems do not take the same steps."""
    plain, counting = (
        Simulator(daes[n], Kernel(rtol=1e-8, atol=1e-10), save_at=2e-3) for n in ("gfl", "gfl-sag-counter")
    )
    two = Waveform.segments([(0.0, 1.0), (0.1, 0.7), (0.16, 1.0), (2.1, 0.7), (2.16, 1.0)], until=4.0)
    for wave, n in ((two, 3.0), (COUNTED, 0.0)):
        run = counting(wave, **{"counter.N": n})
        assert walk(run, "sup") == [(approx(t, abs=1e-9), m) for t, m in walk(plain(wave), "sup")]
        assert run["p_g"][-1] == approx(plain(wave)["p_g"][-1], abs=1e-6)


def test_a_slow_battery_lets_the_link_collapse(simulators):
    wave = sag(0.0, 0.3, until=0.5)
    assert simulators["losses"](wave).completed
    slow = simulators["losses"].attempt(wave, **{"bess.R": 5.0})
    assert "link collapsed" in slow.status
