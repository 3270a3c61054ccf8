"""Every shipped facility as an FMU: valid, and the same trajectory as ours in another tool's hands."""

from __future__ import annotations

import cmath
import math
from functools import cache
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from fmpy import fmi3
from fmpy.validation import validate_fmu

from dcvrt import Simulator, Waveform, facility
from dcvrt.dae import Dae
from dcvrt.integrators import Casadi
from tests.fmi.tools import Unit, apart, between, changes, column, put_states, settle, start

SIGNALS = ("v_it", "p_g", "q_g", "p_b", "soc", "w_dc")


def turned(magnitude: float, degrees: float) -> complex:
    return cmath.rect(magnitude, math.radians(degrees))


WAVEFORMS = {
    "sag with phase jumps": Waveform.segments(
        [(0.0, 1.0), (0.1, turned(0.7, -20)), (0.2, turned(0.95, 8)), (0.5, 1.0)], until=0.9
    ),
    "swell": Waveform.segments([(0.0, 1.0), (0.1, 1.15), (0.25, 1.0)], until=0.8),
    "deep fault": Waveform.segments([(0.0, 1.0), (0.1, turned(0.2, -30)), (0.3, 1.0)], until=1.8),
}


@cache
def system(name: str) -> Dae:
    return facility.get(name).compile()


@cache
def simulator(name: str) -> Simulator:
    dae = system(name)
    plugin = "rosenbrock" if dae.z.numel() else "erk"
    return Simulator(dae, Casadi(plugin, 1e-11, 1e-13), save_at=1e-4)


@pytest.fixture(scope="module")
def units(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Unit]:
    return {}


@pytest.fixture
def unit(name: str, units: dict[str, Unit], tmp_path_factory: pytest.TempPathFactory) -> Unit:
    if name not in units:
        diagram = facility.get(name)
        folder = tmp_path_factory.mktemp(name)
        units[name] = Unit.of(system(name), folder, doc=diagram.doc, sheet=diagram.sheet())
    return units[name]


QUICK = ("gfl", "gfm")
every_variant = pytest.mark.parametrize(
    "name",
    [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in facility.names()],
)
gfl_only = pytest.mark.parametrize("name", ["gfl"])


@every_variant
def test_fmpy_has_nothing_to_complain_about(unit: Unit) -> None:
    assert validate_fmu(str(unit.path)) == []
    assert validate_fmu(str(unit.folder)) == []


@every_variant
@pytest.mark.parametrize("kind", WAVEFORMS)
def test_the_trajectory_is_ours(name: str, unit: Unit, kind: str) -> None:
    waveform = WAVEFORMS[kind]
    run = simulator(name).attempt(waveform, beta=1.1)
    result = unit.simulate(waveform, tolerance=1e-10, start_values={"beta": 1.1})
    ours = {
        a.path: [(e.time, a.mode_number(e.target)) for e in run.events if e.automaton == a.path]
        for a in run_automata(name)
    }
    for path, expected in ours.items():
        seen = changes(result, f"{path}.mode")
        at_last = settled(expected)
        assert [mode for _, mode in seen] == [mode for _, mode in at_last]
        assert [t for t, _ in seen] == pytest.approx([t for t, _ in at_last], abs=1e-6)
    assert result["time"][-1] == pytest.approx(run.t[-1], abs=1e-6)
    t = np.asarray(result["time"])
    calm = apart(t, [*waveform.jumps, *(e.time for e in run.events)])
    assert calm.sum() > 500
    for signal in SIGNALS:
        worst = np.abs(np.asarray(result[signal]) - between(run, signal, t))[calm].max()
        assert worst <= 1e-6, f"{signal}: {worst:.1e}"


def run_automata(name: str) -> tuple:
    return system(name).automata


def settled(jumps: list[tuple[float, int]]) -> list[tuple[float, int]]:
    """Of several jumps at one instant the last: an importer sees only where they end."""
    return [jump for k, jump in enumerate(jumps) if k + 1 == len(jumps) or jumps[k + 1][0] - jump[0] > 1e-9]


def test_the_waveforms_exercise_dwell_times_and_returns() -> None:
    """Else the comparison above would show little."""
    run = simulator("gfl")(WAVEFORMS["deep fault"], beta=1.1)
    assert [e.target for e in run.events] == ["MIXED", "BATTERY", "RETURN", "NORMAL"]
    assert any("held" in e.row for e in run.events)


