"""Hybrid semantics: which row fires when, and what its time depends on - all in closed form.

(g), the hysteresis that is checked when a table is built or its limits are set, is tested with the tables of
the kit; several automata wired from blocks are in test_automata.py.
"""

from __future__ import annotations

from math import log, sqrt

import casadi as ca
import numpy as np
import pytest

from dcvrt.dae import Dae
from dcvrt.errors import SimulationError
from dcvrt.integrators import Casadi, Kernel, Simulator, find_compiler, simulator
from dcvrt.waveform import Waveform
from tests.integrators.systems import Sketch, ball, decay, flat, go, store

TIGHT = 1e-10, 1e-12
SOLVERS = [Kernel("dp5", *TIGHT), *(Casadi(p, *TIGHT) for p in ("erk", "rosenbrock", "cvodes"))]  # type: ignore[arg-type]
BACKENDS = {"kernel": Kernel("dp5", *TIGHT), "casadi": Casadi("erk", *TIGHT)}


def name(solver: Casadi | Kernel) -> str:
    return solver.plugin if isinstance(solver, Casadi) else f"kernel {solver.method}"


@pytest.fixture(params=["kernel", "casadi"], autouse=True)
def tight(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Casadi | Kernel:
    """Every test runs on both backends: the default one is set, the tight one is handed out."""
    if request.param == "kernel" and find_compiler() is None:
        pytest.skip("no C compiler here")
    monkeypatch.setattr(simulator, "KERNEL_BY_DEFAULT", request.param == "kernel")
    return BACKENDS[request.param]


def timer(guard_level: float = 0.9, held: object = 0.1, **extra: float) -> tuple[Sketch, list]:
    """idle -> fired after the voltage was below a level for `held`; x counts the time spent in `fired`."""
    s = Sketch({"x": 0.0}, {"T": 0.1, **extra})
    q, _, rows = s.automaton("sup", {"idle": (0.0,), "fired": (1.0,)}, "idle")
    s.q = q  # type: ignore[attr-defined]
    rows.append(go("idle", "fired", guard_level - s.v[0], s.p["T"] if held is None else held))
    return s, rows


def finish(s: Sketch) -> Dae:
    return s.dae({"x": s.q[0]}, {"x_out": s.x["x"]})  # type: ignore[attr-defined]


# -- (a) order ----------------------------------------------------------------------------------------------


def test_first_due_row_wins_and_the_tie_is_told() -> None:
    s = Sketch({"x": 0.0}, {"T": 0.1})
    _, _, rows = s.automaton("sup", {"a": (0.0,), "b": (1.0,), "c": (2.0,)}, "a")
    rows += [go("a", "b", 0.9 - s.v[0]), go("a", "c", 0.95 - s.v[0])]
    run = Simulator(s.dae({"x": 0.0}, {}))(Waveform.sag(0.5, 0.2, 0.1, until=0.5))
    (event,) = run.events
    assert (event.target, event.tie) == ("b", ("a -> c",))
    assert event.time == 0.2


def test_guards_that_cross_at_one_instant_on_a_ramp_are_a_tie() -> None:
    s = Sketch({"x": 0.0}, {"T": 0.1})
    _, _, rows = s.automaton("sup", {"a": (0.0,), "b": (1.0,), "c": (2.0,)}, "a")
    rows += [go("a", "b", 0.75 - s.v[0]), go("a", "c", 1.5 - 2 * s.v[0])]
    run = Simulator(s.dae({"x": 0.0}, {}))(
        Waveform.segments([(0.0, 1.0), (0.2, 1.0, 0.5), (0.4, 0.5)], until=0.6)
    )
    (event,) = run.events
    assert (event.target, event.tie) == ("b", ("a -> c",))
    assert event.time == pytest.approx(0.3, abs=1e-12)


# -- (b) held -----------------------------------------------------------------------------------------------


def test_held_counts_from_the_guard() -> None:
    s, _ = timer()
    run = Simulator(finish(s))(Waveform.sag(0.5, 0.2, 0.3, until=1.0))
    assert [e.time for e in run.events] == [pytest.approx(0.3, abs=1e-12)]
    assert run["x_out"][-1] == pytest.approx(0.7, abs=1e-9)


def test_held_restarts_when_the_guard_lapses() -> None:
    s, _ = timer()
    dips = Waveform.segments([(0.0, 1.0), (0.1, 0.5), (0.18, 1.0), (0.2, 0.5), (0.4, 1.0)], until=0.6)
    assert [e.time for e in Simulator(finish(s))(dips).events] == [pytest.approx(0.3, abs=1e-12)]


@pytest.mark.parametrize("begin", [0.1, 0.2, 0.3, 0.7])
@pytest.mark.parametrize("off", [0.0, -2e-16, 2e-16, -5e-10, 5e-10])
def test_a_timer_that_runs_out_as_the_input_jumps_back_fires(
    begin: float, off: float, tight: Casadi | Kernel
) -> None:
    """At one instant the timer is first, however round-off orders the sums of the times."""
    s, _ = timer(held=None)
    wave = Waveform.sag(0.5, begin, 0.1, until=begin + 0.3)
    run = Simulator(finish(s), tight, wrt=("T",))(wave, T=0.1 + off)
    (event,) = run.events
    assert event.time == pytest.approx(begin + 0.1, abs=1e-9)
    assert event.grad["T"] == pytest.approx(1.0, abs=1e-12)
    assert run.sens["x_out", "T"][-1] == pytest.approx(-1.0, abs=1e-9)
    late = Simulator(finish(s), tight)(wave, T=0.1 + 3e-9)
    assert late.events == ()


def test_held_counts_from_mode_entry_when_the_guard_was_true_before() -> None:
    s = Sketch({"x": 0.0}, {"T": 0.1})
    _, _, rows = s.automaton("sup", {"a": (0.0,), "b": (0.0,), "c": (0.0,)}, "a")
    rows += [go("a", "b", s.t - 0.35), go("b", "c", 0.9 - s.v[0], 0.1)]
    run = Simulator(s.dae({"x": 0.0}, {}))(Waveform.sag(0.5, 0.2, 0.5, until=1.0))
    assert [(e.target, e.time) for e in run.events] == [
        ("b", pytest.approx(0.35)),
        ("c", pytest.approx(0.45)),
    ]


def test_held_starts_and_lapses_between_samples_on_a_ramp() -> None:
    s, _ = timer(held=0.05)
    # below 0.9 from 0.1 + 0.02 until 0.2 - 0.02, and for less than 0.05 s in the second, shallower dip
    v = Waveform.segments(
        [
            (0.0, 1.0),
            (0.1, 1.0, 0.75),
            (0.15, 0.75, 1.0),
            (0.2, 1.0),
            (0.3, 1.0, 0.85),
            (0.35, 0.85, 1.0),
            (0.4, 1.0),
        ],
        until=0.6,
    )
    (event,) = Simulator(finish(s), save_at=7e-3)(v).events
    assert event.time == pytest.approx(0.12 + 0.05, abs=1e-11)


def test_time_of_a_timer_depends_on_held_and_on_the_time_it_started(tight: Casadi | Kernel) -> None:
    s = Sketch({"x": 0.0}, {"T": 0.1, "w": 2.0, "E": 0.5})
    q, _, rows = s.automaton("sup", {"idle": (1.0,), "fired": (0.0,)}, "idle")
    rows.append(go("idle", "fired", s.x["x"] - s.p["E"], s.p["T"]))
    dae = s.dae({"x": q[0] * s.p["w"]}, {"x_out": s.x["x"]})
    run = Simulator(dae, tight, wrt=("T", "w", "E"), start="given")(flat())
    (event,) = run.events  # E / w + T
    assert event.time == pytest.approx(0.35, abs=1e-12)
    assert event.grad == pytest.approx({"T": 1.0, "w": -0.125, "E": 0.5}, abs=1e-9)
    # x stops at E + w T
    assert [run.sens["x_out", n][-1] for n in ("T", "w", "E")] == pytest.approx([2.0, 0.1, 1.0], abs=1e-8)


# -- (c) strict, (d) clock, (e) continuous ------------------------------------------------------------------


def test_a_guard_that_only_touches_zero_does_not_fire() -> None:
    s, _ = timer(guard_level=0.5, held=0.0)
    assert not Simulator(finish(s))(Waveform.sag(0.5, 0.2, 0.3, until=1.0)).events


def test_a_dip_between_two_samples_is_not_stepped_over() -> None:
    s, _ = timer(guard_level=0.91, held=0.0)
    v = Waveform.from_samples([0.0, 0.101, 0.105, 0.109, 0.2], [1.0, 1.0, 0.9, 1.0, 1.0])
    (event,) = Simulator(finish(s), save_at=0.05)(v).events
    assert 0.101 < event.time < 0.105
    assert v.at(event.time).real == pytest.approx(0.91, abs=1e-10)


def test_clock_starts_at_zero_in_each_mode(tight: Casadi | Kernel) -> None:
    s = Sketch({"x": 0.0}, {"T": 0.3})
    _, clock, rows = s.automaton("sup", {"a": (0.0,), "b": (0.0,)}, "a")
    rows += [go("a", "b", 1.0, s.p["T"]), go("b", "a", 1.0, s.p["T"])]
    run = Simulator(s.dae({"x": clock}, {"x_out": s.x["x"]}), tight, wrt=("T",), start="given")(flat())
    assert [e.time for e in run.events] == pytest.approx([0.3, 0.6, 0.9], abs=1e-12)
    assert run["x_out"][-1] == pytest.approx((3 * 0.3**2 + 0.1**2) / 2, abs=1e-11)
    # d/dT of 3 T^2/2 + (1 - 3 T)^2/2
    assert run.sens["x_out", "T"][-1] == pytest.approx(3 * 0.3 - 3 * 0.1, abs=1e-9)


def test_states_are_continuous_unless_reset() -> None:
    run = Simulator(ball(), start="given")(flat(0.6))
    k = run.breaks[0]
    assert run["h"][k + 1] == run["h"][k]
    assert run["w"][k + 1] == pytest.approx(-0.8 * run["w"][k])


# -- (f) chatter --------------------------------------------------------------------------------------------


def test_more_than_fifty_jumps_at_one_instant_name_the_modes() -> None:
    s = Sketch({"x": 0.0}, {"T": 0.1})
    _, _, rows = s.automaton("sup", {"a": (0.0,), "b": (0.0,)}, "a")
    rows += [go("a", "b", 0.9 - s.v[0]), go("b", "a", 0.9 - s.v[0])]
    with pytest.raises(SimulationError) as error:
        Simulator(s.dae({"x": 0.0}, {}))(Waveform.sag(0.5, 0.2, 0.1, until=0.5))
    assert str(error.value) == (
        "sketch on sag to 0.5 pu for 100 ms: more than 50 jumps at 0.2 s between sup: a -> b, sup: b -> a: "
        "the guards of these modes are true together; give them hysteresis or a dwell time (held)"
    )


def test_a_ball_that_bounces_faster_and_faster_ends_in_the_same_error() -> None:
    with pytest.raises(
        SimulationError, match=r"more than 50 jumps at 4\.06.* s between ball: falling -> falling"
    ):
        Simulator(ball(), start="given")(flat(5.0))  # at rest after t1 (1 + 2 e/(1 - e)) = 4.0637 s


# -- several automata, cascades -----------------------------------------------------------------------------


def test_two_automata_run_side_by_side_and_may_start_each_other() -> None:
    s = Sketch({"x": 0.0}, {"T": 0.1})
    q1, _, first = s.automaton("one", {"off": (0.0,), "on": (1.0,)}, "off")
    q2, _, second = s.automaton("two", {"off": (0.0,), "on": (1.0,)}, "off")
    first.append(go("off", "on", 0.9 - s.v[0], 0.05))
    second.append(go("off", "on", q1[0] - 0.5))
    run = Simulator(s.dae({"x": q1[0] + q2[0]}, {"x_out": s.x["x"]}))(Waveform.sag(0.5, 0.2, 0.3, until=0.5))
    assert [(e.automaton, e.time) for e in run.events] == [
        ("one", pytest.approx(0.25)),
        ("two", pytest.approx(0.25)),
    ]
    assert run["x_out"][-1] == pytest.approx(0.5, abs=1e-9)
    assert (np.diff(run.t) == 0).sum() == 2  # the input jump at 0.2 s and one break for both events


def test_a_time_stands_at_most_twice() -> None:
    s = Sketch({"x": 0.0}, {"T": 0.1})
    q, _, rows = s.automaton("sup", {"a": (0.0,), "b": (0.0,), "c": (1.0,)}, "a")
    rows += [go("a", "b", 0.9 - s.v[0]), go("b", "c", 0.8 - s.v[0])]
    run = Simulator(s.dae({"x": q[0]}, {"x_out": s.x["x"]}), wrt=("T",))(
        Waveform.sag(0.5, 0.2, 0.1, until=0.5)
    )
    assert [e.target for e in run.events] == ["b", "c"]
    assert np.unique(run.t, return_counts=True)[1].max() == 2
    assert len(run.breaks) == len(run.break_grad) == 2


# -- (h) times and sensitivities in closed form
# ---------------------------------------------------------------


@pytest.mark.parametrize("solver", SOLVERS, ids=name)
def test_bouncing_ball(solver: Casadi) -> None:
    g, e, h0 = 9.81, 0.8, 1.0
    run = Simulator(ball(), solver, wrt=("g", "e", "h0"), start="given")(flat(2.0))
    t1 = sqrt(2 * h0 / g)
    times = [t1, t1 * (1 + 2 * e), t1 * (1 + 2 * e + 2 * e**2)]
    assert [event.time for event in run.events] == pytest.approx(times, abs=2e-9)
    slopes = {"g": -times[2] / (2 * g), "e": t1 * (2 + 4 * e), "h0": times[2] / (2 * h0)}
    assert run.events[2].grad == pytest.approx(slopes, rel=1e-7)

    def height(g: float, e: float, h0: float, t: float = 2.0) -> float:
        t1 = sqrt(2 * h0 / g)
        s = t - t1 * (1 + 2 * e + 2 * e**2)
        return e**3 * g * t1 * s - g * s * s / 2

    assert run["height"][-1] == pytest.approx(height(g, e, h0), abs=1e-7)
    for name, up, down in (
        ("g", height(g + 1e-6, e, h0), height(g - 1e-6, e, h0)),
        ("e", height(g, e + 1e-6, h0), height(g, e - 1e-6, h0)),
        ("h0", height(g, e, h0 + 1e-6), height(g, e, h0 - 1e-6)),
    ):
        assert run.sens["height", name][-1] == pytest.approx((up - down) / 2e-6, rel=1e-6)


@pytest.mark.parametrize("solver", SOLVERS, ids=name)
def test_energy_guards(solver: Casadi) -> None:
    """Drained from the dip on, refilled, drained: a saw tooth with every corner known."""
    run = Simulator(store(), solver, wrt=("P", "R", "E_min", "E_max"))(Waveform.sag(0.5, 0.1, 2.0, until=1.2))
    P, R, low, high = 1.0, 2.0, 0.5, 0.8
    t1 = 0.1 + (1 - low) / P
    t2 = t1 + (high - low) / R
    t3 = t2 + (high - low) / P
    assert [e.time for e in run.events] == pytest.approx([0.1, t1, t2, t3], abs=1e-10)
    assert run.events[3].grad == pytest.approx(
        {
            "P": -(1 - low) / P**2 - (high - low) / P**2,
            "R": -(high - low) / R**2,
            "E_min": -1 / P - 1 / R - 1 / P,
            "E_max": 1 / R + 1 / P,
        },
        abs=1e-8,
    )
    # E(t) = E_min + R (t - t3): every theta acts through t3
    expected = {n: -R * s for n, s in run.events[3].grad.items()}
    expected["E_min"] += 1.0
    expected["R"] += 1.2 - t3
    assert {n: run.sens["energy", n][-1] for n in expected} == pytest.approx(expected, abs=1e-7)


def test_without_the_jump_term_the_sensitivity_is_wrong() -> None:
    """The term at the jump is what carries dE/dE_min across the corner: without it there is nothing left."""
    run = Simulator(store(), wrt=("E_min",))(Waveform.sag(0.5, 0.1, 2.0, until=0.7))
    (corner,) = [k for k in run.breaks if run.t[k] == run.events[1].time]
    before, after = run.sens["energy", "E_min"][corner], run.sens["energy", "E_min"][corner + 1]
    assert before == pytest.approx(0.0, abs=1e-12)  # what it would stay without
    assert after == pytest.approx(1.0 + 2.0 / 1.0, abs=1e-9)  # E_min + R (t - t1), dt1/dE_min = -1/P


@pytest.mark.parametrize("plugin", ["rosenbrock", "idas"])
def test_guard_on_an_algebraic_variable(plugin: str) -> None:
    """x' = -(x + k x^3): ln(x^2/(1 + k x^2)) falls by 2 t."""
    k, z_low = 0.5, 0.6
    run = Simulator(decay(), Casadi(plugin, 1e-9, 1e-11), wrt=("k", "z_low"), start="given")(flat(2.0))  # type: ignore[arg-type]

    def time(k: float, z_low: float) -> float:
        x = float(
            ca.rootfinder("x", "newton", {"x": (X := ca.SX.sym("x")), "g": X + k * X**3 - z_low})(x0=0.5)["x"]
        )
        return 0.5 * (log(1 / (1 + k)) - log(x**2 / (1 + k * x**2)))

    (event,) = run.events
    assert event.time == pytest.approx(time(k, z_low), abs=1e-8)
    for name, up, down in (
        ("k", time(k + 1e-5, z_low), time(k - 1e-5, z_low)),
        ("z_low", time(k, z_low + 1e-5), time(k, z_low - 1e-5)),
    ):
        assert event.grad[name] == pytest.approx((up - down) / 2e-5, rel=1e-6)
    at = run.breaks[-1]
    assert run["z_out"][at] == pytest.approx(z_low, abs=1e-9)
    x, S = run["x"], run.sens
    assert S["z_out", "k"][-1] == pytest.approx(
        (1 + 3 * k * x[-1] ** 2) * S["x", "k"][-1] + x[-1] ** 3, rel=1e-7
    )


def test_a_state_that_leaves_its_range_ends_the_run_with_a_sentence() -> None:
    s = Sketch({"E": 1.0}, {"P": 2.0})
    dae = s.dae(
        {"E": -s.p["P"]}, {"energy": s.x["E"]}, bounds={"E": (0.36, 1.5)}, crossing={"E": "DC link collapsed"}
    )
    simulator = Simulator(dae, start="given")
    with pytest.raises(SimulationError) as error:
        simulator(flat())
    assert str(error.value) == "sketch on segments: DC link collapsed at 0.320 s (E below 0.36 1)"
    run = simulator.attempt(flat())
    assert not run.completed
    assert run.t[-1] == pytest.approx(0.32, abs=1e-9)
    assert run["energy"][-1] == pytest.approx(0.36, abs=1e-9)
