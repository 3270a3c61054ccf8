"""The kernel's linearly implicit method: order, stiffness, algebraic variables, events, sensitivities."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from functools import cache
from math import cos, exp, log, sin, sqrt
from typing import Any

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from dcvrt import facility
from dcvrt.criteria import Criteria
from dcvrt.dae import Dae
from dcvrt.errors import InputError, ModelError, SimulationError
from dcvrt.functionals import Functional, Integral, Maximum, Minimum, SustainedMinimum, TimeBelow
from dcvrt.integrators import Casadi, Kernel, Simulator, find_compiler
from dcvrt.integrators.kernel.elimination import Elimination, pivot_rows
from dcvrt.integrators.kernel.library import Options
from dcvrt.integrators.kernel.run import KernelModel, KernelRun
from dcvrt.models import Diagram, Feeder, Poi, VoltageFilter
from dcvrt.models.automaton import Go, above, below
from dcvrt.models.block import Block, Equations, Input, Output, Parameter
from dcvrt.models.phasor import Phasor
from dcvrt.trajectory import Trajectory
from dcvrt.waveform import Waveform
from tests.integrators.systems import Sketch, ball, crossed, decay, flat, go, store

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="no C compiler here")
TIGHT = Kernel("rosenbrock", 1e-10, 1e-12)
THETAS = ("beta", "H", "dc.T_hold", "bess.T_b", "sup.w_sag", "dc_loop.K_p")


def steps(simulator: Simulator, waveform: Waveform) -> tuple[KernelRun, Trajectory, int]:
    """A run with its number of steps, taken or not."""
    p = simulator.dae.parameter_values()
    run = simulator._attempt_on_kernel(waveform, None, p, False)
    return run, run.trajectory(simulator.wrt, ""), run.result.accepted + run.result.rejected


# -- order --------------------------------------------------------------------------------------------------


def moving() -> Dae:
    """Nonlinear, with time in it, and an algebraic variable; x = 2 + sin k t, z = exp(-k t) for every k."""
    s = Sketch({"x": 2.0}, {"k": 1.0}, ["z"])
    x, z, kt = s.x["x"], s.z["z"], s.p["k"] * s.t
    on_x, on_z = 2 + ca.sin(kt), ca.exp(-kt)
    return s.dae(
        {"x": -x * z + on_x * on_z + s.p["k"] * ca.cos(kt)},
        {"x_out": x, "z_out": z},
        [z + 0.1 * z**3 - on_z - 0.1 * on_z**3 - 0.5 * (x**2 - on_x**2)],
    )


def exact(t: np.ndarray) -> dict[str, np.ndarray]:
    """x and z of `moving`, and their derivatives by k, at k = 1."""
    return {
        "x_out": 2 + np.sin(t), "z_out": np.exp(-t), "dx": t * np.cos(t), "dz": -t * np.exp(-t)
    }  # fmt: skip


def errors_with_steps_of(h: float, monkeypatch: pytest.MonkeyPatch) -> tuple[np.ndarray, np.ndarray]:
    """Of x, z and their derivatives: at the ends of steps, and between, where every error is accepted."""

    def options(self: KernelModel, save_at: float, samples: bool) -> Options:
        return Options(1e6, 1e6, 1e6, 1.0, save_at, h, 1.0, 100_000, samples, samples, 0)

    monkeypatch.setattr(KernelModel, "options", options)
    sim = Simulator(moving(), Kernel(), wrt=("k",), save_at=h / 6, start="given")
    run, trajectory, _ = steps(sim, flat(6.0))
    sizes = np.array([run.record.step_h[k] for k in range(run.record.steps)])
    assert (sizes > 0.99 * h).mean() > 0.7  # the others grow to it
    found = (
        trajectory["x_out"], trajectory["z_out"], trajectory.sens["x_out", "k"], trajectory.sens["z_out", "k"]
    )  # fmt: skip
    off = np.abs(np.array(found) - np.array(list(exact(trajectory.t).values())))
    ends = np.isin(trajectory.t, [run.record.step_t[k] for k in range(run.record.steps)])
    return off[:, ends].max(axis=1), off[:, ~ends].max(axis=1)


def test_order_is_five_on_an_algebraic_system(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the derivatives by a parameter; between steps the algebraic variable is of order 4."""
    found = [errors_with_steps_of(h, monkeypatch) for h in (0.05, 0.025, 0.0125)]
    for coarse, fine in itertools.pairwise(found):
        at_ends, between = (np.log2(a / b) for a, b in zip(coarse, fine, strict=True))
        assert at_ends.min() > 4.6, found
        assert between[[0, 2]].min() > 4.6, found
        assert between[[1, 3]].min() > 3.7, found