@every_variant
def test_it_starts_at_our_equilibrium(name: str, unit: Unit) -> None:
    dae = system(name)
    voltage, values = turned(0.96, 7.0), {"H": 1.3, "beta": 1.2, "d": 0.8}
    run = simulator(name)(Waveform.segments([(0.0, voltage)], until=1e-3), **values)
    with unit.instance() as fmu:
        start(
            fmu,
            {
                **{unit.reference(n): v for n, v in values.items()},
                unit.reference("v_poi.re"): voltage.real,
                unit.reference("v_poi.im"): voltage.imag,
            },
        )
        x = column(fmu.getContinuousStates, len(dae.states))
        y = fmu.getFloat64(unit.references(*dae.y_names))
    assert x == pytest.approx(run.states.value[0], abs=1e-9)
    assert y == pytest.approx(run.outputs.value[0], abs=1e-9)


# -- parameters ---------------------------------------------------------------------------------------------


@gfl_only
def test_parameters_carry_value_bounds_unit_and_meaning(name: str, unit: Unit) -> None:
    variables = {v.name: v for v in unit.description.modelVariables}
    for row in system(name).parameter_rows:
        v = variables[row.path]
        assert (v.causality, v.variability, v.unit) == ("parameter", "fixed", row.unit)
        assert (float(v.start), float(v.min), float(v.max)) == (row.value, *row.bounds)
        assert v.description == f"{row.doc} [{row.source}]"
    for k, row in enumerate(system(name).states):
        assert variables[row.path].causality == "local"
        assert variables[f"der({row.path})"].derivative.name == row.path
        assert unit.description.derivatives[k].variable.name == f"der({row.path})"
    units = {u.name: u for u in unit.description.unitDefinitions}
    rate = units["rad/s2/pu(V)"].baseUnit
    assert (rate.rad, rate.s, rate.factor) == (1, -2, 1.0)


@gfl_only
def test_modes_are_an_enumeration(name: str, unit: Unit) -> None:
    (mode,) = [v for v in unit.description.modelVariables if v.name == "sup.mode"]
    assert (mode.type, mode.causality, mode.variability) == ("Enumeration", "output", "discrete")
    items = [(int(item.value), item.name) for item in mode.declaredType.items]
    assert items == list(enumerate(system(name).automata[0].modes))


@gfl_only
def test_dependencies_are_those_of_the_equations(name: str, unit: Unit) -> None:
    dae = system(name)
    knowns = [*dae.x_names, *dae.u_names]
    pattern = ca.DM(ca.jacobian(dae.f, ca.vertcat(dae.x, dae.u)).sparsity(), 1).full()
    for k, unknown in enumerate(unit.description.derivatives):
        named = {v.name for v in unknown.dependencies} - {"time"}
        assert named == {n for n, there in zip(knowns, pattern[k], strict=True) if there}


@gfl_only
def test_a_parameter_changes_the_run_and_reset_takes_it_back(name: str, unit: Unit) -> None:
    imports = []
    for beta in (1.05, 1.3):
        result = unit.simulate(WAVEFORMS["sag with phase jumps"], start_values={"beta": beta})
        imports.append(result["p_g"][np.searchsorted(result["time"], 0.19)])
    assert imports[1] > imports[0] + 0.05
    beta = unit.references("beta")
    with unit.instance() as fmu:
        start(fmu, {beta[0]: 1.3})
        fmu.setTime(0.25)
        fmu.terminate()
        fmu.reset()
        assert fmu.getFloat64(beta) == [system(name).parameter_rows[1].value]
        start(fmu)
        assert fmu.getFloat64(unit.references("time")) == [0.0]


@gfl_only
def test_a_parameter_outside_its_bounds_is_refused(unit: Unit) -> None:
    with unit.instance() as fmu:
        with pytest.raises(Exception, match="fmi3SetFloat64"):
            fmu.setFloat64(unit.references("beta"), [9.0])
        assert unit.messages() == ["beta = 9 1 is outside [0.8, 2]."]


@gfl_only
def test_parameters_without_hysteresis_are_refused(unit: Unit) -> None:
    with unit.instance() as fmu:
        fmu.setFloat64(unit.references("sup.V_back"), [0.6])
        fmu.enterInitializationMode()
        with pytest.raises(Exception, match="fmi3ExitInitializationMode"):
            fmu.exitInitializationMode()
        (message,) = unit.messages()
        assert "leave no gap between them" in message
        assert "V_back = 0.6" in message


@gfl_only
def test_a_parameter_is_fixed_after_the_initialization(unit: Unit) -> None:
    with unit.instance() as fmu:
        start(fmu)
        with pytest.raises(Exception, match="fmi3SetFloat64"):
            fmu.setFloat64(unit.references("beta"), [1.2])
        assert unit.messages() == ["beta is fixed: set it before the end of the initialization."]


