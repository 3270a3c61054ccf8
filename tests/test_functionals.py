"""Functionals of trajectories: closed forms, gradients against differences, columns of a batch, bad input."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from dcvrt import facility
from dcvrt.criteria import Criteria, margins
from dcvrt.errors import InputError
from dcvrt.functionals import (
    Functional,
    Initial,
    Integral,
    Maximum,
    Minimum,
    RecoveryTime,
    SustainedMaximum,
    SustainedMinimum,
    TimeAbove,
    TimeBelow,
    evaluate,
)
from dcvrt.integrators import Casadi, Simulator
from dcvrt.waveform import Waveform
from tests.integrators.systems import Sketch
from tests.test_criteria import Function, sampled, start

Pieces = list[tuple[Callable[[float], float], Function]]


def check_gradient(pieces: Pieces, theta: float, f: Functional, h: float = 1e-4) -> float:
    """Gradient equals the central difference; the value is returned."""
    found = f.of(sampled(pieces, theta, 1.0))
    up, down = (f.of(sampled(pieces, theta + s * h, 1.0)).value for s in (1, -1))
    assert found.grad["theta"] == pytest.approx((up - down) / (2 * h), rel=2e-5, abs=1e-7)
    return found.value


WAVE: Pieces = [(start, lambda t, p: np.cos(p * t))]
STEPS: Pieces = [
    (start, lambda t, p: 1 + 0 * t),
    (lambda p: p * p, lambda t, p: 0.2 + 0 * t),
    (lambda p: 0.9 * p, lambda t, p: 1.5 + 0 * t),
]


def test_times_in_closed_form() -> None:
    """cos(p t) on [0, 1] is below 1/2 from pi/(3 p) on, until 5 pi/(3 p)."""
    p = 6.0
    below = check_gradient(WAVE, p, TimeBelow("y", 0.5))
    assert below == pytest.approx(4 * np.pi / (3 * p), abs=1e-9)
    assert check_gradient(WAVE, p, TimeAbove("y", 0.5)) == pytest.approx(1 - below, abs=1e-9)
    assert check_gradient(WAVE, p, RecoveryTime("y", 0.5)) == pytest.approx(below, abs=1e-9)
    assert check_gradient(WAVE, p, RecoveryTime("y", share=0.5)) == pytest.approx(below, abs=1e-9)
    assert RecoveryTime("y", -2.0).of(sampled(WAVE, p, 1.0)).value == 0.0
    late = RecoveryTime("y", 0.97).of(sampled(WAVE, p, 1.0))
    assert late.value == np.inf
    assert np.isnan(late.grad["theta"])


def test_integrals_in_closed_form() -> None:
    p = 6.0
    assert check_gradient(WAVE, p, Integral("y")) == pytest.approx(np.sin(p) / p, abs=1e-12)
    positive = check_gradient(WAVE, p, Integral("y", positive=True))
    assert positive == pytest.approx((2 + np.sin(p)) / p, abs=1e-12)


def test_events_move_times_and_integrals() -> None:
    """Steps at p^2 and 0.9 p: everything depends on theta through the times of the events alone."""
    p = 0.6
    assert check_gradient(STEPS, p, TimeBelow("y", 0.9)) == pytest.approx(0.9 * p - p * p, abs=1e-12)
    assert check_gradient(STEPS, p, RecoveryTime("y", share=0.9)) == pytest.approx(0.18, abs=1e-12)
    assert check_gradient(STEPS, p, Integral("y")) == pytest.approx(
        p * p + 0.2 * (0.9 * p - p * p) + 1.5 * (1 - 0.9 * p), abs=1e-12
    )


def test_a_maximum_is_a_minimum_of_the_negative_signal() -> None:
    dip: Pieces = [(start, lambda t, p: 1 - p * np.exp(-(((t - 0.5) / 0.1) ** 2)))]
    hump: Pieces = [(start, lambda t, p: p * np.exp(-(((t - 0.5) / 0.1) ** 2)) - 1)]
    for low, high in ((Minimum("y"), Maximum("y")), (SustainedMinimum("y", 0.1), SustainedMaximum("y", 0.1))):
        below, above = low.of(sampled(dip, 0.4, 1.0)), high.of(sampled(hump, 0.4, 1.0))
        assert above.value == -below.value
        assert above.grad["theta"] == -below.grad["theta"]
        assert (above.time, above.kind) == (below.time, below.kind)
    assert Initial("y").of(sampled(WAVE, 6.0, 1.0)).value == 1.0


SAG = Waveform.segments([(0.0, 1.0), (0.1, 0.55), (0.25, 0.97)], until=0.6)


@pytest.fixture(scope="module")
def simulator() -> Simulator:
    return Simulator(facility.gfl().compile(), Casadi("erk", 1e-9, 1e-11), wrt=("beta", "dc.T_hold"))


def test_one_output_over_another(simulator: Simulator) -> None:
    run = simulator(SAG, beta=1.1)
    found = Maximum("i_g", per="i_max").of(run)
    assert found.value == pytest.approx(float(np.max(run["i_g"] / run["i_max"])), abs=1e-5)
    assert found.value >= float(np.max(run["i_g"] / run["i_max"]))
    h = 1e-4
    for f in (Initial("i_g", per="i_max"), Integral("i_g", per="i_max")):
        up, down = (f.of(simulator(SAG, beta=1.1 + s * h)).value for s in (1, -1))
        assert f.of(run).grad["beta"] == pytest.approx((up - down) / (2 * h), rel=1e-4), f


def test_functionals_are_columns_of_a_batch(simulator: Simulator) -> None:
    asked = {"v": SustainedMinimum("v_it", 0.02), "low": TimeBelow("v_it", 0.95)}
    result = simulator.batch([SAG], {"beta": [1.1, 1.2]}, functionals=asked, criteria=Criteria())
    table = result.table()
    columns = ["v", "d_v/d_beta", "d_v/d_dc.T_hold", "v_time", "v_kind", "v_tie", "low", "d_low/d_beta"]
    assert set(columns) <= set(table.columns)
    assert "low_time" not in table.columns
    run = simulator(SAG, beta=1.2)
    alone = asked["v"].of(run)
    assert (table["v"][1], table["d_v/d_beta"][1], table["v_kind"][1]) == (
        alone.value,
        alone.grad["beta"],
        alone.kind,
    )
    judged = margins(run)
    assert result.functionals[1]["v"].value - 0.9 == judged.voltage.value
    assert result.margins[1] == judged
    assert simulator.batch([SAG], {}, functionals=asked).margins == (None,)


def test_a_case_without_import_is_a_labelled_row() -> None:
    s = Sketch({"x": 1.0}, {"P": 1.0})
    dae = s.dae({"x": 1.0 - s.x["x"]}, {"v_it": s.v[0], "p_g": s.p["P"] * s.x["x"]})
    result = Simulator(dae).batch([SAG], {"P": [1.0, 0.0]}, criteria=Criteria())
    assert result.margins[0] is not None
    assert result.failed == (1,)
    assert result.status[1].startswith("margins: the import before the fault is p_g = ")


def test_what_cannot_be_asked_of_a_batch(simulator: Simulator) -> None:
    def refused(**options: object) -> str:
        with pytest.raises(InputError) as error:
            simulator.batch([SAG], {"beta": [1.1]}, **options)  # type: ignore[arg-type]
        return str(error.value)

    known = ", ".join(simulator.dae.y_names[:12])
    more = len(simulator.dae.y_names)
    known += f", ... ({more} in all)" if more > 12 else ""
    assert refused(functionals={"a": Minimum("v_its"), "b": SustainedMinimum("v_it", 2.0), "c": 3}) == (
        "batch: 3 problems\n"
        f"  functional 'a': the system has no output 'v_its'. Did you mean 'v_it'? Known: {known}.\n"
        "  functional 'b': the run lasts 0.6 s, less than the window of 2 s.\n"
        "  functional 'c' = 3 is none. Way out: Minimum('v_it'), for example."
    )
    assert refused(functionals=[Minimum("v_it")]).endswith(
        "must be a mapping of names to functionals. Way out: functionals={'v': Minimum('v_it')}."
    )
    assert refused(functionals={"beta": Minimum("v_it"), "status": Minimum("v_it")}) == (
        "batch: functionals with the name of another column: 'beta', 'status'. Way out: other names."
    )
    assert refused(criteria=Criteria(window=5.0)) == (
        "batch: criteria: the run lasts 0.6 s, less than the window of 5 s."
    )


def test_declarations_that_make_no_sense() -> None:
    with pytest.raises(InputError) as error:
        SustainedMinimum("v_it", -1.0)
    assert str(error.value) == "SustainedMinimum of v_it: window = -1 s must be a time, 0 or longer."
    for options in ({}, {"level": 0.9, "share": 0.9}, {"level": np.nan}):
        with pytest.raises(InputError) as error:
            TimeBelow("v_it", **options)
        given = ", ".join(f"{k} = {options.get(k)}" for k in ("level", "share"))
        assert str(error.value) == f"TimeBelow of v_it: {given}: give one of the two, a finite number."


def test_runs_that_have_no_functional(simulator: Simulator) -> None:
    run = simulator(SAG)
    with pytest.raises(InputError) as error:
        SustainedMinimum("v_it", 1.0).of(run)
    assert str(error.value) == (
        "functionals: SustainedMinimum of v_it: the run lasts 0.6 s, less than the window of 1 s."
    )
    with pytest.raises(InputError) as error:
        Minimum("dc.w").of(run)
    assert str(error.value) == (
        "'dc.w' is not among the outputs of the system: its rate is not kept. Way out: make it an output."
    )
    object.__setattr__(run, "status", "DC link collapsed at 0.320 s")
    with pytest.raises(InputError) as error:
        evaluate({"v": Minimum("v_it")}, run)
    assert str(error.value) == "functionals: the run has no result to judge: DC link collapsed at 0.320 s."