def test_error_follows_the_tolerance() -> None:
    errors = []
    for rtol in (1e-4, 1e-6, 1e-8, 1e-10):
        run = Simulator(moving(), Kernel(None, rtol, rtol), wrt=("k",), start="given")(flat(3.0))
        found = (run["x_out"], run["z_out"], run.sens["x_out", "k"], run.sens["z_out", "k"])
        errors.append(np.abs(np.array(found) - np.array(list(exact(run.t).values()))).max())
    assert all(b < a / 20 for a, b in itertools.pairwise(errors)), errors
    assert errors[-1] < 1e-9


# -- stiff systems ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("fast", [1e2, 1e4, 1e6, 1e8])
def test_prothero_and_robinson(fast: float) -> None:
    """x' = -fast (x - cos t) - sin t from the solution x = cos t: as many steps however fast it is."""
    s = Sketch({"x": 1.0}, {"k": 1.0})
    dae = s.dae({"x": -fast * (s.x["x"] - ca.cos(s.t)) - ca.sin(s.t)}, {"x_out": s.x["x"]})
    _, run, count = steps(Simulator(dae, Kernel("rosenbrock", 1e-7, 1e-9), start="given"), flat(10.0))
    assert np.abs(run["x_out"] - np.cos(run.t)).max() < 2e-6  # between the ends of steps too
    assert count < 250


def test_a_fast_state_off_its_place_is_gone_in_a_few_steps() -> None:
    s = Sketch({"x": 3.0, "y": 1.0}, {"k": 1.0})
    x, y = s.x["x"], s.x["y"]
    dae = s.dae({"x": -1e8 * (x - y), "y": -s.p["k"] * y}, {"x_out": x, "y_out": y})
    _, run, count = steps(Simulator(dae, Kernel("rosenbrock"), wrt=("k",), start="given"), flat(2.0))
    assert count < 200
    late = run.t > 1e-3
    # y = exp(-k t) and x = y 1e8/(1e8 - k)
    np.testing.assert_allclose(run["x_out"][late], np.exp(-run.t[late]), rtol=2e-6)
    np.testing.assert_allclose(run.sens["x_out", "k"][late], -(run.t * np.exp(-run.t))[late], rtol=1e-4)


@pytest.mark.parametrize(("mu", "most"), [(1e3, 900), (1e5, 1300), (1e6, 1500)])
def test_van_der_pol(mu: float, most: int) -> None:
    s = Sketch({"x": 2.0, "w": -0.66}, {"k": 1.0})
    x, w = s.x["x"], s.x["w"]
    dae = s.dae({"x": w, "w": mu**2 * ((1 - x**2) * w - x)}, {"x_out": x})
    sim = Simulator(dae, Kernel("rosenbrock", 1e-6, 1e-8), save_at=0.01, start="given")
    _, run, count = steps(sim, flat(1.5))
    assert count < most
    reference = solve_ivp(
        lambda _, y: [y[1], mu**2 * ((1 - y[0] ** 2) * y[1] - y[0])], (0.0, 1.5), [2.0, -0.66], "Radau",
        rtol=1e-10, atol=1e-12, dense_output=True,
        jac=lambda _, y: [[0.0, 1.0], [mu**2 * (-2 * y[0] * y[1] - 1), mu**2 * (1 - y[0] ** 2)]],
    )  # fmt: skip
    off = np.abs(run["x_out"] - reference.sol(run.t)[0])
    assert off[np.abs(run.t - 0.8) > 0.02].max() < 1e-4  # away from the jump near t = 0.807
    assert run["x_out"][-1] == pytest.approx(reference.y[0, -1], abs=2e-5)


