"""The simulator on whole systems: start, accuracy against the reference, sensitivities, inputs, messages."""

from __future__ import annotations

from functools import cache
from math import exp, pi, sin

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dcvrt import facility
from dcvrt.criteria import Criteria, margins
from dcvrt.dae import Dae, Row
from dcvrt.errors import InputError, ModelError, SimulationError
from dcvrt.integrators import Casadi, Simulator
from dcvrt.integrators.run import Run
from dcvrt.models import Diagram, Phasor
from dcvrt.trajectory import Trajectory
from dcvrt.waveform import Waveform
from tests.integrators.systems import Sketch, ball, decay, flat

MODES = ("gfl", "gfm")
# A low voltage limit, so that the DC energy and not the voltage calls for the battery: an event on a state.
ENERGY_FIRST = {"beta": 1.05, "sup.V_dip": 0.3, "sup.V_low": 0.25, "sup.V_deep": 0.2, "sup.V_back": 0.9}


@cache
def system(mode: str) -> Dae:
    return getattr(facility, mode)().compile()


@cache
def simulator(
    mode: str, plugin: str = "erk", rtol: float = 1e-6, wrt: tuple[str, ...] = (), save_at: float = 1e-3
) -> Simulator:
    return Simulator(system(mode), Casadi(plugin, rtol, rtol * 1e-2), wrt, save_at)  # type: ignore[arg-type]


def oracle(mode: str) -> Simulator:
    """For differences of runs: tight, and sampled so finely that interpolation does not show."""
    return simulator(mode, "erk", 1e-12, save_at=1e-4)


def three_disturbances() -> Waveform:
    """Fault with recovery, dip, swell: events of every kind of the supervisor."""
    return Waveform.segments(
        [
            (0.0, 1.0),
            (0.1, 0.45 * np.exp(-0.3j)),
            (0.2, 0.8 * np.exp(0.1j), 0.98),
            (0.6, 0.98, 1.0),
            (1.6, 0.7),
            (1.7, 1.0),
            (1.9, 1.15),
            (2.0, 1.0),
        ],
        until=2.3,
    )


def one_fault() -> Waveform:
    return Waveform.segments(
        [(0.0, 1.0), (0.1, 0.4 * np.exp(-0.3j)), (0.25, 0.97, 1.0), (0.6, 1.0)], until=0.7
    )


def path_error(run: Trajectory, reference: Trajectory, names: tuple[str, ...]) -> float:
    t = np.linspace(run.t[0], run.t[-1], 2501)
    return max(float(np.abs(run.at(n, t) - reference.at(n, t)).max()) for n in names)


# -- start ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", MODES)
def test_undisturbed_run_stays_where_it_starts(mode: str) -> None:
    run = simulator(mode, "erk", 1e-10)(flat(1.0), beta=1.2)
    assert not run.events
    assert np.ptp(run.outputs.value, axis=0).max() < 1e-9


def test_open_directions_keep_their_start_value_and_its_derivative() -> None:
    """A charge that nothing moves at rest: d(charge)/d(charge_0) = 1 though the equilibrium is silent."""
    s = Sketch({"a": 0.0, "charge": 0.0}, {"k": 2.0, "charge_0": 0.7})
    dae = s.dae(
        {"a": s.v[0] - s.p["k"] * s.x["a"], "charge": s.v[0] - s.p["k"] * s.x["a"]},
        {"a_out": s.x["a"], "charge_out": s.x["charge"]},
        start={"charge": s.p["charge_0"]},
    )
    run = Simulator(dae, wrt=("k", "charge_0"))(flat())
    # the least-norm step shares the residual's direction among the states that it determines
    assert run["a_out"][0] == pytest.approx(0.5, abs=1e-12)
    assert run["charge_out"][0] == pytest.approx(0.7, abs=1e-12)
    assert run.sens["charge_out", "charge_0"][-1] == pytest.approx(1.0, abs=1e-12)
    assert run.sens["a_out", "k"][-1] == pytest.approx(-0.25, abs=1e-9)


