"""Equilibrium as a step of its own: the point by name, and a refusal that names what is not at rest."""

from __future__ import annotations

import numpy as np
import pytest

from dcvrt import Simulator, Waveform, facility
from dcvrt.errors import InputError, SimulationError
from dcvrt.integrators import Casadi
from tests.integrators.systems import Sketch, decay, flat

approx = pytest.approx


@pytest.mark.parametrize("name", ["gfl", "gfm"])
@pytest.mark.parametrize("v", [1.0, 0.93 * np.exp(0.4j)])
def test_it_is_where_a_run_starts_and_stays(name: str, v: complex) -> None:
    simulator = Simulator(facility.get(name).compile(), Casadi("erk", 1e-10, 1e-12))
    at = simulator.equilibrium(v, beta=1.2, d=0.9)
    run = simulator(Waveform.segments([(0.0, v)], until=0.2), beta=1.2, d=0.9)
    assert not run.events
    for k, state in enumerate(at.dae.x_names):
        np.testing.assert_allclose(run[state], at.x[k], atol=1e-7, err_msg=state)
    for k, output in enumerate(at.dae.y_names):
        np.testing.assert_allclose(run[output][0], at.y[k], atol=1e-9, err_msg=output)


def test_inputs_and_parameters_by_name() -> None:
    simulator = Simulator(facility.gfl().compile())
    half = simulator.equilibrium(inputs={"g_it": 0.5}, beta=1.4)
    assert (half["g_it"], half["beta"], half["v_poi.re"]) == (0.5, 1.4, 1.0)
    assert half["p_it"] == approx(0.5 * simulator.equilibrium(1.0)["p_it"], rel=1e-4)


def test_algebraic_variables_are_part_of_the_point() -> None:
    s = Sketch({"x": 1.0}, {"k": 2.0}, ["z"])
    dae = s.dae({"x": s.v[0] - s.z["z"]}, {"z_out": s.z["z"]}, [s.z["z"] - s.p["k"] * s.x["x"]])
    at = Simulator(dae).equilibrium(0.8, k=4.0)
    assert (at["x"], at["z"], at["z_out"]) == (approx(0.2), approx(0.8), approx(0.8))
    assert set(at.residuals) == {"d(x)/dt", "residual of z"}
    assert max(map(abs, at.residuals.values())) < 1e-9


def test_a_battery_that_drains_is_no_equilibrium_and_is_told_in_which_mode() -> None:
    simulator = Simulator(facility.gfl().compile())
    with pytest.raises(SimulationError) as error:
        simulator.equilibrium(1.0, modes={"sup": "BATTERY"})
    first, *worst, ways_out = str(error.value).splitlines()
    assert first == "gfl: no equilibrium at v_poi = 1. Largest residuals in mode sup BATTERY:"
    assert len(worst) == 5
    names = [line.split(" = ")[0].strip() for line in worst]
    assert "d(dc.w)/dt" in names
    assert "d(bess.p)/dt" in names
    sizes = [abs(float(line.split(" = ")[1].split()[0])) for line in worst]
    assert sizes == sorted(sizes, reverse=True)
    assert worst[names.index("d(bess.p)/dt")].endswith(" pu(S)/s")
    assert ways_out == (
        "Ways out: parameters or an input at which these equations can all be zero (a facility must be able "
        "to import its load before the disturbance: beta |V| above the load factor d); better start values "
        "(State(start), rest()); start='given' for a system that never rests."
    )


def test_a_failed_start_of_a_run_is_told_on_its_full_text() -> None:
    s = Sketch({"a": 0.5, "b": 0.0}, {"k": 0.25}, ["z"])
    s.automaton("one", {"calm": (0.0,), "wild": (1.0,)}, "calm")
    s.automaton("two", {"off": (0.0,)}, "off")
    dae = s.dae({"a": s.x["a"] ** 2 + 1.0, "b": 2.0}, {"b_out": s.x["b"]}, [s.z["z"] - s.p["k"]])
    with pytest.raises(SimulationError) as error:
        Simulator(dae)(flat())
    assert str(error.value) == (
        "sketch: no equilibrium at the first value of the waveform. "
        "Largest residuals in mode one calm, two off:\n"
        "  d(b)/dt = 2 1/s\n"
        "  d(a)/dt = 1.25 1/s\n"
        "  residual of z = 0.75\n"
        "Ways out: parameters or an input at which these equations can all be zero (a facility must be able "
        "to import its load before the disturbance: beta |V| above the load factor d); better start values "
        "(State(start), rest()); start='given' for a system that never rests."
    )


def test_unknown_names_are_refused() -> None:
    simulator = Simulator(facility.gfl().compile())
    for arguments, text in (
        ({"inputs": {"g_i": 1.0}}, "gfl has no input 'g_i'. Did you mean 'g_it'? "
                                   "Known: v_poi.re, v_poi.im, g_it."),
        ({"modes": {"sup": "BATERY"}}, "sup has no mode 'BATERY'. Did you mean 'BATTERY'? "
                                       "Known: NORMAL, MIXED, BATTERY, RETURN."),
        ({"beta": 9.0}, "beta = 9 is outside [0.8, 2]."),
    ):  # fmt: skip
        with pytest.raises(InputError) as error:
            simulator.equilibrium(1.0, **arguments)
        assert str(error.value) == text


def test_a_system_without_a_phasor_takes_no_voltage() -> None:
    from dataclasses import replace

    dae = decay()
    scalar = replace(dae, inputs=(dae.inputs[1], dae.inputs[1]))
    with pytest.raises(InputError) as error:
        Simulator(scalar).equilibrium(1.0)
    assert str(error.value) == "sketch has no phasor input for v = 1. Way out: inputs={name: value}."