def test_robertson_with_the_sum_as_algebraic_equation() -> None:
    s = Sketch({"a": 1.0, "b": 0.0}, {"k": 0.04}, ["c"])
    a, b, c = s.x["a"], s.x["b"], s.z["c"]
    slow, back, fast = s.p["k"] * a, 1e4 * b * c, 3e7 * b**2
    dae = s.dae(
        {"a": -slow + back, "b": slow - back - fast}, {"a_out": a, "b_out": b, "c_out": c}, [a + b + c - 1],
        start={"c": 0.0},
    )  # fmt: skip
    solver = Kernel(None, 1e-7, 1e-12)
    sim = Simulator(dae, solver, wrt=("k",), save_at=10.0, start="given")
    _, run, count = steps(sim, flat(4e4))
    assert count < 700
    assert sim.backend.startswith("kernel rosenbrock, ")

    def rates(_: float, y: np.ndarray, k: float = 0.04) -> list[float]:
        slow, back, fast = k * y[0], 1e4 * y[1] * y[2], 3e7 * y[1] ** 2
        return [-slow + back, slow - back - fast, fast]

    ends = {}
    for k in (0.04, 0.04 * (1 + 1e-4), 0.04 * (1 - 1e-4)):
        tight = solve_ivp(rates, (0, 4e4), [1.0, 0, 0], "Radau", rtol=1e-11, atol=1e-16, args=(k,))
        ends[k] = tight.y[:, -1]
    middle, up, down = ends.values()
    for number, name in enumerate(("a_out", "b_out", "c_out")):
        assert run[name][-1] == pytest.approx(middle[number], rel=1e-5)
        slope = (up[number] - down[number]) / (2e-4 * 0.04)
        assert run.sens[name, "k"][-1] == pytest.approx(slope, rel=1e-4)


def test_pendulum_with_its_force_as_algebraic_variable() -> None:
    """Reduced to index 1; energy and length stay."""
    s = Sketch({"x": 1.0, "y": 0.0, "u": 0.0, "w": 0.0}, {"g": 9.81}, ["force"])
    x, y, u, w = s.x.values()
    force, g = s.z["force"], s.p["g"]
    dae = s.dae(
        {"x": u, "y": w, "u": -force * x, "w": -force * y - g},
        {"energy": (u**2 + w**2) / 2 + g * y, "length": ca.hypot(x, y), "force": force, "y": y},
        [u**2 + w**2 - force * (x**2 + y**2) - g * y],
        start={"force": 0.0},
    )
    run = Simulator(dae, Kernel(None, 1e-9, 1e-11), wrt=("g",), start="given")(flat(3.0))
    assert np.abs(run["energy"]).max() < 1e-6
    assert np.abs(run["length"] - 1).max() < 1e-7
    np.testing.assert_allclose(run["force"], -3 * 9.81 * run["y"], atol=1e-5)
    # in units of time 1/sqrt(g) the motion is one for all g
    np.testing.assert_allclose(run.sens["energy", "g"], 0.0, atol=1e-6)


# -- sensitivities ------------------------------------------------------------------------------------------


def central(simulate: Callable[..., Trajectory], name: str, theta: str, at: float, step: float) -> float:
    up, down = (simulate(**{theta: at + d}) for d in (step, -step))
    return float((up[name][-1] - down[name][-1]) / (2 * step))


@pytest.mark.parametrize("theta", ["k", "z_low"])
def test_sensitivities_are_those_of_central_differences(theta: str) -> None:
    """Across an event whose time depends on both parameters; of states and of algebraic variables."""
    run = Simulator(decay(), Kernel("rosenbrock", 1e-8, 1e-10), wrt=("k", "z_low"), start="given")(flat(2.0))
    oracle = Simulator(decay(), Kernel("rosenbrock", 1e-12, 1e-13), save_at=0.5, start="given")
    at = run.parameters[theta]
    for name in ("x_out", "z_out"):
        slope = central(lambda **p: oracle(flat(2.0), **p), name, theta, at, 1e-4)
        assert run.sens[name, theta][-1] == pytest.approx(slope, rel=1e-6)


@pytest.mark.parametrize("mode", ["gfl", "gfm"])
def test_a_facility_is_that_of_the_explicit_pair(mode: str) -> None:
    dae = getattr(facility, mode)().compile()
    wave = Waveform.segments(
        [
            (0.0, 1.0),
            (0.1, 0.45 * np.exp(-0.4j)),
            (0.2, 0.75, 0.98),
            (0.6, 0.98, 1.0),
            (0.9, 1.15),
            (1.0, 1.0),
        ],
        until=1.4,
    )
    ours, theirs = (
        Simulator(dae, Kernel(m, 1e-9, 1e-11), wrt=THETAS)(wave)
        for m in ("rosenbrock", "dp5")  # type: ignore[arg-type]
    )
    assert ours.sequence == theirs.sequence
    assert len(ours.events) >= 4
    for a, b in zip(ours.events, theirs.events, strict=True):
        assert a.time == pytest.approx(b.time, abs=1e-8)
        assert a.grad == pytest.approx(b.grad, rel=1e-5, abs=1e-6)
    t = np.linspace(0.0, 1.4, 400)
    t = t[np.abs(t[:, None] - theirs.t[theirs.breaks]).min(axis=1) > 1e-3]
    for name in ("v_it", "p_g", "w_dc"):
        size = np.abs(theirs[name]).max()
        np.testing.assert_allclose(ours.at(name, t), theirs.at(name, t), atol=1e-6 * size)
        for theta in THETAS:
            mine, others = (np.interp(t, r.t, r.sens[name, theta]) for r in (ours, theirs))
            np.testing.assert_allclose(mine, others, atol=1e-3 * max(np.abs(others).max(), 1e-3))
            size = max(np.abs(theirs.sens[name, theta]).max(), 1e-3)
            assert ours.sens[name, theta][-1] == pytest.approx(theirs.sens[name, theta][-1], abs=1e-6 * size)


