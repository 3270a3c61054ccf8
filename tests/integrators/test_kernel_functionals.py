"""Functionals inside the compiled run of a facility: against trajectories, and against differences."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
import pytest

from dcvrt import facility
from dcvrt.criteria import Criteria, margins, needed
from dcvrt.dae import Dae
from dcvrt.functionals import (
    Functional,
    Integral,
    Maximum,
    SustainedMaximum,
    SustainedMinimum,
    TimeAbove,
    TimeBelow,
    evaluate,
)
from dcvrt.integrators import Casadi, Simulator
from dcvrt.integrators.batch import BatchResult
from dcvrt.integrators.compiler import find_compiler
from dcvrt.integrators.kernel import Kernel, build
from dcvrt.waveform import Waveform

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")

THETAS = ("beta", "dc.T_hold", "bess.T_b", "sup.w_sag")
MODES = ("gfl", "gfm")
WAVEFORMS = {
    "deep": Waveform.segments(
        [(0.0, 1.0), (0.1, 0.4 * np.exp(-0.3j)), (0.25, 0.97, 1.0), (0.6, 1.0)], until=0.7
    ),
    "dip": Waveform.segments([(0.0, 1.0), (0.1, 0.82), (0.3, 1.0)], until=0.6),
    "twice": Waveform.segments(
        [(0.0, 0.98), (0.1, 0.3), (0.2, 0.95), (0.4, 0.3), (0.5, 1.05), (0.8, 1.0)], until=1.2
    ),
}
ENERGY_GUARDS = {
    "beta": 1.05, "sup.V_dip": 0.3, "sup.V_low": 0.25, "sup.V_deep": 0.2, "sup.V_back": 0.9,
    "bus.k_line": 0.0,
}  # fmt: skip
"""Supervision that the DC energy sets off, so that times of events depend on every theta."""


def cases(mode: str) -> dict[str, tuple[Waveform, dict[str, float]]]:
    slow = {**ENERGY_GUARDS, "bess.T_b": {"gfl": 0.05, "gfm": 0.01}[mode]}
    plain = {name: (wave, {"beta": 1.1}) for name, wave in WAVEFORMS.items()}
    return plain | {"energy": (WAVEFORMS["deep"], slow)}


@cache
def system(mode: str) -> Dae:
    return getattr(facility, mode)().compile()


@cache
def reference(mode: str) -> Simulator:
    return Simulator(system(mode), Casadi("erk", 1e-10, 1e-12), wrt=THETAS, save_at=5e-4)


def parameter(mode: str, name: str) -> float:
    dae = system(mode)
    return dae.parameter_rows[dae.parameter_number(name)].value


@cache
def asked(mode: str) -> dict[str, Functional]:
    under = {f"of {name}": f for name, f in needed(Criteria(), system(mode).y_names).items()}
    return under | {
        "high": SustainedMaximum("p_b", 0.05),
        "above": TimeAbove("v_it", 0.99),
        "below": TimeBelow("p_g", share=0.8),
        "energy": Integral("p_g"),
        "largest": Maximum("p_b"),
        "longer": SustainedMinimum("p_g", 0.12),
    }


@cache
def simulator(mode: str, rtol: float, wrt: tuple[str, ...] = THETAS) -> Simulator:
    return Simulator(system(mode), Kernel(rtol=rtol, atol=1e-2 * rtol), wrt=wrt)


def batch(
    sim: Simulator, mode: str, some: Sequence[tuple[Waveform, dict[str, float]]], criteria: bool = False
) -> BatchResult:
    columns = {name: [values[name] for _, values in some] for name in some[0][1]}
    result = sim.batch(
        [wave for wave, _ in some],
        columns,
        functionals=asked(mode),
        criteria=Criteria() if criteria else None,
    )
    assert set(result.status) == {"completed"}
    return result


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("name", ["deep", "dip", "twice", "energy"])
def test_margins_are_those_of_the_trajectory(mode: str, name: str) -> None:
    """Values to 1e-6, gradients to 1e-5: of the kernel at 1e-9 and CasADi's trajectory at 1e-10."""
    wave, values = cases(mode)[name]
    result = batch(simulator(mode, 1e-9), mode, [(wave, values)], criteria=True)
    run = reference(mode)(wave, **values)
    here, there = result.margins[0], margins(run)
    assert here is not None
    assert here.sequence == there.sequence
    assert here.diagnostics == pytest.approx(there.diagnostics, abs=1e-6)
    for ours, theirs in ((here.voltage, there.voltage), (here.loss, there.loss)):
        assert ours.value == pytest.approx(theirs.value, abs=1e-8)
        assert ours.tie == theirs.tie
        for theta in THETAS:
            scale = run.parameters[theta]
            near = pytest.approx(scale * theirs.grad[theta], rel=1e-5, abs=1e-7)
            assert scale * ours.grad[theta] == near, theta
    for f, expected in evaluate(asked(mode), run).items():
        assert result.functionals[0][f].value == pytest.approx(expected.value, abs=1e-6), f


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("name", ["deep", "dip", "twice", "energy"])
def test_gradients_of_the_kernel_equal_differences_of_the_kernel(mode: str, name: str) -> None:
    """Central differences of fourth order at tolerance 1e-12; the claim is 1e-5 of the derivative."""
    wave, values = cases(mode)[name]
    values = {theta: parameter(mode, theta) for theta in THETAS} | values
    found = batch(simulator(mode, 1e-9), mode, [(wave, values)]).functionals[0]
    steps = {theta: 1.5e-5 * values[theta] for theta in THETAS}
    around = [
        (wave, {**values, theta: values[theta] + k * steps[theta]})
        for theta in THETAS
        for k in (-2, -1, 1, 2)
    ]
    moved = batch(simulator(mode, 1e-12, ()), mode, around).functionals
    compared = set()
    for f, outcome in found.items():
        for i, theta in enumerate(THETAS):
            near = [moved[4 * i + j][f] for j in range(4)]
            if not np.isfinite(outcome.value) or outcome.tie or len({o.kind for o in near}) > 1:
                continue
            v, h = [o.value for o in near], steps[theta]
            difference = (8 * (v[2] - v[1]) - (v[3] - v[0])) / (12 * h)
            if abs(difference) * h < 1e-8:  # below the digits of the differences
                continue
            assert outcome.grad[theta] == pytest.approx(difference, rel=1e-5), (f, theta, outcome)
            compared.add((f, theta))
    assert len({f for f, _ in compared}) >= {"deep": 4, "energy": 8}.get(name, 6)  # deep: no import for long
    assert len({theta for _, theta in compared}) >= 3


