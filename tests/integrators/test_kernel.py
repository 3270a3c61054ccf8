"""The compiled kernel: order, agreement with CasADi's backend, sensitivities, lanes and threads, endings."""

from __future__ import annotations

import itertools
import pickle
import platform
import re
from functools import cache
from math import acos, cos, exp, hypot, sin, sqrt

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.interpolate import CubicHermiteSpline

from dcvrt import facility
from dcvrt.criteria import Criteria
from dcvrt.dae import Dae
from dcvrt.errors import InputError, ModelError, SimulationError
from dcvrt.functionals import Functional, Integral, Maximum, Minimum, SustainedMinimum
from dcvrt.integrators import Casadi, Kernel, NoCompilerWarning, Simulator, compiler, find_compiler
from dcvrt.integrators.batch import BatchResult
from dcvrt.integrators.equations import Equations
from dcvrt.integrators.kernel import run as kernel_run
from dcvrt.integrators.kernel.library import Options
from dcvrt.integrators.kernel.run import KernelModel, KernelRun
from dcvrt.trajectory import Trajectory
from dcvrt.waveform import Waveform
from tests.integrators.systems import Sketch, ball, decay, flat, go, store

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="no C compiler here")
MODES = ("gfl", "gfm")
THETAS = ("beta", "H", "dc.T_hold", "bess.T_b", "sup.w_sag", "dc_loop.K_p")


@cache
def system(mode: str) -> Dae:
    return getattr(facility, mode)().compile()


@cache
def simulator(mode: str, rtol: float = 1e-6, wrt: tuple[str, ...] = (), threads: int = 1) -> Simulator:
    return Simulator(system(mode), Kernel("dp5", rtol, rtol * 1e-2, threads=threads), wrt)


def wave(depth: float = 0.45, swell: float = 1.15) -> Waveform:
    """Deep fault with recovery, dip, swell: all modes of the supervisor."""
    return Waveform.segments(
        [
            (0.0, 1.0), (0.1, depth * np.exp(-0.4j)), (0.2, 0.75 * np.exp(0.14j), 0.98), (0.6, 0.98, 1.0),
            (1.6, 0.7 * np.exp(-0.14j)), (1.75, 1.0), (2.0, swell * np.exp(0.07j)), (2.1, 1.0),
        ],
        until=2.4,
    )  # fmt: skip


def oscillator() -> Dae:
    s = Sketch({"x": 1.0, "w": 0.0}, {"omega": 5.0})
    om = s.p["omega"]
    return s.dae({"x": om * s.x["w"], "w": -om * s.x["x"]}, {"x_out": s.x["x"]})


# -- corners ------------------------------------------------------------------------------------------------

CORNER_WIDTH, CORNER_OMEGA, CORNER_UNTIL = 1e-4, 20.0, 0.12


def clipped() -> Dae:
    """y' = 10 max(cos(omega t) - c, 0), smoothed over a width far below a step."""
    s = Sketch({"x": 1.0, "w": 0.0, "y": 0.0}, {"c": 0.0})
    above, om = s.x["x"] - s.p["c"], CORNER_OMEGA
    rate = 5 * (above + ca.sqrt(above**2 + CORNER_WIDTH**2))
    return s.dae({"x": om * s.x["w"], "w": -om * s.x["x"], "y": rate}, {"y_out": s.x["y"]})


def clipped_at_end(c: float) -> float:
    def rate(t: float) -> float:
        above = cos(CORNER_OMEGA * t) - c
        return 5 * (above + sqrt(above**2 + CORNER_WIDTH**2))

    turn = acos(c) / CORNER_OMEGA
    near = [turn + d for d in (-1e-3, -1e-4, -1e-5, 0.0, 1e-5, 1e-4, 1e-3)]
    edges = [0.0, *(t for t in near if 0 < t < CORNER_UNTIL), CORNER_UNTIL]
    return sum(quad(rate, a, b, epsabs=1e-14, epsrel=1e-12)[0] for a, b in itertools.pairwise(edges))