# -- events -------------------------------------------------------------------------------------------------


def crossing(k: float, z_low: float) -> float:
    """When z of `decay` falls to z_low: ln(x^2/(1 + k x^2)) falls by 2 t."""
    x = max(r.real for r in np.roots([k, 0.0, 1.0, -z_low]) if abs(r.imag) < 1e-12)
    return 0.5 * (log(1 / (1 + k)) - log(x**2 / (1 + k * x**2)))


def test_guard_on_an_algebraic_variable() -> None:
    k, z_low = 0.5, 0.6
    run = Simulator(decay(), Kernel(None, 1e-9, 1e-11), wrt=("k", "z_low"), start="given")(flat(2.0))
    (event,) = run.events
    assert event.time == pytest.approx(crossing(k, z_low), abs=1e-9)
    slopes = {
        "k": (crossing(k + 1e-5, z_low) - crossing(k - 1e-5, z_low)) / 2e-5,
        "z_low": (crossing(k, z_low + 1e-5) - crossing(k, z_low - 1e-5)) / 2e-5,
    }
    assert event.grad == pytest.approx(slopes, rel=1e-7)
    at = run.breaks[-1]
    assert run["z_out"][at] == pytest.approx(z_low, abs=1e-12)
    x, S = run["x"], run.sens
    np.testing.assert_allclose(S["z_out", "k"], (1 + 3 * k * x**2) * S["x", "k"] + x**3, rtol=1e-6, atol=1e-9)


def test_events_are_as_exact_as_steps_and_not_as_the_dense_output(monkeypatch: pytest.MonkeyPatch) -> None:
    """In one long step before the event, against the exact solution through its begin."""

    def options(self: KernelModel, save_at: float, samples: bool) -> Options:
        return Options(1e6, 1e6, 1e6, 1.0, save_at, 0.2, 1.0, 100_000, samples, samples, 0)

    monkeypatch.setattr(KernelModel, "options", options)
    sim = Simulator(decay(), Kernel(), start="given", save_at=0.01)
    at_events, between = [], []
    for z_low in np.linspace(0.5, 0.9, 13):
        p = np.array([0.5, z_low])
        run = sim._attempt_on_kernel(flat(1.5), None, p, False)
        trajectory = run.trajectory((), "")
        (event,) = trajectory.events
        starts = np.array([run.record.step_t[n] for n in range(run.record.steps)])
        n = int(np.flatnonzero(starts < event.time)[-1])
        t0, x0 = starts[n], run.record.step_x[2 * n]
        assert t0 + run.record.step_h[n] == pytest.approx(event.time, abs=1e-5)  # made again to end there
        inside = (trajectory.t > t0) & (trajectory.t <= event.time)
        t = trajectory.t[inside][: np.argmax(trajectory.t[inside])] - t0
        if event.time - t0 < 0.1:
            continue
        off = np.abs(trajectory["x"][inside][: len(t) + 1] - solution(x0, np.append(t, event.time - t0)))
        between.append(off[:-1].max())
        at_events.append(off[-1])
    assert len(between) > 4
    assert all(a < b / 2 for a, b in zip(at_events, between, strict=True)), (at_events, between)


def solution(x0: float, t: np.ndarray) -> np.ndarray:
    """x of `decay` a time after x0: 1/x^2 + k grows by exp(2 t)."""
    return 1 / np.sqrt((1 / x0**2 + 0.5) * np.exp(2 * t) - 0.5)


def test_bouncing_ball() -> None:
    g, e, h0 = 9.81, 0.8, 1.0
    run = Simulator(ball(), TIGHT, wrt=("g", "e", "h0"), start="given")(flat(2.0))
    t1 = sqrt(2 * h0 / g)
    times = [t1, t1 * (1 + 2 * e), t1 * (1 + 2 * e + 2 * e**2)]
    assert [event.time for event in run.events] == pytest.approx(times, abs=1e-12)
    slopes = {"g": -times[2] / (2 * g), "e": t1 * (2 + 4 * e), "h0": times[2] / (2 * h0)}
    assert run.events[2].grad == pytest.approx(slopes, rel=1e-10)