def test_no_equilibrium_names_the_largest_residuals() -> None:
    with pytest.raises(SimulationError) as error:
        Simulator(ball())(flat())
    assert str(error.value) == (
        "sketch: no equilibrium at the first value of the waveform. "
        "Largest residuals in mode ball falling:\n"
        "  d(w)/dt = -9.81 1/s\n  d(h)/dt = 0 1/s\n"
        "Ways out: parameters or an input at which these equations can all be zero (a facility must be able "
        "to import its load before the disturbance: beta |V| above the load factor d); better start values "
        "(State(start), rest()); start='given' for a system that never rests."
    )


# -- accuracy -----------------------------------------------------------------------------------------------


def test_time_of_an_oscillator_and_its_sensitivity() -> None:
    s = Sketch({"x": 1.0, "w": 0.0}, {"omega": 5.0})
    om = s.p["omega"]
    dae = s.dae({"x": om * s.x["w"], "w": -om * s.x["x"]}, {"x_out": s.x["x"]})
    run = Simulator(dae, Casadi("erk", 1e-9, 1e-11), wrt=("omega",), start="given")(flat(3.0))
    assert run["x_out"] == pytest.approx(np.cos(5 * run.t), abs=1e-6)
    assert run.sens["x_out", "omega"] == pytest.approx(-run.t * np.sin(5 * run.t), abs=1e-5)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("plugin", ["erk", "rosenbrock"])
def test_agrees_with_the_reference_between_events(mode: str, plugin: str) -> None:
    wave = three_disturbances()
    reference = simulator(mode, "cvodes", 1e-10)(wave, beta=1.15)
    run = simulator(mode, plugin, 1e-7)(wave, beta=1.15)
    assert [(e.source, e.target) for e in run.events] == [(e.source, e.target) for e in reference.events]
    assert len(run.events) >= 6
    assert max(abs(a.time - b.time) for a, b in zip(run.events, reference.events, strict=True)) < 2e-6
    assert path_error(run, reference, ("v_it", "p_g", "w_dc", "soc")) < 5e-5


@pytest.mark.parametrize("mode", MODES)
def test_interpreted_equals_compiled(mode: str) -> None:
    interpreted = Simulator(system(mode), Casadi(interpreted=True))
    assert interpreted.backend == "casadi erk, CasADi interpreter (asked for)"
    run, other = interpreted(one_fault()), simulator(mode)(one_fault())
    assert path_error(run, other, ("v_it", "p_g", "w_dc")) < 1e-9


@pytest.mark.parametrize("plugin", ["erk", "rosenbrock", "cvodes"])
def test_a_sampled_waveform_is_the_stepped_one(plugin: str) -> None:
    """Every 5 ms a sample, jumps marked: the same run, though every sample ends a cubic."""
    wave = one_fault()
    simulate = simulator("gfl", plugin, 1e-8, save_at=2e-4)
    run, sampled = simulate(wave), simulate(wave.resampled(5e-3))
    assert [e.target for e in run.events] == [e.target for e in sampled.events]
    assert path_error(run, sampled, ("v_it", "p_g", "w_dc")) < 1e-6


# -- sensitivities ------------------------------------------------------------------------------------------


def relative_error(run: Trajectory, up: Trajectory, down: Trajectory, theta: str, step: float) -> float:
    """Largest difference to central differences over the largest sensitivity, away from breaks."""
    times = np.linspace(run.t[0] + 1e-3, run.t[-1], 60)
    k = np.unique(np.searchsorted(run.t, times).clip(max=len(run.t) - 1))
    edges = [*run.t[run.breaks], *up.t[up.breaks], *down.t[down.breaks]]
    k = k[[min(abs(run.t[i] - e) for e in edges) > 1e-4 for i in k]]
    errors = []
    for name in ("v_it", "p_g", "w_dc", "p_b"):
        difference = (up.at(name, run.t[k]) - down.at(name, run.t[k])) / (2 * step)
        size = np.abs(difference).max()
        if size > 1e-3:  # below this, differences of runs at 1e-12 hold no digits
            errors.append(float(np.abs(run.sens[name, theta][k] - difference).max() / size))
    assert errors, f"no signal moves with {theta}: nothing was compared"
    return max(errors)


