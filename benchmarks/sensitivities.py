"""Runs with six sensitivities: time at equal error of the sensitivities, and what it takes to compile them.

The error is the largest difference of theta d(V_IT, P_g)/dtheta on the path from a tight reference, over the
largest value in the run. README.md in this folder says how it is measured and what each row means.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from benchmarks import _case, _ours, _plot
from benchmarks._case import THETAS, Case
from benchmarks._precision import COARSE, TOLERANCES, Curve, compare, walk
from benchmarks.baselines import NotInstalled, generated, interpreted
from benchmarks.baselines.jax_diffrax import Diffrax
from benchmarks.harness import Result, least, result, spent
from dcvrt import facility
from dcvrt.functionals import SustainedMinimum
from dcvrt.integrators import Casadi, Simulator

TARGETS = (1e-3, 1e-4)
SMOKE_TARGETS = (1e-1,)
VALUES = {"beta": 1.15}
SIX = f"run with {len(THETAS)} sensitivities"


def run(smoke: bool, plot: Path | None = None) -> list[Result]:
    """Rows for both facility modes."""
    rows: list[Result] = []
    curves: dict[str, list[Curve]] = {}
    targets = SMOKE_TARGETS if smoke else TARGETS
    for mode in ("gfl",) if smoke else ("gfl", "gfm"):
        dae = getattr(facility, mode)().compile()
        case = _case.build(mode, dae, _case.disturbances(smoke), THETAS, VALUES)
        events = len(case.reference.run.events)
        if not smoke and events < 9:
            raise RuntimeError(f"{mode}: {events} events; the case must have nine or more")
        name = f"{mode}, {case.waveform.until:g} s, {events} events"
        ours = _ours.single_runs(case, THETAS, targets, sampled=False)
        others = list(baselines(case, targets, smoke))
        rows += compare(name, SIX, ours, others, targets)
        if not smoke:
            ours_sampled = _ours.single_runs(case, THETAS, targets, sampled=True)
            who = "CasADi erk, S in the norm, generated C"
            other = generated.sampled(who, case.equations, "erk", case, targets, 1)
            rows += compare(name, f"{SIX}, samples every ms", ours_sampled, [other], targets)
        curves[f"{mode}: {case.waveform.until:g} s with {events} events, {len(THETAS)} sensitivities"] = (
            ours + others
        )
        if not smoke:
            rows += compile_times(name, case)
        rows += adjoint(name, case, case.dae.p_names if not smoke else THETAS)
    if plot is not None:
        label = "largest error of a sensitivity over its largest value"
        _plot.work_precision(curves, label, targets, plot / "sensitivities")
    return rows


def baselines(case: Case, targets: tuple[float, ...], smoke: bool) -> Any:
    """Curves of all baselines. `in the norm`: S is part of the state and of the step control."""
    eq = case.equations
    table: list[tuple[str, str, Callable[[], Callable[[float], Any]], tuple[float, ...]]] = [
        ("CasADi erk forward, generated C", "CasADi, generated C",
         lambda: generated.single(eq, "erk", case, forward=True), TOLERANCES),
        ("CasADi erk, S in the norm, generated C", "CasADi, generated C",
         lambda: generated.single(eq, "erk", case), TOLERANCES),
        ("CasADi cvodes forward, simultaneous", "CasADi",
         lambda: interpreted.make(case, "cvodes", True, "simultaneous"), COARSE),
    ]  # fmt: skip
    if not smoke:
        table += [
            ("CasADi cvodes forward, staggered", "CasADi",
             lambda: interpreted.make(case, "cvodes", True, "staggered"), COARSE),
            ("CasADi cvodes, S in the norm", "CasADi",
             lambda: interpreted.make(case, "cvodes", True), COARSE),
            ("CasADi cvodes forward, simultaneous, jit", "CasADi, jit",
             lambda: interpreted.make(case, "cvodes", False, "simultaneous"), COARSE),
            ("CasADi cvodes, S in the norm, jit", "CasADi, jit",
             lambda: interpreted.make(case, "cvodes", False), COARSE),
            ("diffrax Dopri5, jvp", "diffrax", lambda: Diffrax(case, "Dopri5").make(), COARSE),
            ("diffrax Dopri5, S in the norm", "diffrax",
             lambda: Diffrax(case, "Dopri5", True).make(), COARSE),
        ]  # fmt: skip
    for name, family, make, tolerances in table:
        try:
            made = make()
        except NotInstalled as missing:
            print(f"left out: {name}: {missing}", flush=True)
            continue

        def measure(rtol: float, made: Any = made) -> tuple[Callable[[], object], float]:
            solver = made(rtol)
            return solver.run, case.errors(solver.path())[1]

        yield walk(name, family, measure, targets, tolerances)


def compile_times(name: str, case: Case) -> list[Result]:
    """From the equations to a first result, without any cache: processor time with the compiler's, s."""
    options = next(iter((_ours.solvers() or _ours.reference_loop()).values()))
    rows = []
    for what, thetas in (
        (f"compile, {len(THETAS)} sensitivities", THETAS),
        ("compile, no sensitivities", ()),
    ):
        with TemporaryDirectory() as folder:
            before = os.environ.get("DCVRT_CACHE_DIR")
            os.environ["DCVRT_CACHE_DIR"] = folder
            try:
                start = spent()
                Simulator(case.dae, options(1e-6), wrt=thetas)(case.waveform, **case.values)
                ours = spent() - start
            finally:
                os.environ.pop("DCVRT_CACHE_DIR")
                if before is not None:
                    os.environ["DCVRT_CACHE_DIR"] = before
        equations = case.equations if thetas else _case.Equations(case.dae, (), False)
        for label, plugin, forward in (
            ("CasADi erk forward, generated C", "erk", True),
            ("CasADi erk, S in the norm, generated C", "erk", False),
            ("CasADi rosenbrock forward, generated C", "rosenbrock", True),
        ):
            if not thetas and (forward or plugin != "erk"):
                continue
            made = generated.Generated(equations, plugin, 1, forward)
            rows.append(
                result(
                    name, what, ours, "s", label if thetas else "CasADi erk, generated C", made.total_seconds
                )
            )
    return rows


def adjoint(name: str, case: Case, every: tuple[str, ...]) -> list[Result]:
    """Gradient of one functional by many thetas: adjoint against forward, and against two thetas.

    The error is the largest difference of theta dJ/dtheta between the two.
    """
    functional, solver = SustainedMinimum("w_dc", 0.02), Casadi("erk", 1e-8, 1e-10)

    def gradient(
        mode: str, thetas: tuple[str, ...]
    ) -> tuple[Callable[[], dict[str, float]], dict[str, float]]:
        simulate = Simulator(case.dae, solver, wrt=thetas, mode=mode)

        def once() -> dict[str, float]:
            return dict(functional.of(simulate(case.waveform, **case.values)).grad)

        return once, once()

    run, found = gradient("adjoint", every)
    few, _ = gradient("adjoint", every[:2])
    forward, wanted = gradient("forward", every)
    size = case.reference.run.parameters
    error = max(abs((found[n] - wanted[n]) * size[n]) for n in every)
    took = least(run)
    metric = f"run and gradient of a functional by {len(every)} parameters, adjoint"
    return [
        result(
            name, metric, 1e3 * took, "ms", f"forward, {len(every)} parameters", 1e3 * least(forward), error
        ),
        result(name, metric, 1e3 * took, "ms", "adjoint, 2 parameters", 1e3 * least(few)),
    ]