def test_energy_guards() -> None:
    """Drained from the dip on, refilled, drained: a saw tooth with every corner known."""
    run = Simulator(store(), TIGHT, wrt=("P", "R", "E_min", "E_max"))(Waveform.sag(0.5, 0.1, 2.0, until=1.19))
    assert [e.time for e in run.events] == pytest.approx([0.1, 0.6, 0.75, 1.05], abs=1e-11)
    assert run.events[3].grad == pytest.approx(
        {"P": -0.8, "R": -0.075, "E_min": -2.5, "E_max": 1.5}, abs=1e-9
    )
    expected = {"P": 1.6, "R": 0.15 + 0.14, "E_min": 5.0 + 1.0, "E_max": -3.0}
    assert {n: run.sens["energy", n][-1] for n in expected} == pytest.approx(expected, abs=1e-9)


def reset_by_algebra() -> Dae:
    """x' = -z with 0 = z - c x; when z falls to b, x is reset to r x + z; after that z = c x/2."""
    s = Sketch({"x": 1.0}, {"c": 2.0, "b": 0.8, "r": 1.5}, ["z"])
    q, _, rows = s.automaton("sup", {"first": (1.0,), "then": (0.5,)}, "first")
    x, z = s.x["x"], s.z["z"]
    rows.append(go("first", "then", s.p["b"] - z, reset={0: s.p["r"] * x + z}))
    return s.dae({"x": -z}, {"x_out": x, "z_out": z}, [z - q[0] * s.p["c"] * x], start={"z": s.p["c"]})


def test_a_reset_to_an_algebraic_variable() -> None:
    """Value and derivative of both after it, in closed form."""

    def closed(c: float, b: float, r: float) -> tuple[float, float]:
        te = log(c / b) / c
        x = (r * b / c + b) * exp(-0.5 * c * (1.0 - te))
        return x, 0.5 * c * x

    at = {"c": 2.0, "b": 0.8, "r": 1.5}
    run = Simulator(reset_by_algebra(), TIGHT, wrt=tuple(at), start="given")(flat(1.0))
    assert [run["x_out"][-1], run["z_out"][-1]] == pytest.approx(closed(**at), abs=1e-9)
    k = run.breaks[0]
    assert [run["z_out"][k], run["z_out"][k + 1]] == pytest.approx(
        [0.8, 0.5 * 2 * (1.5 * 0.4 + 0.8)], abs=1e-10
    )
    for theta in at:
        up, down = (np.array(closed(**{**at, theta: at[theta] + d})) for d in (1e-6, -1e-6))
        for number, name in enumerate(("x_out", "z_out")):
            slope = (up - down)[number] / 2e-6
            assert run.sens[name, theta][-1] == pytest.approx(slope, abs=1e-7)


# -- a facility with an implicit wire -----------------------------------------------------------------------


class Load(Block):
    """Constant admittance behind a feeder, cut to a third while the voltage there is low."""

    modes = ("FULL", "THIRD")
    start = "FULL"
    flags = {"part": (1.0, 1 / 3)}  # noqa: RUF012
    low = Parameter(0.8, "pu(V)", (0, 0.85), "cut below")
    v = Input("pu(V)", "voltage", kind=Phasor)
    i = Output("pu(I)", "current", kind=Phasor)

    def transitions(self, s: Any) -> tuple[Go, ...]:
        return (Go("FULL", "THIRD", below(s.v.re, s.low)), Go("THIRD", "FULL", above(s.v.re, 0.93)))

    def equations(self, s: Any) -> Equations:
        return Equations(out={"i": s.v * Phasor(0.8, -0.3) * s.part})


@cache
def behind_a_feeder(**how: bool) -> Dae:
    d = Diagram("feeder")
    e = d.input("e", "pu(V)", Phasor)
    feeder, load, meter, poi = (
        d.add("feeder", Feeder(X=0.3, R=0.05)), d.add("load", Load()), d.add("meter", VoltageFilter()),
        d.add("poi", Poi()),
    )  # fmt: skip
    d.connect(e, feeder.e)
    d.connect(load.i, feeder.i, poi.i)
    d.connect(feeder.v, load.v, implicit=True, start=1.0)
    d.connect(feeder.v, meter.v, poi.v)
    for name, port in (("v_f", meter.v_f), ("p", poi.p)):
        d.output(name, port)
    return d.compile(**how)  # type: ignore[arg-type]


def falling() -> Waveform:
    return Waveform.segments([(0.0, 1.0), (0.05, 1.0, 0.6), (0.15, 0.6, 1.0)], until=0.4)