@pytest.mark.parametrize("mode", MODES)
def test_sensitivities_equal_central_differences_across_events_on_states(
    mode: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    thetas = ("beta", "H", "dc.T_hold", "bess.T_b", "sup.w_sag")
    wave = one_fault()
    smooth = simulator(mode, "erk", 1e-9, thetas)
    run = smooth(wave, **ENERGY_FIRST)
    assert run.events[0].grad["sup.w_sag"] != 0.0
    monkeypatch.setattr(Run, "_time_gradient", lambda self, row: np.zeros(self.equations.nw))
    without = smooth(wave, **ENERGY_FIRST)
    wrong = {}
    for theta in thetas:
        value = run.parameters[theta]
        step = 2e-5 * value
        up, down = (oracle(mode)(wave, **{**ENERGY_FIRST, theta: value + s * step}) for s in (1, -1))
        assert up.sequence == down.sequence == run.sequence
        assert relative_error(run, up, down, theta, step) < 1e-4, theta
        wrong[theta] = relative_error(without, up, down, theta, step)
    assert wrong["sup.w_sag"] > 0.5  # without the jump term they are wrong, not a little
    assert wrong["dc.T_hold"] > 0.05


@pytest.mark.parametrize("mode", MODES)
def test_sensitivities_pass_timers_and_input_jumps(mode: str) -> None:
    """The whole table: NORMAL, MIXED, BATTERY by its timer, RETURN by its ramp."""
    thetas = ("beta", "sup.T_deep", "sup.T_stable", "sup.T_ramp")
    wave = three_disturbances()
    run = simulator(mode, "erk", 1e-9, thetas)(wave, beta=1.15)
    assert {e.target for e in run.events} >= {"MIXED", "BATTERY", "RETURN"}
    for theta in thetas:
        value = run.parameters[theta]
        step = max(1e-5 * value, 2e-6)
        up, down = (oracle(mode)(wave, **{"beta": 1.15, theta: value + s * step}) for s in (1, -1))
        assert relative_error(run, up, down, theta, step) < 1e-4, theta


@pytest.mark.parametrize("mode", MODES)
def test_tangents_of_the_waveform(mode: str) -> None:
    """dV/dH_75 given with the waveform: what the facility makes of it, before, in and after the fault."""
    base = one_fault().resampled(0.02)
    tangent = (0.02 + 0.01j) * (1 + base.t) * np.where((base.t > 0.1) & (base.t < 0.25), 1.5, 1.0)

    def wave(shift: float) -> Waveform:
        return Waveform(base.t, base.v + shift * tangent, {"H_75": tangent})

    run = simulator(mode, "erk", 1e-9, ("H_75", "beta"))(wave(0.0), beta=1.1)
    step = 1e-3
    up, down = oracle(mode)(wave(step), beta=1.1), oracle(mode)(wave(-step), beta=1.1)
    assert relative_error(run, up, down, "H_75", step) < 2e-4
    assert abs(run.sens["p_g", "H_75"][0] - (up["p_g"][0] - down["p_g"][0]) / (2 * step)) < 1e-6


@pytest.mark.parametrize("mode", MODES)
def test_rates_and_their_sensitivities_are_those_of_the_signals(mode: str) -> None:
    """What the margins interpolate with: d/dt of signals and sensitivities, against differences."""
    wave = one_fault().resampled(0.02)
    wave = Waveform(wave.t, wave.v, {"H_75": 0.05 * (1 + wave.t**2) * (1 + 0.3j)})
    run = simulator(mode, "erk", 1e-11, ("H_75", "beta"), save_at=1e-5)(wave, beta=1.1)
    inside = np.flatnonzero((np.diff(run.t[:-1]) > 5e-6) & (np.diff(run.t[1:]) > 5e-6))[5:-5:37] + 1
    span = run.t[inside + 1] - run.t[inside - 1]
    even = np.abs(np.diff(run.t)[inside] - np.diff(run.t)[inside - 1]) < 1e-9
    inside, span = inside[even], span[even]
    signals = run.outputs
    assert signals.rate is not None
    assert signals.sens is not None
    assert signals.rate_sens is not None
    for name in ("v_it", "p_g", "q_g"):
        k = signals.names.index(name)
        for value, rate in ((signals.value[:, k], signals.rate[:, k]), *(
            (signals.sens[:, k, j], signals.rate_sens[:, k, j]) for j in range(2)
        )):  # fmt: skip
            difference = (value[inside + 1] - value[inside - 1]) / span
            kinks = np.abs(difference - rate[inside]) > 1e-3 * (1 + np.abs(rate).max())
            assert kinks.mean() < 0.01, name  # a difference across the end of a cubic piece is none


# -- inputs
# ---------------------------------------------------------------------------------------------------


def lag() -> Dae:
    """x' = a (u - x), driven by a free input beside the voltage."""
    t, x, u, a = (ca.SX.sym(n) for n in "txua")
    v = ca.SX.sym("v", 2)
    none = ca.SX(0, 1)
    return Dae(
        "lag", t, x, none, ca.vertcat(v, u), a, a * (u - x), none, ca.vertcat(x, v[0]),
        (Row("x", "1"),), (),
        (Row("v_poi.re", "pu(V)", 1.0), Row("v_poi.im", "pu(V)"), Row("g_it", "1", 1.0)),
        (Row("a", "1/s", 4.0, (0.0, 100.0)),), (Row("x_out", "1"), Row("v_out", "1")),
    )  # fmt: skip


def test_another_input_is_interpolated_and_jumps() -> None:
    a = 4.0
    t = np.array([0.0, 0.5, 0.5, 1.0])
    run = Simulator(lag(), Casadi("erk", 1e-9, 1e-11))(
        Waveform.sag(0.5, 0.2, 0.1, until=1.0), inputs={"g_it": (t, [1.0, 1.0, 2.0, 2.0])}
    )
    assert run["x_out"][-1] == pytest.approx(2.0 - exp(-a * 0.5), abs=1e-8)
    assert sorted(run.t[run.breaks]) == pytest.approx([0.2, 0.3, 0.5])
    fine = np.linspace(0.0, 1.0, 41)
    run = Simulator(lag(), Casadi("erk", 1e-9, 1e-11))(flat(), inputs={"g_it": (fine, np.cos(2 * pi * fine))})
    om = 2 * pi
    phase = (a * a * np.cos(om) + a * om * sin(om)) / (a * a + om * om)
    start = 1.0 - a * a / (a * a + om * om)
    assert run["x_out"][-1] == pytest.approx(phase + start * exp(-a), abs=2e-5)


@pytest.mark.parametrize(
    ("inputs", "message"),
    [
        ({"g_i": ([0, 1], [1, 1])}, "lag has no free input 'g_i'. Did you mean 'g_it'? Known: g_it."),
        (
            {"g_it": ([0, 0.5], [1, 1])},
            "input 'g_it': it covers 0 to 0.5 s, the waveform 0 to 1 s; give samples for the whole run.",
        ),
        ({"g_it": ([0, 1], [1, np.nan])}, "input 'g_it': values[1] is nan."),
        (
            {"g_it": ([0, 0.7, 0.6, 1], [1, 1, 1, 1])},
            "input 'g_it': times do not increase: t[2] = 0.6 s comes after t[1] = 0.7 s.",
        ),
    ],
)
def test_unusable_inputs(inputs: dict, message: str) -> None:
    with pytest.raises(InputError) as error:
        Simulator(lag())(flat(), inputs=inputs)
    assert str(error.value) == message


# -- messages -----------------------------------------------------------------------------------------------


def test_unknown_and_out_of_range_parameters_are_told_at_once() -> None:
    with pytest.raises(InputError) as error:
        Simulator(lag())(flat(), aa=1.0, a=200.0)
    assert str(error.value) == (
        "lag has no parameter 'aa'. Did you mean 'a'? Known: a.\na = 200 1/s is outside [0, 100]."
    )


def test_a_wrt_that_nobody_knows() -> None:
    with pytest.raises(InputError) as error:
        Simulator(lag(), wrt=("b", "H_75"))(flat())
    assert str(error.value) == (
        "wrt: 'b' is neither a parameter of lag nor a tangent of the waveform. Known: a.\n"
        "wrt: 'H_75' is neither a parameter of lag nor a tangent of the waveform. Known: a."
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"wrt": "beta"}, "wrt = 'beta' must be a tuple of names: wrt=('beta',)."),
        ({"wrt": ("a", "a")}, "wrt names a twice."),
        ({"save_at": 0.0}, "save_at = 0 s must be positive."),
        ({"start": "rest"}, "start = 'rest' must be 'equilibrium' or 'given'."),
        (
            {"solver": "cvodes"},
            "solver = 'cvodes': must be solver options. Way out: solver=Casadi('cvodes'), or leave it out.",
        ),
        ({"solver": 5}, "solver = 5: must be solver options. Way out: solver=Casadi(...), or leave it out."),
    ],
)
def test_unusable_options(arguments: dict, message: str) -> None:
    with pytest.raises(InputError) as error:
        Simulator(lag(), **arguments)
    assert str(error.value) == message


