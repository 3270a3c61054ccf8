"""Adjoint gradients: closed forms, agreement with forward sensitivities across events, cost, messages."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache

import numpy as np
import pytest

from dcvrt import facility
from dcvrt.criteria import Criteria, margins
from dcvrt.dae import Dae
from dcvrt.errors import InputError
from dcvrt.functionals import Integral, Maximum, Minimum, RecoveryTime, SustainedMinimum, TimeBelow
from dcvrt.integrators import Casadi, Simulator
from dcvrt.integrators.adjoint import Backwards
from dcvrt.integrators.recorded import RecordedRun
from dcvrt.trajectory import Trajectory
from dcvrt.waveform import Waveform
from tests.integrators.systems import Sketch, ball, decay, flat, go, store

# A low voltage limit, so that the DC energy and not the voltage calls for the battery: an event on a state.
ENERGY_FIRST = {"beta": 1.05, "sup.V_dip": 0.3, "sup.V_low": 0.25, "sup.V_deep": 0.2, "sup.V_back": 0.9}
FUNCTIONALS = {
    "v": SustainedMinimum("v_it", 0.02),
    "p": SustainedMinimum("p_g", 0.04),
    "w": Minimum("w_dc"),
    "load": Maximum("i_g", per="i_max"),
    "below": TimeBelow("p_g", share=0.9),
    "recovery": RecoveryTime("p_g", share=0.9),
}


@cache
def system(mode: str) -> Dae:
    return getattr(facility, mode)().compile()


def one_fault() -> Waveform:
    return Waveform.segments(
        [(0.0, 1.0), (0.1, 0.4 * np.exp(-0.3j)), (0.25, 0.97, 1.0), (0.6, 1.0)], until=0.7
    )


@cache
def runs(mode: str) -> tuple[Trajectory, Trajectory]:
    """The same run with forward sensitivities by every parameter, and adjoint."""
    dae, solver = system(mode), Casadi("erk", 1e-10, 1e-12)
    forward = Simulator(dae, solver, wrt=dae.p_names)(one_fault(), **ENERGY_FIRST)
    return forward, Simulator(dae, solver, wrt=dae.p_names, mode="adjoint")(one_fault(), **ENERGY_FIRST)


def scaled(grad: Mapping[str, float], run: Trajectory) -> np.ndarray:
    return np.array([grad[n] * abs(run.parameters[n]) for n in run.wrt])


@pytest.mark.parametrize("mode", ["gfl", "gfm"])
def test_every_parameter_as_forward_across_events_on_states(mode: str) -> None:
    forward, adjoint = runs(mode)
    assert max(abs(g) for e in forward.events for g in e.grad.values()) > 0.1  # times of events do move
    for functional in FUNCTIONALS.values():
        wanted, found = functional.of(forward), functional.of(adjoint)
        assert found.value == pytest.approx(wanted.value, abs=1e-9)
        assert found.kind == wanted.kind
        a, b = scaled(found.grad, forward), scaled(wanted.grad, forward)
        assert np.abs(a - b).max() < 1e-6 * max(1.0, np.abs(b).max())
        assert np.abs(b).max() > 1e-6


def test_without_the_jump_terms_it_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    forward, _ = runs("gfm")
    original = RecordedRun._jump

    def smooth(self: RecordedRun, row: int, ties: list[int], dte: np.ndarray) -> None:
        original(self, row, ties, dte)
        self._now.jumps[-1].moved[:] = 0.0

    monkeypatch.setattr(RecordedRun, "_jump", smooth)
    dae = system("gfm")
    simulate = Simulator(dae, Casadi("erk", 1e-10, 1e-12), wrt=dae.p_names, mode="adjoint")
    found = Minimum("w_dc").of(simulate(one_fault(), **ENERGY_FIRST))
    wanted = scaled(Minimum("w_dc").of(forward).grad, forward)
    assert np.abs(scaled(found.grad, forward) - wanted).max() > 0.05 * np.abs(wanted).max()


def test_margins_and_batch_as_forward() -> None:
    forward, adjoint = runs("gfl")
    wanted, found = margins(forward), margins(adjoint)
    for name in ("voltage", "loss"):
        a, b = (scaled(getattr(m, name).grad, forward) for m in (found, wanted))
        assert np.abs(a - b).max() < 1e-6
    dae = system("gfl")
    simulate = Simulator(dae, Casadi("erk", 1e-10, 1e-12), wrt=("beta", "d"), mode="adjoint")
    batch = simulate.batch([one_fault()], ENERGY_FIRST, Criteria())
    (row,) = batch.margins
    assert row is not None
    assert row.loss.grad["beta"] == pytest.approx(wanted.loss.grad["beta"], abs=1e-6)


# -- closed forms --------------------------------------------------------------------------------------------


def test_store_that_is_drained_and_filled() -> None:
    """E falls from 1 with P at 0.1 s, rises with R from E_min to E_max, falls again: time below 0.7."""
    wave = Waveform.segments([(0.0, 1.0), (0.1, 0.5)], until=1.0)
    simulate = Simulator(
        store(), Casadi("erk", 1e-10, 1e-12), wrt=("P", "R", "E_min", "E_max"), start="given", mode="adjoint"
    )
    found = TimeBelow("energy", 0.7).of(simulate(wave))
    assert found.value == pytest.approx(0.9 + (0.7 - 0.8) / 2 - (0.8 - 0.4), abs=1e-9)
    assert found.grad["P"] == pytest.approx(0.4, abs=1e-8)
    assert found.grad["R"] == pytest.approx(0.025, abs=1e-8)
    assert found.grad["E_min"] == pytest.approx(0.0, abs=1e-8)
    assert found.grad["E_max"] == pytest.approx(-1.5, abs=1e-8)


def test_resets_hand_their_weight_through() -> None:
    """A ball that bounces twice: the time it is below 0.3."""
    dae = ball()
    made = [
        Simulator(dae, Casadi("erk", 1e-11, 1e-13), wrt=dae.p_names, start="given", mode=mode)(flat(1.2))
        for mode in ("forward", "adjoint")
    ]
    wanted, found = (TimeBelow("height", 0.3).of(run).grad for run in made)
    assert len(made[1].events) == 2
    for name in dae.p_names:
        assert found[name] == pytest.approx(wanted[name], abs=1e-7)
        assert abs(wanted[name]) > 1e-2


def test_timers_hand_their_weight_to_what_started_them() -> None:
    """x grows with a; once above `level` for T it falls with b: max = level + a T."""
    s = Sketch({"x": 0.0}, {"a": 2.0, "b": 1.0, "level": 0.5, "T": 0.1})
    q, _, rows = s.automaton("sup", {"up": (1.0,), "down": (0.0,)}, "up")
    rows.append(go("up", "down", s.x["x"] - s.p["level"], held=s.p["T"]))
    dae = s.dae({"x": q[0] * s.p["a"] - (1 - q[0]) * s.p["b"]}, {"x_out": s.x["x"]})
    simulate = Simulator(dae, wrt=dae.p_names, start="given", mode="adjoint")
    top = Maximum("x_out").of(simulate(flat()))
    assert top.kind == "event"
    assert dict(top.grad) == pytest.approx({"a": 0.1, "b": 0.0, "level": 1.0, "T": 2.0}, abs=1e-7)
    # x returns to 0.4 at t: level/a + T + (level + a T - 0.4)/b; it is above from 0.4/a on
    below = TimeBelow("x_out", 0.4).of(simulate(flat()))
    a, b, level, T = 2.0, 1.0, 0.5, 0.1
    assert below.value == pytest.approx(1 - (level / a + T + (level + a * T - 0.4) / b) + 0.4 / a, abs=1e-7)
    wanted = {"a": level / a**2 - T / b - 0.4 / a**2, "b": 0.3, "level": -1 / a - 1 / b, "T": -1 - a / b}
    assert dict(below.grad) == pytest.approx(wanted, abs=1e-6)


def test_clock_in_the_equations() -> None:
    """A ramp that begins with the mode: x' = clock once y > level; derivatives reach the entry time."""
    s = Sketch({"y": 0.0, "x": 0.0}, {"a": 2.0, "level": 0.5})
    q, clock, rows = s.automaton("sup", {"wait": (0.0,), "ramp": (1.0,)}, "wait")
    rows.append(go("wait", "ramp", s.x["y"] - s.p["level"]))
    dae = s.dae({"y": s.p["a"], "x": q[0] * clock}, {"x_out": s.x["x"]})
    grad = (
        Maximum("x_out")
        .of(
            Simulator(dae, Casadi("erk", 1e-9, 1e-11), wrt=dae.p_names, start="given", mode="adjoint")(flat())
        )
        .grad
    )  # x(1) = (1 - level/a)^2 / 2
    assert dict(grad) == pytest.approx({"a": 0.75 * 0.5 / 4, "level": -0.75 / 2}, abs=1e-7)