JUMP = "(moved[i] - s.d[i]) * dte[j]"


@pytest.mark.parametrize("mode", MODES)
def test_without_the_jump_term_the_comparison_fails(mode: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The driver without (f- - f+) dt_e/dtheta: gradients of several functionals are off by more than 5 %."""
    whole = build.sources

    def lacking(*given: object) -> dict[str, str]:
        files = whole(*given)  # type: ignore[arg-type]
        assert files["course.c"].count(JUMP) == 1
        return {**files, "course.c": files["course.c"].replace(JUMP, "0.0 * dte[j]")}

    case = [cases(mode)["energy"]]
    right = batch(simulator(mode, 1e-9), mode, case).functionals[0]
    monkeypatch.setattr(build, "sources", lacking)
    wrong = batch(Simulator(system(mode), Kernel(rtol=1e-9, atol=1e-11), wrt=THETAS), mode, case).functionals[
        0
    ]
    missed = set()
    for f, outcome in right.items():
        assert wrong[f].value == pytest.approx(outcome.value, abs=1e-6, nan_ok=True)
        slopes = np.array([outcome.grad[n] for n in THETAS]), np.array([wrong[f].grad[n] for n in THETAS])
        if np.any(np.abs(slopes[0] - slopes[1]) > 0.05 * np.abs(slopes[0])):
            missed.add(f)
    assert len(missed) >= 4