def test_what_is_no_waveform_and_no_criteria() -> None:
    simulator = Simulator(lag())
    no_waveform = (
        "'sag' is no waveform. Way out: Waveform.sag(...), Waveform.ercot_style(), Waveform.from_csv(path) "
        "or Waveform(t, v)."
    )
    for call in (
        lambda: simulator("sag"),
        lambda: simulator.attempt("sag"),
        lambda: simulator.batch("sag", {}),
        lambda: simulator.batch([flat(), "sag"], {}),
    ):
        with pytest.raises(InputError) as error:
            call()
        assert str(error.value) == no_waveform
    for call in (
        lambda: simulator.batch([flat()], {}, criteria="x"),
        lambda: margins(simulator(flat()), "x"),
    ):
        with pytest.raises(InputError) as error:
            call()
        assert str(error.value) == "criteria = 'x': must be criteria. Way out: criteria=Criteria(...)."


def test_unusable_solver_options() -> None:
    with pytest.raises(InputError) as error:
        Casadi("rosenbrok")  # type: ignore[arg-type]
    assert str(error.value) == (
        "There is no CasADi integrator 'rosenbrok'. Did you mean 'rosenbrock'? "
        "Known: erk, rosenbrock, cvodes, idas."
    )
    with pytest.raises(InputError) as error:
        Casadi(rtol=1e-17)
    assert str(error.value) == "rtol = 1e-17 must be at least 1e-14 (round-off) and below 1."