@gfl_only
def test_an_input_that_is_no_number_is_refused(unit: Unit) -> None:
    with unit.instance() as fmu:
        with pytest.raises(Exception, match="fmi3SetFloat64"):
            fmu.setFloat64(unit.references("v_poi.re"), [math.nan])
        assert unit.messages() == ["the input v_poi.re was set to nan at 0 s."]


@gfl_only
def test_without_an_equilibrium_the_log_names_the_residuals(unit: Unit) -> None:
    with unit.instance() as fmu:
        fmu.setFloat64(unit.references("v_poi.re", "v_poi.im"), [0.3, 0.0])
        fmu.enterInitializationMode()
        with pytest.raises(Exception, match="fmi3ExitInitializationMode"):
            fmu.exitInitializationMode()
        (message,) = unit.messages()
        lines = message.splitlines()
        assert lines[0] == "gfl: no equilibrium at the first value of the inputs. Largest residuals:"
        assert lines[-1] == "Check start values of inputs and parameters."
        assert len(lines) == 7
        assert all("d(" in line and ")/dt = " in line for line in lines[1:6])


# -- instances ----------------------------------------------------------------------------------------------


@gfl_only
def test_a_run_repeats_to_the_last_bit(unit: Unit) -> None:
    one, two = (unit.simulate(WAVEFORMS["deep fault"]) for _ in range(2))
    assert one.tobytes() == two.tobytes()


@gfl_only
def test_two_instances_do_not_touch_each_other(unit: Unit) -> None:
    names = unit.references("v_it", "p_g", "w_dc")
    volt = unit.references("v_poi.re")
    with unit.instance() as alone:
        start(alone)
        expected = alone.getFloat64(names)
    with unit.instance() as one, unit.instance() as two:
        start(one)
        start(two, {unit.reference("beta"): 1.3, unit.reference("d"): 0.5})
        two.enterEventMode()
        two.setFloat64(volt, [0.5])
        settle(two)
        assert one.getFloat64(names) == expected
        assert two.getFloat64(names) != expected
        assert one.getFloat64(volt) == [1.0]


@gfl_only
def test_a_saved_instance_goes_on_as_it_would_have(unit: Unit) -> None:
    names, volt = unit.references("v_it", "p_g", "w_dc"), unit.references("v_poi.re")
    mode, n = unit.references("sup.mode"), 11
    with unit.instance() as fmu:
        start(fmu)
        fmu.enterEventMode()
        fmu.setFloat64(volt, [0.5])
        settle(fmu)
        fmu.enterContinuousTimeMode()
        x = column(fmu.getContinuousStates, n)
        state = fmu.getFMUState()
        kept = fmu.serializeFMUState(state)
        before = fmu.getFloat64(names)

        fmu.setTime(0.3)
        put_states(fmu, x * 0.9)
        fmu.enterEventMode()
        settle(fmu)
        assert (fmu.getFloat64(names), fmu.getInt64(mode)) != (before, [0])

        fmu.setFMUState(state)
        assert fmu.getFloat64(names) == before
        assert column(fmu.getContinuousStates, n) == pytest.approx(x, abs=0)
        fmu.freeFMUState(state)
    with unit.instance() as other:  # in another instance, from bytes
        state = other.deserializeFMUState(kept)
        other.setFMUState(state)
        assert other.getFloat64(names) == before
        other.freeFMUState(state)
        with pytest.raises(Exception, match="fmi3DeserializeFMUState"):
            other.deserializeFMUState(b"x" + kept[1:])
        assert unit.messages() == ["fmi3DeserializeFMUState: the bytes were saved by another model."]


# -- derivatives --------------------------------------------------------------------------------------------


def outputs_of(fmu: fmi3.FMU3Model, unknowns: list[int]) -> np.ndarray:
    return np.array(fmu.getFloat64(unknowns))


@every_variant
def test_directional_derivatives_are_differences(name: str, unit: Unit) -> None:
    dae = system(name)
    random = np.random.default_rng(7)
    n, unknowns = len(dae.states), unit.references(*(f"der({x})" for x in dae.x_names), *dae.y_names)
    knowns = unit.references(*dae.x_names, *dae.u_names)
    with unit.instance() as fmu:
        start(fmu)
        x = column(fmu.getContinuousStates, n) * (1 + 0.02 * random.standard_normal(n))
        u = np.array(fmu.getFloat64(unit.references(*dae.u_names))) + 0.02 * random.standard_normal(3)
        seed = random.standard_normal(n + 3)

        def at(step: float) -> np.ndarray:
            put_states(fmu, x + step * seed[:n])
            fmu.setFloat64(knowns[n:], (u + step * seed[n:]).tolist())
            return outputs_of(fmu, unknowns)

        step = 1e-5
        differences = (8 * (at(step) - at(-step)) - at(2 * step) + at(-2 * step)) / (12 * step)
        at(0.0)
        exact = np.array(fmu.getDirectionalDerivative(unknowns, knowns, seed.tolist()))
    assert np.abs(exact).max() > 1
    assert exact == pytest.approx(differences, rel=1e-6, abs=1e-6)