def test_algebraic_variables() -> None:
    dae = decay()
    made = [
        Simulator(dae, Casadi("rosenbrock", 1e-9, 1e-11), wrt=dae.p_names, start="given", mode=mode)(
            flat(2.0)
        )
        for mode in ("forward", "adjoint")
    ]
    for functional in (Minimum("x_out"), TimeBelow("z_out", 0.5)):
        wanted, found = (functional.of(run).grad for run in made)
        assert len(made[1].events) == 1
        assert found == pytest.approx(dict(wanted), abs=1e-6)
        assert max(map(abs, wanted.values())) > 1e-2


def test_tangents_of_the_waveform() -> None:
    """x' = v - x with dv/dtheta on the samples: as forward, guard on v included."""
    s = Sketch({"x": 1.0}, {"k": 3.0})
    q, _, rows = s.automaton("sup", {"a": (1.0,), "b": (0.3,)}, "a")
    rows.append(go("a", "b", 0.8 - s.v[0]))
    dae = s.dae({"x": s.p["k"] * q[0] * (s.v[0] - s.x["x"])}, {"x_out": s.x["x"]})
    t = np.linspace(0.0, 1.0, 41)
    wave = Waveform.from_samples(t, 1 - 0.4 * t + 0j, {"H_1": -np.sin(t) + 0j})
    made = [
        Simulator(dae, Casadi("erk", 1e-9, 1e-11), wrt=("k", "H_1"), mode=mode)(wave)
        for mode in ("forward", "adjoint")
    ]
    assert abs(made[0].events[0].grad["H_1"]) > 0.1
    for functional in (Minimum("x_out"), Integral("x_out")):
        wanted, found = (functional.of(run).grad for run in made)
        assert found == pytest.approx(dict(wanted), abs=1e-7)
        assert abs(wanted["H_1"]) > 1e-2