@pytest.mark.parametrize("plugin", ["rosenbrock", "idas"])
def test_an_implicit_wire_is_that_of_casadi(plugin: Any) -> None:
    ours, theirs = (
        Simulator(behind_a_feeder(), solver, wrt=("feeder.X", "load.low"))(falling())
        for solver in (Kernel(None, 1e-9, 1e-11), Casadi(plugin, 1e-9, 1e-11))
    )
    assert ours.sequence == theirs.sequence
    assert [e.target for e in ours.events] == ["THIRD", "FULL"]
    for a, b in zip(ours.events, theirs.events, strict=True):
        assert a.time == pytest.approx(b.time, abs=1e-8)
        assert a.grad == pytest.approx(b.grad, rel=1e-5, abs=1e-8)
    t = np.linspace(0.0, 0.4, 333)
    for name in ("v_f", "p", "load.v.re"):
        np.testing.assert_allclose(ours.at(name, t), theirs.at(name, t), atol=1e-7)
        for theta in ours.wrt:
            assert ours.sens[name, theta][-1] == pytest.approx(
                theirs.sens[name, theta][-1], rel=1e-5, abs=1e-9
            )


def test_tangents_of_the_waveform_reach_algebraic_variables() -> None:
    """Against a wire that is eliminated, and the explicit pair."""
    wave = falling().resampled(0.01)
    wave = Waveform(wave.t, wave.v, {"depth": 0.5 * (wave.v - 1.0)})
    kept, gone = (
        Simulator(behind_a_feeder(**how), Kernel(None, 1e-9, 1e-11), wrt=("depth",))(wave)
        for how in ({}, {"eliminate": True})
    )
    assert (kept.algebraics.names, gone.algebraics.names) == (("load.v.re", "load.v.im"), ())
    assert kept.events[0].grad == pytest.approx(gone.events[0].grad, rel=1e-6)
    assert kept.events[0].grad["depth"] != 0.0
    for name in ("v_f", "p"):
        assert kept.sens[name, "depth"][-1] == pytest.approx(gone.sens[name, "depth"][-1], rel=1e-5)


# -- lanes --------------------------------------------------------------------------------------------------

FUNCTIONALS: dict[str, Functional] = {
    "least": Minimum("p"), "held": SustainedMinimum("v_f", 0.02), "energy": Integral("p"),
    "most": Maximum("v_f"), "below": TimeBelow("p", 0.5),
}  # fmt: skip


def cases(n: int) -> tuple[list[Waveform], dict[str, list[float]]]:
    rng = np.random.default_rng(3)
    waves = [
        Waveform.segments([(0.0, 1.0), (0.05, 1.0, low), (0.15, low, 1.0), (0.3, 0.95)], until=0.4)
        for low in rng.uniform(0.4, 0.9, n)
    ]
    return waves, {
        "feeder.X": rng.uniform(0.1, 0.3, n).tolist(),
        "load.low": rng.uniform(0.65, 0.8, n).tolist(),
    }


def test_lanes_agree_with_single_runs() -> None:
    waves, table = cases(19)
    sim = Simulator(behind_a_feeder(), Kernel(None, 1e-8, 1e-10), wrt=("feeder.X", "load.low"))
    result = sim.batch(waves, table, functionals=FUNCTIONALS)
    assert not result.failed
    for k, w in enumerate(waves):
        run = sim(w, **{n: v[k] for n, v in table.items()})
        for name, f in FUNCTIONALS.items():
            ours, theirs = result.functionals[k][name], f.of(run)
            assert ours.value == pytest.approx(theirs.value, rel=2e-6, abs=2e-7), (k, name)
            for theta in sim.wrt:
                assert ours.grad[theta] == pytest.approx(theirs.grad[theta], rel=1e-3, abs=1e-5), (k, name)


def test_gradients_of_functionals_are_those_of_central_differences() -> None:
    """Steps are made again for them."""
    waves, table = cases(4)
    sim = Simulator(behind_a_feeder(), Kernel(None, 1e-8, 1e-10), wrt=("feeder.X", "load.low"))
    oracle = Simulator(behind_a_feeder(), Kernel(None, 1e-12, 1e-13))
    result = sim.batch(waves, table, functionals=FUNCTIONALS)
    for theta in sim.wrt:
        up, down = (
            oracle.batch(waves, {**table, theta: [v + d for v in table[theta]]}, functionals=FUNCTIONALS)
            for d in (1e-5, -1e-5)
        )
        for k, name in itertools.product(range(4), FUNCTIONALS):
            slope = (up.functionals[k][name].value - down.functionals[k][name].value) / 2e-5
            found = result.functionals[k][name].grad[theta]
            assert found == pytest.approx(slope, rel=1e-5, abs=2e-6), (k, name, theta)