def test_a_corner_between_the_stages_of_a_step_is_seen() -> None:
    """Wherever it lies: the embedded estimate alone lets errors of 460 tolerances pass."""
    levels, rtol = np.linspace(-0.6, 0.9, 401).tolist(), 1e-7
    simulate = Simulator(clipped(), Kernel("dp5", rtol, rtol * 1e-2), start="given")
    found = simulate.batch([flat(CORNER_UNTIL)], {"c": levels}, functionals={"y": Maximum("y_out")})
    wanted = np.array([clipped_at_end(c) for c in levels])
    errors = np.abs([f["y"].value for f in found.functionals] - wanted) / np.maximum(wanted, 1.0)
    assert errors.max() < 100 * rtol


# -- stability ----------------------------------------------------------------------------------------------


def follower() -> Dae:
    """y' = -lam (y - x), x = sin(om t), lam in 1/ms; y_out is how far y is off where it settles."""
    om = 3.0
    s = Sketch({"x": 0.0, "w": 1.0, "y": 0.0}, {"lam": 0.2})
    x, w, y, lam = s.x["x"], s.x["w"], s.x["y"], 1e3 * s.p["lam"]
    settled = lam * (lam * x - om * w) / (lam**2 + om**2)
    return s.dae({"x": om * w, "w": -om * x, "y": -lam * (y - x)}, {"y_out": y - settled})


@pytest.mark.parametrize("rtol", [1e-3, 1e-5, 1e-7, 1e-9])
def test_steps_at_the_border_of_stability_leave_no_error_behind(rtol: float) -> None:
    """A lag of 0.5 to 17 ms bounds the step, not the error. Where the estimate vanishes a step grows what is
    there 13 times: what is left of it stays within a few tens of tolerances."""
    simulate = Simulator(follower(), Kernel("dp5", rtol, rtol * 1e-2), start="given")
    for lam in (0.06, 0.137, 0.2, 0.35, 0.8, 2.0):
        run = simulate(flat(6.0), lam=lam)
        assert abs(run["y_out"][run.t > 1.0]).max() < 60 * rtol


# -- order --------------------------------------------------------------------------------------------------


def steps_of(monkeypatch: pytest.MonkeyPatch, h: float, until: float) -> tuple[KernelRun, float]:
    """A run whose steps are all h long, since every error is accepted; error of its state at the end."""

    def options(self: KernelModel, save_at: float, samples: bool) -> Options:
        return Options(1e6, 1e6, 1e6, 1.0, save_at, h, 1.0, 100_000, samples, samples, 0)

    monkeypatch.setattr(KernelModel, "options", options)
    sim = Simulator(oscillator(), Kernel(), wrt=("omega",), start="given")
    run = sim._attempt_on_kernel(flat(until), None, np.array([5.0]), False)
    trajectory = run.trajectory(("omega",), "")
    sizes = np.array([run.record.step_h[k] for k in range(run.record.steps)])
    assert (sizes > 0.99 * h).mean() > 0.7  # the others grow to it
    x, w = (float(trajectory[n][-1]) for n in ("x", "w"))
    return run, hypot(x - cos(5 * until), w + sin(5 * until))  # of x alone changes its sign on the way


def test_order_of_steps_is_five(monkeypatch: pytest.MonkeyPatch) -> None:
    errors = [steps_of(monkeypatch, h, 6.0)[1] for h in (0.1, 0.05, 0.025)]
    rates = [np.log2(a / b) for a, b in itertools.pairwise(errors)]
    assert min(rates) > 4.7, rates