def test_algebraic_variables_need_a_solver_that_takes_them() -> None:
    with pytest.raises(ModelError) as error:
        Simulator(decay(), Casadi("erk"), start="given")(flat())
    assert str(error.value) == (
        "sketch has 1 algebraic variable(s); plugin 'erk' takes none. "
        "Use Casadi(plugin='rosenbrock') or 'idas'."
    )


def test_a_run_that_blows_up_says_when_where_and_in_which_mode() -> None:
    s = Sketch({"x": 1.0, "y": 0.0}, {"k": 1.0})
    dae = s.dae({"x": s.x["x"] ** 2, "y": -s.x["y"]}, {"x_out": s.x["x"]})
    with pytest.raises(
        SimulationError, match=r"integration failed between .* s in mode no automaton: .*fastest state x = "
    ):
        Simulator(dae, start="given")(flat(2.0))  # x = 1/(1 - t)


def test_unknown_signals_of_a_run() -> None:
    run = Simulator(lag(), wrt=("a",))(flat())
    with pytest.raises(InputError) as error:
        run["x_ou"]
    assert str(error.value) == "the run has no signal 'x_ou'. Did you mean 'x_out'? Known: x_out, v_out, x."
    with pytest.raises(InputError) as error:
        run.sens["x_out", "b"]
    assert str(error.value) == "'b' is not among the wrt of this simulator. Known: a."


