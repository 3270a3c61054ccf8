"""Hybrid semantics of the exported automata: the times known in closed form, and those of our own runs."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Callable
from math import sqrt
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from fmpy import fmi3
from fmpy.validation import validate_fmu

from dcvrt import Simulator, Waveform
from dcvrt.dae import Dae
from dcvrt.fmi import binary
from dcvrt.integrators import Casadi
from dcvrt.models import Block, Diagram, Equations, Input, Output, Parameter, State
from tests.fmi.tools import Unit, apart, between, changes, column, put_states, settle, start
from tests.integrators.systems import Sketch, ball, decay, flat, go, store

Make = Callable[..., Unit]


@pytest.fixture
def made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Make:
    monkeypatch.setattr(binary, "FLAGS", ("-O0", *(f for f in binary.FLAGS if f != "-O2")))  # quicker to make

    def make(dae: Dae, **options: object) -> Unit:
        return Unit.of(dae, tmp_path, **options)

    return make


def timer(held: float = 0.1, level: float = 0.9) -> Dae:
    """idle -> fired after the voltage was below a level for `held`; x counts the time spent in `fired`."""
    s = Sketch({"x": 0.0}, {"T": held})
    q, _, rows = s.automaton("sup", {"idle": (0.0,), "fired": (1.0,)}, "idle")
    rows.append(go("idle", "fired", level - s.v[0], s.p["T"] if held else 0.0))
    return s.dae({"x": q[0]}, {"x_out": s.x["x"]})


def rows_of(*rows: tuple) -> Dae:
    s = Sketch({"x": 0.0}, {"T": 0.1})
    _, _, table = s.automaton("sup", {"a": (0.0,), "b": (1.0,), "c": (2.0,)}, "a")
    table += [go(source, target, guard(s), *held) for source, target, guard, *held in rows]
    return s.dae({"x": 0.0}, {"x_out": s.x["x"]})


def at(*expected: tuple[float, int]) -> list:
    return [(pytest.approx(t, abs=1e-8), mode) for t, mode in expected]


# -- (a) order ----------------------------------------------------------------------------------------------


def test_the_first_row_that_is_due_wins_and_the_tie_is_told(made: Make) -> None:
    unit = made(rows_of(("a", "b", lambda s: 0.9 - s.v[0]), ("a", "c", lambda s: 0.95 - s.v[0])))
    result = unit.simulate(Waveform.sag(0.5, 0.2, 0.1, until=0.5), start_values={"T": 0.3})
    assert changes(result, "sup.mode") == at((0.2, 1))
    assert unit.messages(fmi3.fmi3OK) == ["0.2 s: sup: a -> b; also due: sup: a -> c"]


# -- (b) held -----------------------------------------------------------------------------------------------


def test_held_counts_from_the_guard(made: Make) -> None:
    result = made(timer()).simulate(Waveform.sag(0.5, 0.2, 0.3, until=1.0))
    assert changes(result, "sup.mode") == at((0.3, 1))
    assert result["x_out"][-1] == pytest.approx(0.7, abs=1e-8)


def test_held_restarts_when_the_guard_lapses(made: Make) -> None:
    dips = Waveform.segments([(0.0, 1.0), (0.1, 0.5), (0.18, 1.0), (0.2, 0.5), (0.4, 1.0)], until=0.6)
    assert changes(made(timer()).simulate(dips), "sup.mode") == at((0.3, 1))


def test_held_counts_from_the_entry_when_the_guard_was_true_before(made: Make) -> None:
    unit = made(rows_of(("a", "b", lambda s: s.t - 0.35), ("b", "c", lambda s: 0.9 - s.v[0], 0.1)))
    result = unit.simulate(Waveform.sag(0.5, 0.2, 0.5, until=1.0))
    assert changes(result, "sup.mode") == at((0.35, 1), (0.45, 2))


def test_a_dwell_time_that_ends_as_the_guard_lapses_has_been_long_enough(made: Make) -> None:
    """As in our own loop: the timer comes before the jump of the input."""
    waveform = Waveform.sag(0.5, 0.2, 0.1, until=0.5)
    (event,) = Simulator(timer(), Casadi("erk"))(waveform).events
    assert event.time == pytest.approx(0.3, abs=1e-12)
    assert changes(made(timer()).simulate(waveform), "sup.mode") == at((0.3, 1))


# -- (c) strict, (d) clock, (e) continuous ------------------------------------------------------------------


def test_a_guard_that_only_touches_zero_does_not_fire(made: Make) -> None:
    result = made(timer(held=0.0, level=0.5)).simulate(Waveform.sag(0.5, 0.2, 0.3, until=1.0))
    assert changes(result, "sup.mode") == []


def test_the_clock_starts_at_zero_in_each_mode(made: Make) -> None:
    s = Sketch({"x": 0.0}, {"T": 0.3})
    _, clock, rows = s.automaton("sup", {"a": (0.0,), "b": (0.0,)}, "a")
    rows += [go("a", "b", 1.0, s.p["T"]), go("b", "a", 1.0, s.p["T"])]
    unit = made(s.dae({"x": clock}, {"x_out": s.x["x"]}), start="given")
    result = unit.simulate(flat())
    assert changes(result, "sup.mode") == at((0.3, 1), (0.6, 0), (0.9, 1))
    assert result["x_out"][-1] == pytest.approx((3 * 0.3**2 + 0.1**2) / 2, abs=1e-8)
    (rate,) = [u for u in unit.description.derivatives if u.variable.name == "der(x)"]
    assert [v.name for v in rate.dependencies] == ["time"]


def test_a_bouncing_ball_is_reset(made: Make) -> None:
    g, e = 9.81, 0.8
    unit = made(ball(), start="given")
    xml = ET.parse(unit.folder / "modelDescription.xml")
    assert [v.get("name") for v in xml.iter("Float64") if v.get("reinit") == "true"] == ["w"]
    result = unit.simulate(flat(2.0), tolerance=1e-10)
    t1 = sqrt(2 / g)
    times = [float(text.split(" s")[0]) for text in unit.messages(fmi3.fmi3OK)]
    assert times == pytest.approx([t1, t1 * (1 + 2 * e), t1 * (1 + 2 * e + 2 * e**2)], abs=1e-7)
    s = 2.0 - times[-1]
    assert result["height"][-1] == pytest.approx(e**3 * g * t1 * s - g * s * s / 2, abs=1e-6)


# -- (f) chatter --------------------------------------------------------------------------------------------


def test_more_than_fifty_jumps_at_one_instant_name_the_modes(made: Make) -> None:
    unit = made(rows_of(("a", "b", lambda s: 0.9 - s.v[0]), ("b", "a", lambda s: 0.9 - s.v[0])))
    with pytest.raises(Exception, match="fmi3UpdateDiscreteStates"):
        unit.simulate(Waveform.sag(0.5, 0.2, 0.1, until=0.5))
    assert unit.messages() == [
        "more than 50 jumps at 0.2 s between\n  sup: a -> b\n  sup: b -> a\n"
        "The guards of these modes are true together: give them hysteresis or a dwell time."
    ]


# -- several automata, state guards, bounds -----------------------------------------------------------------


def test_two_automata_run_side_by_side_and_may_start_each_other(made: Make) -> None:
    s = Sketch({"x": 0.0}, {"T": 0.1})
    q1, _, first = s.automaton("one", {"off": (0.0,), "on": (1.0,)}, "off")
    q2, _, second = s.automaton("two", {"off": (0.0,), "on": (1.0,)}, "off")
    first.append(go("off", "on", 0.9 - s.v[0], 0.05))
    second.append(go("off", "on", q1[0] - 0.5))
    unit = made(s.dae({"x": q1[0] + q2[0]}, {"x_out": s.x["x"]}))
    result = unit.simulate(Waveform.sag(0.5, 0.2, 0.3, until=0.5))
    assert changes(result, "one.mode") == changes(result, "two.mode") == at((0.25, 1))
    assert result["x_out"][-1] == pytest.approx(0.5, abs=1e-8)


def test_guards_on_a_state_make_the_saw_tooth(made: Make) -> None:
    result = made(store()).simulate(Waveform.sag(0.5, 0.1, 2.0, until=1.15))
    assert changes(result, "sup.mode") == at((0.1, 1), (0.6, 2), (0.75, 1), (1.05, 2))
    assert result["energy"][-1] == pytest.approx(0.5 + 2 * (1.15 - 1.05), abs=1e-7)


def draining(level: float = 0.36) -> Dae:
    s = Sketch({"E": 1.0}, {"P": 2.0})
    bounds, crossing = {"E": (level, 1.5)}, {"E": "DC link collapsed"}
    return s.dae({"E": -s.p["P"]}, {"energy": s.x["E"]}, bounds=bounds, crossing=crossing)


@pytest.mark.parametrize("solver", ["CVode", "Euler"])
def test_a_state_that_leaves_its_bounds_ends_the_run_with_a_sentence(made: Make, solver: str) -> None:
    unit = made(draining(), start="given")
    result = unit.simulate(flat(), solver=solver, step_size=1e-3)
    late = 1e-7 if solver == "CVode" else 1e-3
    assert unit.messages(fmi3.fmi3Warning) == ["DC link collapsed at 0.320 s (E below 0.36 1)"]
    assert result["time"][-1] == pytest.approx(0.32, abs=late)
    assert result["energy"][-1] == pytest.approx(0.36, abs=2 * late)


def test_a_start_beyond_the_bounds_ends_at_once(made: Make) -> None:
    unit = made(draining(level=1.2), start="given")
    with pytest.raises(Exception, match="requested termination"):
        unit.simulate(flat())
    assert unit.messages(fmi3.fmi3Warning) == ["DC link collapsed at 0.000 s (E below 1.2 1)"]


# -- algebraic variables ------------------------------------------------------------------------------------


def test_an_algebraic_variable_is_solved_inside_and_guards_may_read_it(made: Make) -> None:
    run = Simulator(decay(), Casadi("idas", 1e-11, 1e-13), save_at=1e-4, start="given")(flat(2.0))
    unit = made(decay(), start="given")
    assert validate_fmu(str(unit.path)) == []
    result = unit.simulate(flat(2.0), tolerance=1e-10)
    (event,) = run.events
    assert changes(result, "sup.mode") == [(pytest.approx(event.time, abs=1e-7), 1)]
    t = np.asarray(result["time"])
    calm = apart(t, [event.time])
    for signal in ("z_out", "x_out"):
        assert np.abs(result[signal] - between(run, signal, t))[calm].max() < 1e-7
    (rate,) = unit.description.derivatives
    assert [v.name for v in rate.dependencies] == ["x"]  # through z


class Plant(Block):
    """A lag whose input arrives through a loop without delay."""

    T = Parameter(0.2, "s", (0.01, 1.0), "time constant")
    u = Input("1", "in")
    y = Output("1", "out")
    x = State(0.0, "1", "lagged")

    def equations(self, s):
        return Equations(der={"x": (s.u - s.x) / s.T}, out={"y": s.x + 0.5 * s.u})


class Around(Block):
    """Feedback that bends: the loop has to be solved, not only eliminated."""

    k = Parameter(2.0, "1", (0.0, 10.0), "gain")
    v = Input("pu(V)", "voltage")
    y = Input("1", "measured")
    u = Output("1", "command")

    def equations(self, s):
        e = s.v - s.y
        return Equations(out={"u": s.k * e / (1 + e * e) ** 0.5})


def ring() -> Dae:
    d = Diagram("ring")
    re = d.input("v_poi.re", "pu(V)", rest=1.0)
    im = d.input("v_poi.im", "pu(V)")
    plant, around = d.add("plant", Plant()), d.add("around", Around())
    spare = d.add("spare", Plant())
    d.connect(re, around.v)
    d.connect(around.u, plant.u)
    d.connect(plant.y, around.y, implicit=True)
    d.connect(im, _as_ratio(d).v)
    d.connect(d.blocks["ratio"].y, spare.u)
    d.output("y", plant.y)
    d.output("u", around.u)
    d.output("side", spare.x)
    return d.compile()


class Ratio(Block):
    """A voltage as a plain number."""

    v = Input("pu(V)", "voltage")
    y = Output("1", "number")

    def equations(self, s):
        return Equations(out={"y": s.v})


def _as_ratio(d: Diagram) -> Ratio:
    return d.add("ratio", Ratio())


def test_an_implicit_wire_agrees_with_our_own_run(made: Make) -> None:
    dae = ring()
    assert dae.z.numel() == 1
    waveform = Waveform.segments([(0.0, 1.0), (0.1, 0.4), (0.3, 1.1)], until=0.6)
    run = Simulator(dae, Casadi("idas", 1e-11, 1e-13), save_at=1e-4)(waveform)
    unit = made(dae)
    assert validate_fmu(str(unit.path)) == []
    result = unit.simulate(waveform, tolerance=1e-10)
    t = np.asarray(result["time"])
    calm = apart(t, list(waveform.jumps))
    for signal in ("y", "u"):
        assert np.abs(result[signal] - between(run, signal, t))[calm].max() < 1e-7


def test_derivatives_go_through_the_algebraic_variables(made: Make) -> None:
    unit = made(ring())
    unknowns = unit.references("der(plant.x)", "y", "u")
    knowns, seed = unit.references("plant.x", "v_poi.re"), np.array([0.7, -0.4])
    with unit.instance() as fmu:
        start(fmu)
        x = column(fmu.getContinuousStates, 2)

        def values(step: float) -> np.ndarray:
            put_states(fmu, x + step * seed[0] * np.array([1.0, 0.0]))
            fmu.setFloat64(knowns[1:], [1.0 + step * seed[1]])
            return np.array(fmu.getFloat64(unknowns))

        h = 1e-3
        differences = (8 * (values(h) - values(-h)) - values(2 * h) + values(-2 * h)) / (12 * h)
        values(0.0)
        exact = fmu.getDirectionalDerivative(unknowns, knowns, seed.tolist())
    assert exact == pytest.approx(differences, rel=1e-8)
    with unit.instance() as fmu:
        fmu.enterInitializationMode()
        (slope,) = fmu.getDirectionalDerivative(unit.references("y"), unit.references("around.k"), [1.0])

        def output(k: float) -> float:
            fmu.setFloat64(unit.references("around.k"), [k])
            return fmu.getFloat64(unit.references("y"))[0]

        h = 1e-3
        difference = (8 * (output(2 + h) - output(2 - h)) - output(2 + 2 * h) + output(2 - 2 * h)) / (12 * h)
    assert slope == pytest.approx(difference, rel=1e-8)


def test_values_that_are_no_numbers_are_discarded_and_told(made: Make) -> None:
    s = Sketch({"x": 1.0}, {"k": 1.0})
    unit = made(s.dae({"x": -s.p["k"] * ca.sqrt(s.x["x"])}, {"x_out": s.x["x"]}), start="given")
    rates = np.zeros(1)
    with unit.instance() as fmu:
        start(fmu)
        put_states(fmu, np.array([-1.0]))
        with pytest.raises(Exception, match=r"fmi3GetContinuousStateDerivatives.*2"):
            column(lambda p, n: fmu.getContinuousStateDerivatives(_keep(rates), n), 1)
        assert np.isnan(rates).all()  # not what stood there before
        (message,) = unit.messages(fmi3.fmi3Discard)
        assert message.startswith("the derivative of x is")
        assert message.endswith("at 0 s (x = -1)")
        put_states(fmu, np.array([0.25]))
        assert fmu.getFloat64(unit.references("der(x)")) == [-0.5]


def test_an_algebraic_part_without_solution_is_told(made: Make) -> None:
    s = Sketch({"x": 1.0}, {"k": 1.0}, ["z"])
    z = s.z["z"]
    unit = made(s.dae({"x": -z}, {"z_out": z}, [z * z - s.x["x"] * s.p["k"]]), start="given")
    with unit.instance() as fmu:
        start(fmu)
        put_states(fmu, np.array([-1.0]))
        with pytest.raises(Exception, match="fmi3GetFloat64"):
            fmu.getFloat64(unit.references("z"))
        assert unit.messages(fmi3.fmi3Discard) == ["no consistent value of z at 0 s"]
        put_states(fmu, np.array([0.25]))  # the next point is found all the same
        assert fmu.getFloat64(unit.references("z", "der(x)")) == pytest.approx([0.5, -0.5], abs=1e-12)


def _keep(values: np.ndarray) -> object:
    import ctypes

    return values.ctypes.data_as(ctypes.POINTER(ctypes.c_double))


# -- parameters that do not go together ---------------------------------------------------------------------


def test_a_bound_parameter_stays_within_the_bounds_of_its_block(made: Make) -> None:
    d = Diagram("bound")
    gain = d.parameter("H", 2.0, "1", (0.0, 100.0))
    leak = d.add("leak", Leak())
    d.bind(leak, k=3 * gain)
    d.output("x", leak.x)
    unit = made(d.compile())
    with unit.instance() as fmu:
        fmu.setFloat64(unit.references("H"), [20.0])
        fmu.enterInitializationMode()
        with pytest.raises(Exception, match="fmi3ExitInitializationMode"):
            fmu.exitInitializationMode()
        assert unit.messages() == ["leak.k (bound to 3*H) = 60 1/s is outside [0, 10]."]


class Leak(Block):
    """x' = -k x."""

    k = Parameter(1.0, "1/s", (0.0, 10.0), "rate", "test")
    x = State(0.0, "1", "what is left")

    def equations(self, s: object) -> Equations:
        return Equations(der=dict(x=-s.k * s.x))  # type: ignore[attr-defined]


# -- calls out of order -------------------------------------------------------------------------------------


def test_a_call_out_of_order_says_so(made: Make) -> None:
    unit = made(timer())
    with unit.instance() as fmu:
        with pytest.raises(Exception, match="fmi3UpdateDiscreteStates"):
            fmu.updateDiscreteStates()
        assert unit.messages() == ["fmi3UpdateDiscreteStates cannot be called before initialization."]
        fmu.reset()
        start(fmu)
        fmu.enterEventMode()
        assert settle(fmu) == (False, None, 1)


def test_a_variable_of_another_type_says_so(made: Make) -> None:
    unit = made(timer())
    with unit.instance() as fmu:
        with pytest.raises(Exception, match="fmi3GetInt32"):
            fmu.getInt32([1])
        assert unit.messages() == ["fmi3GetInt32: there is no such variable."]


def test_a_description_of_another_build_is_refused(made: Make) -> None:
    unit = made(timer())
    unit.description.guid = "0" * 64
    with pytest.raises(Exception, match="Failed to instantiate FMU"), unit.instance():
        pass
    assert unit.messages() == [
        "The instantiation token is not that of this binary: modelDescription.xml belongs to another one."
    ]