# -- cost ----------------------------------------------------------------------------------------------------


def test_cost_does_not_grow_with_the_number_of_thetas(monkeypatch: pytest.MonkeyPatch) -> None:
    dae, calls = system("gfl"), [0]
    original = Backwards.over

    def counted(self: Backwards, *arguments: object) -> bool:
        calls[0] += 1
        return original(self, *arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(Backwards, "over", counted)
    made = []
    for thetas in (dae.p_names[:2], dae.p_names):
        calls[0] = 0
        run = Simulator(dae, Casadi(), wrt=thetas, mode="adjoint")(one_fault())
        assert len(dict(Minimum("w_dc").of(run).grad)) == len(thetas)
        made.append(calls[0])
    assert made[0] == made[1] > 0


def test_the_sweep_waits_until_a_gradient_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    _, adjoint = runs("gfl")
    monkeypatch.setattr(Backwards, "over", lambda *_: pytest.fail("swept for a value"))
    assert Minimum("w_dc").of(adjoint).value < 1.0


# -- messages ------------------------------------------------------------------------------------------------


def test_no_sensitivities_over_time() -> None:
    _, adjoint = runs("gfl")
    with pytest.raises(InputError) as error:
        _ = adjoint.sens["v_it", "beta"]
    assert str(error.value) == (
        "sens['v_it', 'beta']: an adjoint run has gradients of functionals, no sensitivities over time. "
        "Ways out: Minimum('v_it').of(run).grad, margins(run); or mode='forward'."
    )


def test_unknown_mode() -> None:
    with pytest.raises(InputError) as error:
        Simulator(store(), mode="reverse")
    assert str(error.value) == "mode = 'reverse' must be 'forward' or 'adjoint'."


def test_nothing_to_derive_by() -> None:
    with pytest.raises(InputError) as error:
        Simulator(store(), mode="adjoint")
    assert str(error.value) == (
        "mode = 'adjoint' without wrt: nothing to derive by. Way out: wrt=dae.p_names."
    )


def test_only_casadi_goes_back() -> None:
    from dcvrt.integrators import Kernel

    with pytest.raises(InputError) as error:
        Simulator(store(), Kernel(), wrt=("P",), mode="adjoint")
    assert str(error.value).startswith("mode = 'adjoint' with solver = Kernel(")
    assert str(error.value).endswith(
        "the adjoint runs through CasADi. Ways out: solver=Casadi('erk'), or mode='forward'."
    )