def test_order_of_the_dense_output_is_four(monkeypatch: pytest.MonkeyPatch) -> None:
    """In one step, against the exact solution through its begin, so that nothing but it is measured."""
    errors, sens_errors = [], []
    for h in (0.05, 0.025, 0.0125):
        run, _ = steps_of(monkeypatch, h, 4.0)
        k = run.record.steps // 2
        t0, size = run.record.step_t[k], run.record.step_h[k]
        assert size == pytest.approx(h)
        x0 = np.array([run.record.step_x[4 * k + i] for i in range(4)])
        t = t0 + size * np.linspace(0.05, 0.95, 19)
        x, _ = run.states(t, np.full(19, k))
        turn = 5 * (t - t0)
        # S' = omega J S + J x turns with x; both components, since the error turns too
        a, b = x0[2] + turn * x0[1], x0[3] - turn * x0[0]
        for number, (first, second), found in ((0, x0[:2], errors), (2, (a, b), sens_errors)):
            exact = np.array(
                [np.cos(turn) * first + np.sin(turn) * second, np.cos(turn) * second - np.sin(turn) * first]
            )
            found.append(np.hypot(*(x[:, number : number + 2].T - exact)).max() / size)
    for found in (errors, sens_errors):
        rates = [np.log2(a / b) for a, b in itertools.pairwise(found)]
        assert min(rates) > 3.7, rates


def test_error_follows_the_tolerance() -> None:
    def error(rtol: float) -> float:
        run = Simulator(oscillator(), Kernel("dp5", rtol, rtol), wrt=("omega",), start="given")(flat(3.0))
        return float(np.abs(run["x_out"] - np.cos(5 * run.t)).max())

    errors = [error(r) for r in (1e-4, 1e-6, 1e-8, 1e-10)]
    assert all(b < a / 20 for a, b in itertools.pairwise(errors)), errors
    assert errors[-1] < 1e-8


# -- agreement with the other backend -----------------------------------------------------------------------


def sensitivity_at(run: Trajectory, name: str, theta: str, t: np.ndarray) -> np.ndarray:
    """Cubic between samples, as :meth:`Trajectory.at` for signals."""
    signals, j = run.outputs, run.wrt.index(theta)
    k = signals.names.index(name)
    assert signals.sens is not None
    assert signals.rate_sens is not None
    i = np.searchsorted(run.t, t, side="right").clip(max=len(run.t) - 1) - 1
    value, rate = signals.sens[:, k, j], signals.rate_sens[:, k, j]
    return np.array(
        [
            float(CubicHermiteSpline(run.t[n : n + 2], value[n : n + 2], rate[n : n + 2])(x))
            for n, x in zip(i, t, strict=True)
        ]
    )


def off(run: Trajectory, reference: Trajectory, names: tuple[str, ...], theta: str | None = None) -> float:
    """Largest difference over the largest value, more than 1 ms away from jumps."""
    edges = reference.t[reference.breaks]
    t = np.linspace(run.t[0], run.t[-1], 700)
    t = t[np.abs(t[:, None] - edges).min(axis=1) > 1e-3]
    worst = 0.0
    for name in names:
        if theta is None:
            a, b = run.at(name, t), reference.at(name, t)
        else:
            a, b = (sensitivity_at(r, name, theta, t) for r in (run, reference))
        worst = max(worst, float(np.abs(a - b).max() / max(np.abs(b).max(), 1e-3)))
    return worst


@pytest.mark.parametrize("mode", MODES)
def test_runs_events_and_sensitivities_are_those_of_the_other_backend(mode: str) -> None:
    """Tight, over ten events in all modes, with events on states."""
    values = {"beta": 1.15, "sup.w_sag": 0.9}
    ours = Simulator(system(mode), Kernel("dp5", 1e-10, 1e-12), THETAS, save_at=1e-4)(wave(), **values)
    theirs = Simulator(system(mode), Casadi("erk", 1e-10, 1e-12), THETAS, save_at=1e-4)(wave(), **values)
    assert ours.sequence == theirs.sequence
    assert len(ours.events) >= 8
    for a, b in zip(ours.events, theirs.events, strict=True):
        assert a.time == pytest.approx(b.time, abs=1e-9)
        assert a.grad == pytest.approx(b.grad, rel=1e-5, abs=1e-7)
    assert off(ours, theirs, ("v_it", "p_g", "w_dc", "p_b")) < 1e-6
    for theta in THETAS:
        assert off(ours, theirs, ("v_it", "w_dc", "p_g"), theta) < 3e-6, theta
    assert ours.break_grad == pytest.approx(theirs.break_grad, rel=1e-4, abs=1e-6)