def row_numbers(rows: list[dict[str, Any]]) -> list[list[float]]:
    return [[v for v in row.values() if isinstance(v, float)] for row in rows]


def test_results_do_not_depend_on_the_lane() -> None:
    """Bit for bit."""
    waves, table = cases(21)
    sim = Simulator(behind_a_feeder(), Kernel(), wrt=("feeder.X",))
    first = row_numbers(sim.batch(waves, table, functionals=FUNCTIONALS).rows())
    order = np.random.default_rng(1).permutation(21)
    mixed = sim.batch(
        [waves[k] for k in order],
        {n: [v[k] for k in order] for n, v in table.items()},
        functionals=FUNCTIONALS,
    )
    assert row_numbers(mixed.rows()) == [first[k] for k in order]
    alone = sim.batch([waves[4]], {n: v[4] for n, v in table.items()}, functionals=FUNCTIONALS)
    assert row_numbers(alone.rows()) == [first[4]]
    two = Simulator(behind_a_feeder(), Kernel(threads=2), wrt=("feeder.X",))
    assert row_numbers(two.batch(waves, table, functionals=FUNCTIONALS).rows()) == first


@pytest.mark.parametrize("mode", ["gfl", "gfm"])
def test_a_batch_of_facilities_with_margins_is_that_of_the_explicit_pair(mode: str) -> None:
    dae = getattr(facility, mode)().compile()
    sag = Waveform.sag(0.3, 0.1, 0.15, until=0.8)
    table = {"beta": np.linspace(1.05, 1.5, 9).tolist()}
    ours, theirs = (
        Simulator(dae, Kernel(m, 1e-8, 1e-10), wrt=("beta", "H")).batch([sag], table, Criteria())  # type: ignore[arg-type]
        for m in ("rosenbrock", "dp5")
    )
    assert not ours.failed
    for a, b in zip(ours.rows(), theirs.rows(), strict=True):
        for name, value in a.items():
            if isinstance(value, float) and not name.endswith("_time"):  # anywhere on a plateau
                assert value == pytest.approx(b[name], rel=1e-4, abs=1e-5), name


# -- elimination --------------------------------------------------------------------------------------------


def crossed_closed(t_s: float, t: float) -> tuple[float, float]:
    """After the switch x'' = 2 x."""
    x, y, w, s = exp(-t_s), 2 * exp(-2 * t_s), sqrt(2.0), t - t_s
    grow, fall = np.cosh(w * s), np.sinh(w * s)
    return float(x * grow - y / w * fall), float(y * grow - w * x * fall)


def test_pivots_that_vanish_in_a_mode_are_exchanged_lane_by_lane() -> None:
    sim = Simulator(crossed(), Kernel(None, 1e-8, 1e-10), wrt=("t_s",), start="given")
    run = sim(flat(1.0))
    x, y = crossed_closed(0.3, 1.0)
    assert [run[n][-1] for n in ("x_out", "y_out", "a_out")] == pytest.approx([x, y, y], abs=1e-7)
    slope = (np.array(crossed_closed(0.3 + 1e-6, 1.0)) - crossed_closed(0.3 - 1e-6, 1.0)) / 2e-6
    assert [run.sens[n, "t_s"][-1] for n in ("x_out", "y_out")] == pytest.approx(slope, abs=1e-6)
    switches = np.linspace(0.05, 1.3, 13)  # some lanes exchange, others do not
    result = sim.batch([flat(1.0)], {"t_s": switches.tolist()}, functionals={"sum": Integral("a_out")})
    for t_s, found in zip(switches, result.functionals, strict=True):
        left = crossed_closed(t_s, 1.0)[0] if t_s < 1 else exp(-1.0)
        assert found["sum"].value == pytest.approx(1.0 - left, abs=1e-6)  # x' = -a
        lone = sim.batch([flat(1.0)], {"t_s": t_s}, functionals={"sum": Integral("a_out")})
        assert lone.functionals[0]["sum"].value == found["sum"].value