def test_a_plot_that_cannot_be_written(tmp_path) -> None:
    run = Simulator(lag())(flat())
    with pytest.raises(InputError) as error:
        run.plot(tmp_path / "no" / "ride.svg")
    assert str(error.value) == (
        f"plot: {tmp_path / 'no' / 'ride.svg'} cannot be written: No such file or directory. "
        "Way out: another path."
    )
    with pytest.raises(
        InputError, match=r"ride\.xyz: .* Way out: a path that ends with \.svg, \.png or \.pdf\.$"
    ):
        run.plot(tmp_path / "ride.xyz")


def test_plot(tmp_path) -> None:
    run = simulator("gfl")(one_fault())
    run.plot(tmp_path / "ride.svg")
    run.plot(tmp_path / "ride.png", signals=["v_it"])
    assert (tmp_path / "ride.svg").stat().st_size > 5_000
    assert (tmp_path / "ride.png").read_bytes()[:4] == b"\x89PNG"


# -- what lies between samples, and any disturbance ---------------------------------------------------------


def test_a_corner_between_samples_is_sampled_anew() -> None:
    """|x - 0.35137| smoothed over 1e-5: its minimum lies between two samples, where a cubic would miss it."""
    s = Sketch({"x": 0.0}, {"k": 1.0})
    corner = ca.sqrt((s.x["x"] - 0.35137) ** 2 + 1e-10)
    dae = s.dae({"x": s.p["k"]}, {"v_it": corner, "p_g": 1.0 + 0 * s.x["x"]})
    run = Simulator(dae, wrt=("k",), start="given")(flat())
    low = margins(run, Criteria(criterion="instantaneous")).voltage
    assert low.value + 0.9 == pytest.approx(1e-5, abs=1e-5)
    assert low.time == pytest.approx(0.35137, abs=2e-5)
    assert len(run.t) < 1300


@settings(max_examples=12)
@given(st.integers(0, 10_000))
def test_any_disturbance_agrees_with_the_reference(seed: int) -> None:
    rng = np.random.default_rng(seed)
    mode = MODES[seed % 2]
    steps: list = [(0.0, 1.0)]
    t = 0.05
    for _ in range(rng.integers(1, 4)):
        steps.append((t, rng.uniform(0, 1.3) * np.exp(0.3j * rng.normal())))
        t += rng.choice([0.005, 0.02, 0.1, 0.3]) * rng.uniform(0.5, 1.5)
        if rng.random() < 0.6:
            steps.append((t, rng.uniform(0.6, 1.05), 1.0))
            t += rng.uniform(0.05, 0.3)
    wave = Waveform.segments([*steps, (t, 1.0)], until=t + rng.uniform(0.2, 0.8))
    values = {
        "beta": rng.uniform(1.0, 1.5),
        "H": rng.uniform(0.2, 3.0),
        "dc.T_hold": rng.choice([0.012, 0.03]),
    }
    run = simulator(mode).attempt(wave, **values)
    reference = simulator(mode, "cvodes", 1e-9).attempt(wave, **values)
    assert run.status.split(" at ")[0] == reference.status.split(" at ")[0]
    assert run.sequence == reference.sequence
    assert len(run.breaks) == len(run.break_grad)
    assert np.unique(run.t, return_counts=True)[1].max() <= 2
    for event, other in zip(run.events, reference.events, strict=True):
        assert event.time == pytest.approx(other.time, abs=2e-5)
    end = min(run.t[-1], reference.t[-1])
    edges = np.append(run.t[run.breaks], end)
    times = np.linspace(0.0, end, 600)
    times = times[np.abs(times[:, None] - edges).min(axis=1) > 2e-3]
    for name in ("v_it", "p_g", "w_dc"):
        size = max(1.0, values["H"]) if name == "p_g" else 1.0
        assert np.abs(run.at(name, times) - reference.at(name, times)).max() < 1e-3 * size


def test_a_system_without_states_is_refused() -> None:
    d = Diagram("still")
    v = d.input("v_poi", "pu(V)", Phasor)
    d.output("v", v)
    with pytest.raises(ModelError) as error:
        Simulator(d.compile())(Waveform.sag(0.5, 0.1, 0.1, 1.0))
    assert str(error.value) == (
        "still has no states: there is nothing to integrate. Way out: add a block with a state."
    )