@pytest.mark.parametrize("mode", MODES)
def test_sensitivities_are_in_the_error_norm(mode: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """At 1e-5 they are right to a thousandth at worst; left out of the norm, to no more than a hundredth."""
    signals = ("v_it", "p_g", "w_dc", "p_b")
    run, tight = (simulator(mode, r, THETAS)(wave(), beta=1.15) for r in (1e-5, 1e-10))
    assert run.sequence == tight.sequence
    monkeypatch.setattr(kernel_run, "THETA_LOOSER", 1e30)
    without = simulator(mode, 1e-5, THETAS)(wave(), beta=1.15)
    errors, worse = ([off(r, tight, signals, theta) for theta in THETAS] for r in (run, without))
    assert max(errors) < 1e-3
    assert max(worse) > 1e-2


@pytest.mark.parametrize("mode", MODES)
def test_tangents_of_the_waveform(mode: str) -> None:
    base = wave().resampled(0.01)
    tangent = (0.02 + 0.01j) * (1 + base.t) * np.where((base.t > 0.1) & (base.t < 0.25), 1.5, 1.0)
    carried = Waveform(base.t, base.v, {"H_75": tangent})
    wrt = ("H_75", "beta")
    ours, theirs = (
        Simulator(system(mode), solver, wrt, save_at=2e-4)(carried, beta=1.15)
        for solver in (Kernel("dp5", 1e-9, 1e-11), Casadi("erk", 1e-9, 1e-11))
    )
    assert ours.sens["p_g", "H_75"][0] == pytest.approx(theirs.sens["p_g", "H_75"][0], rel=1e-9)
    for theta in wrt:
        assert off(ours, theirs, ("v_it", "p_g", "w_dc"), theta) < 2e-5


# -- inputs -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", MODES)
def test_a_sampled_waveform_is_the_stepped_one_and_costs_no_more_steps(mode: str) -> None:
    sim = simulator(mode, 1e-7)
    runs = {}
    for name, w in (("stepped", wave()), ("sampled", wave().resampled(5e-3))):
        p = sim.dae.parameter_values(beta=1.15)
        runs[name] = sim._attempt_on_kernel(w, None, p, False)
    steps = {n: r.result.accepted + r.result.rejected for n, r in runs.items()}
    assert steps["sampled"] < 1.05 * steps["stepped"]
    a, b = (r.trajectory((), "") for r in runs.values())
    assert off(b, a, ("v_it", "p_g", "w_dc")) < 1e-6


@pytest.mark.parametrize("at", [0.4, 0.43, 0.4567, 0.51])
def test_a_pulse_between_samples_is_not_stepped_over(at: float) -> None:
    """x' = V - 1: x is the integral of the pulse, which no stage of a long step might see."""
    s = Sketch({"x": 0.0}, {"T": 0.1})
    dae = s.dae({"x": s.v[0] - 1.0}, {"x_out": s.x["x"]})
    t = np.concatenate(([0.0, 0.05, 0.1, 0.3], at + 1e-3 * np.arange(-3, 4), [0.6, 0.8, 1.0]))
    v = np.ones(len(t))
    v[7] = 0.5
    w = Waveform.from_samples(t, v)
    pieces = w.pieces()
    area = float((pieces.length * (pieces.coefficients.real @ (1 / np.arange(1, 5)) - 1.0)).sum())
    run = Simulator(dae, Kernel("dp5", 1e-8, 1e-10), start="given")(w)
    assert area < -2e-4
    assert run["x_out"][-1] == pytest.approx(area, rel=1e-4)


# -- equilibrium --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", MODES)
def test_the_kernels_equilibrium_is_that_of_the_reference(mode: str) -> None:
    rng = np.random.default_rng(3)
    base = flat(0.1)
    w = Waveform(base.t, base.v, {"H_75": 0.1j + 0 * base.v})
    sim = simulator(mode, 1e-6, (*THETAS, "H_75"))
    kernel = sim._kernel(True)
    channels, _ = sim._table(kernel, w)
    for _ in range(20):
        p = sim.dae.parameter_values(beta=rng.uniform(1.0, 1.5), H=rng.uniform(0.1, 5.0))
        X, _, found = kernel.rests(p[None], channels.first[None], channels.first_tangent[None])
        assert found.all()
        assert X[0] == pytest.approx(sim._begin(kernel.equations, channels, p)[0], rel=1e-10, abs=1e-12)


def test_open_directions_keep_their_start_value_and_its_derivative() -> None:
    s = Sketch({"a": 0.0, "charge": 0.0}, {"k": 2.0, "charge_0": 0.7})
    dae = s.dae(
        {"a": s.v[0] - s.p["k"] * s.x["a"], "charge": s.v[0] - s.p["k"] * s.x["a"]},
        {"a_out": s.x["a"], "charge_out": s.x["charge"]},
        start={"charge": s.p["charge_0"]},
    )
    run = Simulator(dae, Kernel(), wrt=("k", "charge_0"))(flat())
    assert run["a_out"][0] == pytest.approx(0.5, abs=1e-12)
    assert run["charge_out"][0] == pytest.approx(0.7, abs=1e-12)
    assert run.sens["charge_out", "charge_0"][-1] == pytest.approx(1.0, abs=1e-12)
    assert run.sens["a_out", "k"][0] == pytest.approx(-0.25, abs=1e-12)


# -- batches ------------------------------------------------------------------------------------------------

FUNCTIONALS: dict[str, Functional] = {
    "low": Minimum("w_dc"), "held": SustainedMinimum("v_it", 0.02), "energy": Integral("p_b", positive=True)
}  # fmt: skip


def cases(n: int) -> tuple[list[Waveform], dict[str, list[float]]]:
    rng = np.random.default_rng(7)
    waves = [wave(d, s) for d, s in zip(rng.uniform(0.2, 0.8, 5), rng.uniform(1.05, 1.2, 5), strict=True)]
    return [waves[k % 5] for k in range(n)], {
        "beta": rng.uniform(1.0, 1.5, n).tolist(),
        "H": rng.uniform(0.3, 3.0, n).tolist(),
        "dc.T_hold": rng.choice([0.012, 0.03], n).tolist(),
    }


def row_numbers(result: BatchResult) -> list[list[float]]:
    return [[v for v in row.values() if isinstance(v, float)] for row in result.rows()]


@pytest.mark.parametrize("mode", MODES)
def test_lanes_agree_with_single_runs(mode: str) -> None:
    waves, table = cases(21)
    sim = simulator(mode, 1e-7, ("beta", "H"))
    result = sim.batch(waves, table, Criteria(), functionals=FUNCTIONALS)
    assert {len(m.sequence) for m in result.margins if m} != {1}
    for k, w in enumerate(waves):
        run = sim.attempt(w, None, **{n: v[k] for n, v in table.items()})
        assert result.status[k] == run.status
        if not run.completed:
            assert result.margins[k] is None
            continue
        assert result.margins[k].sequence == run.sequence  # type: ignore[union-attr]
        for name, f in FUNCTIONALS.items():
            ours, theirs = result.functionals[k][name], f.of(run)
            assert ours.value == pytest.approx(theirs.value, rel=2e-5, abs=2e-6)
            for theta in ("beta", "H"):
                assert ours.grad[theta] == pytest.approx(theirs.grad[theta], rel=2e-3, abs=2e-4)


def test_results_do_not_depend_on_lane_chunk_or_thread() -> None:
    """Bit for bit."""
    n = 37
    waves, table = cases(n)
    wrt = ("beta",)
    first = row_numbers(simulator("gfl", 1e-6, wrt).batch(waves, table, Criteria()))
    for threads in (2, 3):
        again = simulator("gfl", 1e-6, wrt, threads).batch(waves, table, Criteria())
        assert row_numbers(again) == first
    order = np.random.default_rng(1).permutation(n)
    mixed = simulator("gfl", 1e-6, wrt).batch(
        [waves[k] for k in order], {name: [v[k] for k in order] for name, v in table.items()}, Criteria()
    )
    assert row_numbers(mixed) == [first[k] for k in order]
    for k in (0, 5):
        alone = simulator("gfl", 1e-6, wrt).batch(
            [waves[k]], {name: v[k] for name, v in table.items()}, Criteria()
        )
        assert row_numbers(alone) == [first[k]]


def test_failed_lanes_are_labelled_and_leave_the_others_alone() -> None:
    sag = Waveform.sag(0.05, 0.1, 0.3, until=0.5)
    table = {"bess.P_dis": [1.2, 0.0] * 6, "sup.T_deep": 5.0, "dc.T_hold": 0.01}
    sim = simulator("gfl")
    result = sim.batch([sag], table, Criteria())
    assert result.failed == tuple(range(1, 12, 2))
    lone = sim.attempt(sag, None, **{n: v[1] if isinstance(v, list) else v for n, v in table.items()})  # type: ignore[arg-type]
    assert {result.status[k] for k in result.failed} == {lone.status}
    assert "dc.w below 0.36" in lone.status
    sound = sim.batch([sag], {**table, "bess.P_dis": [1.2] * 6}, Criteria())
    assert row_numbers(sound) == [row_numbers(result)[k] for k in range(0, 12, 2)]


def test_a_batch_without_anything_asked_tells_status_alone() -> None:
    result = Simulator(store(), Kernel()).batch([Waveform.sag(0.5, 0.1, 0.1, until=0.3)], {"P": [1.0, 2.0]})
    assert (result.failed, result.margins) == ((), (None, None))


# -- how a run ends -----------------------------------------------------------------------------------------


def test_a_run_that_blows_up_says_when_where_and_what_came_before() -> None:
    s = Sketch({"x": 1.0}, {"k": 1.0})
    _, _, rows = s.automaton("sup", {"calm": (0.0,), "wild": (1.0,)}, "calm")
    rows.append(go("calm", "wild", s.x["x"] - 2.0))
    run = Simulator(s.dae({"x": s.x["x"] ** 2}, {"x_out": s.x["x"]}), Kernel(), start="given").attempt(
        flat(2.0)
    )
    assert run.status.startswith(
        "integration failed between 1 and 1 s in mode wild: the step size became too"
    )
    assert "fastest state x = " in run.status
    assert "last event: 0.500000 s  sup: calm -> wild" in run.status
    assert run.t[-1] == pytest.approx(1.0, abs=1e-3)


def test_a_rate_that_is_no_number() -> None:
    s = Sketch({"x": 1.0}, {"k": 1.0})
    dae = s.dae({"x": -ca.sqrt(s.x["x"] - 0.5)}, {"x_out": s.x["x"]})
    run = Simulator(dae, Kernel(), start="given").attempt(flat(2.0))
    # x - 0.5 = (sqrt(0.5) - t/2)^2 ends at sqrt(2) s
    assert run.completed or "fastest state x" in run.status
    dae = s.dae({"x": ca.log(s.x["x"]) - 1.0}, {"x_out": s.x["x"]})
    status = Simulator(dae, Kernel(), start="given").attempt(flat(9.0)).status
    assert status.startswith("integration failed between ")
    assert "no automaton" in status


@pytest.mark.parametrize("method", ["dp5", "rosenbrock"])
def test_a_failure_tells_the_state_at_which_it_ended(method: str) -> None:
    """x' = ln x - 1 falls to 0 at t = integral of 1 / (1 - ln x) over (0, 1) = e E1(1) = 0.596347 s."""
    s = Sketch({"x": 1.0}, {"k": 1.0})
    dae = s.dae({"x": ca.log(s.x["x"]) - 1.0}, {"x_out": s.x["x"]})
    sim = Simulator(dae, Kernel(method), start="given")  # type: ignore[arg-type]
    status = sim.attempt(flat(9.0)).status
    told = re.fullmatch(
        r"integration failed between 0\.59634\d* and 0\.59634\d* s in mode no automaton: the (state is no "
        r"longer a finite number|step size became too small); fastest state x = (\S+), rate (\S+) 1/s; "
        r"last event: none",
        status,
    )
    assert told is not None, status
    assert 0 < float(told[2]) < 1e-6
    assert float(told[3]) == pytest.approx(np.log(float(told[2])) - 1.0, rel=1e-3)
    (in_lanes,) = sim.batch([flat(9.0)], {}).status
    assert in_lanes.split(" = ")[0] == status.split(" = ")[0]
    assert float(in_lanes.split("x = ")[1].split(",")[0]) < 1e-6


def test_more_events_than_a_run_may_have() -> None:
    s = Sketch({"x": 0.0}, {"w": 1e-4})
    q, _, rows = s.automaton("relay", {"up": (1.0,), "down": (-1.0,)}, "up")
    rows += [go("up", "down", s.x["x"] - s.p["w"]), go("down", "up", -s.x["x"] - s.p["w"])]
    run = Simulator(s.dae({"x": q[0]}, {"x_out": s.x["x"]}), Kernel(), start="given", save_at=0.1)
    # the first after w, each of the 10000 further ones after 2 w
    assert run.attempt(flat(3.0)).status == "more than 10000 events up to 2.0001 s: the automaton chatters"


@pytest.mark.parametrize(("march", "lanes"), [("x86-64-v3", 4), ("x86-64", 2)])
def test_other_instructions_give_the_same_runs(
    march: str, lanes: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Fewer lanes, the same answers, and bit for bit on any number of threads."""
    if platform.machine() != "x86_64":
        pytest.skip("flags of another processor")
    waves, table = cases(11)
    native = simulator("gfl", 1e-9).batch(waves, table, Criteria())
    monkeypatch.setenv("DCVRT_MARCH", march)
    ours = [
        Simulator(system("gfl"), Kernel("dp5", 1e-9, 1e-11, threads=k)).batch(waves, table, Criteria())
        for k in (1, 2)
    ]
    assert row_numbers(ours[0]) == row_numbers(ours[1])
    assert Simulator(system("gfl"), Kernel("dp5", 1e-9, 1e-11)).backend.endswith(f" {lanes} lanes")
    for a, b in zip(ours[0].margins, native.margins, strict=True):
        assert (a is None) == (b is None)
        if a is not None and b is not None:
            assert a.sequence == b.sequence
            assert (a.voltage.value, a.loss.value) == pytest.approx((b.voltage.value, b.loss.value), abs=1e-7)


def test_instructions_that_the_compiler_does_not_know(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DCVRT_MARCH", "no-such-processor")
    with pytest.raises(InputError, match=r"The C compiler failed [^\n]*\n(?s:.*)no-such-processor"):
        Simulator(ball(), Kernel(), start="given")(flat())


def test_too_many_steps_are_told_with_the_limit() -> None:
    run = Simulator(oscillator(), Kernel(max_steps=50), start="given").attempt(flat(20.0))
    assert "more steps than max_steps = 50; fastest state" in run.status


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"method": "dp6"}, "The kernel has no method 'dp6'. Did you mean 'dp5'? Known: "),
        ({"rtol": 1e-17}, "rtol = 1e-17 must be at least 1e-14 (round-off) and below 1."),
        ({"atol": 2.0}, "atol = 2 must be at least 1e-14 (round-off) and below 1."),
        ({"threads": 0}, "threads = 0 must be at least 1."),
        ({"max_steps": 0}, "max_steps = 0 must be at least 1."),
    ],
)
def test_unusable_options(arguments: dict, message: str) -> None:
    with pytest.raises(InputError) as error:
        Kernel(**arguments)
    assert str(error.value).startswith(message)


def test_algebraic_variables_need_another_solver() -> None:
    with pytest.raises(ModelError) as error:
        Simulator(decay(), Kernel("dp5"), start="given")(flat())
    assert str(error.value).startswith(
        "sketch has 1 algebraic variable(s); the kernel's method 'dp5' takes none."
    )


def test_without_a_compiler_casadi_stands_in_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    with_compiler = Simulator(ball(), Kernel("dp5", 1e-9, 1e-11), start="given")(flat(1.0))
    monkeypatch.setenv("CC", "none")
    compiler.say_interpreted.cache_clear()
    sim = Simulator(ball(), Kernel("dp5", 1e-9, 1e-11), start="given")
    with pytest.warns(NoCompilerWarning, match="No C compiler was found"):
        run = sim(flat(1.0))
    assert sim.backend == "casadi erk, CasADi interpreter (no C compiler found)"
    assert run["height"][-1] == pytest.approx(with_compiler["height"][-1], abs=1e-8)


def test_a_failing_compiler_keeps_its_message(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    script = tmp_path / "badcc"
    script.write_text(
        "#!/bin/sh\n[ \"$1\" = --version ] && { echo badcc 1.0; exit 0; }\necho 'no space left' >&2\nexit 4\n"
    )
    script.chmod(0o755)
    monkeypatch.setenv("CC", str(script))
    monkeypatch.setenv("DCVRT_CACHE_DIR", str(tmp_path / "cache"))
    with pytest.raises(InputError, match=r"The C compiler failed .*\nno space left\n"):
        Simulator(ball(), Kernel(), start="given")(flat())


# -- many events, closed forms ------------------------------------------------------------------------------


def test_a_thermostat_over_many_switches() -> None:
    """x' = -x + 2 q between 0.5 and 1: every switch in closed form."""
    s = Sketch({"x": 0.75}, {"low": 0.5})
    q, _, rows = s.automaton("relay", {"off": (0.0,), "on": (1.0,)}, "off")
    rows += [go("off", "on", s.p["low"] - s.x["x"]), go("on", "off", s.x["x"] - 1.0)]
    dae = s.dae({"x": -s.x["x"] + 2 * q[0]}, {"x_out": s.x["x"]})
    run = Simulator(dae, Kernel("dp5", 1e-10, 1e-12), wrt=("low",), start="given")(flat(30.0))
    first, cool, heat = np.log(0.75 / 0.5), np.log(1.0 / 0.5), np.log(1.5 / 1.0)
    times = first + np.cumsum([0.0, *itertools.islice(itertools.cycle((heat, cool)), len(run.events) - 1)])
    assert len(run.events) > 50
    assert [e.time for e in run.events] == pytest.approx(times.tolist(), abs=1e-8)
    # each time reached from above: dt/dlow = -1/low; from below the way up starts lower: heat = ln((2-low)/1)
    slope = 0.0
    for k, event in enumerate(run.events):
        slope += -1 / 0.5 if k % 2 == 0 else -1 / 1.5
        assert event.grad["low"] == pytest.approx(slope, rel=1e-6)


def test_equal_equations_share_one_object() -> None:
    a, b = (Simulator(ball(), Kernel(), start="given") for _ in range(2))
    assert a._kernel(False).library.dll._name == b._kernel(False).library.dll._name
    assert isinstance(a._kernel(False).equations, Equations)
    with pytest.raises(SimulationError):
        a(flat(5.0))
    assert sin(0.0) == 0.0
    assert exp(0.0) == 1.0


def test_sensitivities_are_computed_when_they_are_read() -> None:
    """Later runs do not change them, and a copy has them."""
    simulate = Simulator(system("gfl"), Kernel(), ("beta", "H"))
    runs = [simulate(wave(), beta=1.1 + 0.01 * k) for k in range(4)]
    first = simulate(wave(), beta=1.1)
    copy = pickle.loads(pickle.dumps(runs[1]))
    for name in ("v_it", "p_g"):
        assert np.array_equal(first.sens[name, "beta"], runs[0].sens[name, "beta"])
        assert np.array_equal(copy.sens[name, "H"], runs[1].sens[name, "H"])
    assert np.array_equal(first.states.sens, runs[0].states.sens)
    assert runs[0].outputs.rate_sens.shape == (len(runs[0].t), len(runs[0].outputs.names), 2)