@pytest.mark.parametrize("seed", range(5))
def test_the_order_of_elimination_solves_any_pattern(seed: int) -> None:
    """The statements of the C text, run as Python, against numpy."""
    rng = np.random.default_rng(seed)
    states, size = 5, 9
    J = np.where(rng.uniform(size=(size, size)) < 0.3, rng.normal(size=(size, size)), 0.0)
    for k in range(states, size):  # some matching: row k's pivot is elsewhere
        J[k, states + (k - states + 1) % (size - states)] = 3.0
        J[k, k] = 0.0
    entries = [(int(i), int(j)) for j, i in np.argwhere(J.T != 0)]
    rows = pivot_rows(entries, states, size)
    assert sorted(rows) == list(range(size))
    assert all(J[rows[k], k] != 0 for k in range(states, size))
    text = Elimination(entries, states, size).text()
    jacobian, b = [J[i, j] for i, j in entries], rng.normal(size=size)
    space: dict[str, Any] = {
        "d": 7.0, "jacobian": jacobian, "lu": {}, "b": list(b), "absolute": abs, "larger": max, "grown": 0,
        "not_at_most": lambda a, limit: not a <= limit, "GROWTH": 1e4,
    }  # fmt: skip
    first, second = text.split("static void solve_in_order")
    for part in (first, second.split("static void solve_columns_in_order")[0]):
        body = part[part.index("{\n", part.index("restrict")) + 2 : part.rindex("}")]
        for line in body.splitlines():
            statement = line.strip().removesuffix(";").removeprefix("const ").removeprefix("real ")
            if statement and not statement.startswith(("lanes_mask", "return", "}")):
                exec(statement, space)
    W = np.diag([7.0] * states + [0.0] * (size - states)) - J
    np.testing.assert_allclose(space["b"], np.linalg.solve(W, b), rtol=1e-9, atol=1e-9)


# -- choice and errors --------------------------------------------------------------------------------------


def test_the_method_fits_the_system() -> None:
    assert Simulator(ball()).backend.startswith("kernel dp5, ")
    assert Simulator(decay()).backend.startswith("kernel rosenbrock, ")
    assert Simulator(ball(), Kernel("rosenbrock")).backend.startswith("kernel rosenbrock, ")


def test_the_explicit_pair_takes_no_algebraic_variables() -> None:
    with pytest.raises(ModelError) as error:
        Simulator(decay(), Kernel("dp5"), start="given")(flat())
    assert str(error.value) == (
        "sketch has 1 algebraic variable(s); the kernel's method 'dp5' takes none. Use Kernel('rosenbrock')."
    )


def test_an_unknown_method() -> None:
    with pytest.raises(InputError) as error:
        Kernel("rosenbrok")  # type: ignore[arg-type]
    assert str(error.value) == (
        "The kernel has no method 'rosenbrok'. Did you mean 'rosenbrock'? Known: dp5, rosenbrock."
    )


def fold(level: float) -> Dae:
    """x' = -1 with 0 = z^2 - x - |V| + level: no z beyond the fold at z = 0, where g_z is singular."""
    s = Sketch({"x": 1.0}, {"k": 1.0}, ["z"])
    z = s.z["z"]
    return s.dae({"x": -s.p["k"]}, {"z_out": z}, [z**2 - s.x["x"] - s.v[0] + level])


def test_an_input_jump_after_which_no_algebraic_variables_fit() -> None:
    with pytest.raises(SimulationError) as error:
        Simulator(fold(1.0), start="given")(Waveform.sag(0.05, 0.2, 0.1, until=0.5))
    assert str(error.value) == "sketch on sag to 0.05 pu for 100 ms: no consistent value of z at 0.2 s"


def test_a_start_at_which_no_algebraic_variables_fit() -> None:
    with pytest.raises(SimulationError) as error:
        Simulator(fold(3.0), start="given")(flat())
    assert str(error.value) == "sketch on segments: no consistent value of z at 0 s"


def test_the_algebraic_equations_become_singular_on_the_way() -> None:
    simulator = Simulator(fold(1.0), start="given")
    with pytest.raises(SimulationError) as error:
        simulator(flat(2.0))
    message = str(error.value)
    assert message.startswith("sketch on segments: "), message
    assert "the step size became too small" in message or "no longer a finite number" in message, message
    run = simulator.attempt(flat(2.0))
    assert run.t[-1] == pytest.approx(1.0, abs=1e-3)
    np.testing.assert_allclose(run["z_out"], np.sqrt(np.maximum(1 - run.t, 0)), atol=1e-4)


def test_what_the_order_test_rests_on() -> None:
    """The system of the order test has the solution it is said to have."""
    dae = moving()
    f = ca.Function("f", [dae.t, dae.x, dae.z, dae.p], [dae.f, dae.g])
    for t in (0.0, 0.7, 2.3):
        rate, residual = f(t, 2 + sin(t), exp(-t), 1.0)
        assert float(rate) == pytest.approx(cos(t), abs=1e-14)
        assert float(residual) == pytest.approx(0.0, abs=1e-14)