@every_variant
def test_derivatives_of_the_equilibrium_are_differences(name: str, unit: Unit) -> None:
    dae = system(name)
    given = {"beta": 1.1, "d": 0.9, "pf": 0.97, "v_poi.re": 0.98, "v_poi.im": 0.05}
    knowns, seed = unit.references(*given), np.array([0.3, 1.0, -0.2, 0.5, 0.7])
    unknowns = unit.references(*dae.x_names, *dae.y_names)

    def at(step: float) -> np.ndarray:
        with unit.instance() as fmu:
            fmu.enterInitializationMode()
            fmu.setFloat64(knowns, (np.array(list(given.values())) + step * seed).tolist())
            return outputs_of(fmu, unknowns)

    step = 1e-4
    differences = (8 * (at(step) - at(-step)) - at(2 * step) + at(-2 * step)) / (12 * step)
    with unit.instance() as fmu:
        fmu.enterInitializationMode()
        fmu.setFloat64(knowns, list(given.values()))
        exact = np.array(fmu.getDirectionalDerivative(unknowns, knowns, seed.tolist()))
    assert np.abs(exact).max() > 0.1
    assert exact == pytest.approx(differences, rel=1e-5, abs=1e-6)


# -- other solvers ------------------------------------------------------------------------------------------


@gfl_only
def test_a_fixed_step_solver_meets_the_events_too(name: str, unit: Unit) -> None:
    """Euler's method is of first order, and an event is late by up to a step; the sequence is the same."""
    waveform = WAVEFORMS["deep fault"]
    run = simulator(name)(waveform)
    result = unit.simulate(waveform, solver="Euler", step_size=1e-4, interval=1e-3)
    seen = changes(result, "sup.mode")
    assert [mode for _, mode in seen] == [
        ("NORMAL", "MIXED", "BATTERY", "RETURN").index(e.target) for e in run.events
    ]
    assert [t for t, _ in seen] == pytest.approx([e.time for e in run.events], abs=5e-3)
    assert result["w_dc"][-1] == pytest.approx(run["w_dc"][-1], abs=5e-3)


@gfl_only
def test_the_end_of_a_step_tells_of_an_event_that_nobody_located(unit: Unit) -> None:
    n, meter = 11, 1
    with unit.instance() as fmu:
        start(fmu)
        x = column(fmu.getContinuousStates, n)
        assert fmu.completedIntegratorStep() == (False, False)
        x[meter] = 0.8
        fmu.setTime(0.05)
        put_states(fmu, x)
        assert fmu.completedIntegratorStep() == (True, False)
        fmu.enterEventMode()
        settle(fmu)
        assert fmu.getInt64(unit.references("sup.mode")) == [1]


# -- what is inside -----------------------------------------------------------------------------------------


@gfl_only
def test_the_same_model_makes_the_same_bytes(name: str, unit: Unit, tmp_path: Path) -> None:
    diagram = facility.get(name)
    again = Unit.of(diagram.compile(), tmp_path, doc=diagram.doc, sheet=diagram.sheet())
    assert again.path.read_bytes() == unit.path.read_bytes()
    other = facility.get(name)
    other.set("beta", 1.25)
    changed = Unit.of(other.compile(), tmp_path, doc=diagram.doc, sheet=diagram.sheet(), overwrite=True)
    assert changed.description.guid != unit.description.guid


@gfl_only
def test_nothing_inside_names_this_machine(unit: Unit) -> None:
    here = [str(Path.home()), str(Path(__file__).parents[2]), str(unit.folder), "/tmp/"]
    for file in (f for f in unit.folder.rglob("*") if f.is_file()):
        content = file.read_bytes()
        assert not [place for place in here if place.encode() in content], file


@gfl_only
def test_sources_documentation_and_licences_are_inside(unit: Unit) -> None:
    page = (unit.folder / "documentation/index.html").read_text()
    assert "Changes of mode, tried from top to bottom" in page
    assert "# gfl" in page
    assert "http" not in page.split("<pre>")[0]
    licences = (unit.folder / "documentation/licenses/license.txt").read_text()
    assert "GPL-3.0-or-later" in licences
    assert "BSD-2-Clause" in licences
    (configuration,) = unit.description.buildConfigurations
    (sources,) = configuration.sourceFileSets
    assert all((unit.folder / "sources" / file).is_file() for file in sources.sourceFiles)
