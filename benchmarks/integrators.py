"""Single runs: time at equal path error, ours against every integrator that a user might take instead.

Case: a facility of each mode, 5 s, deep fault, dip and swell, nine events or more. README.md in this folder
says how it is measured and what each row means.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks import _case, _ours, _plot
from benchmarks._case import Case
from benchmarks._precision import COARSE, TOLERANCES, Curve, compare, walk
from benchmarks.baselines import NotInstalled, generated, interpreted, native_events, python_solvers
from benchmarks.baselines.jax_diffrax import Diffrax
from benchmarks.harness import Result
from dcvrt import facility

TARGETS = (1e-5, 1e-6)
SMOKE_TARGETS = (1e-3,)
VALUES = {"beta": 1.15}


def run(smoke: bool, plot: Path | None = None) -> list[Result]:
    """Rows for both facility modes."""
    rows: list[Result] = []
    curves: dict[str, list[Curve]] = {}
    targets = SMOKE_TARGETS if smoke else TARGETS
    for mode in ("gfl",) if smoke else ("gfl", "gfm"):
        dae = getattr(facility, mode)().compile()
        case = _case.build(mode, dae, _case.disturbances(smoke), values=VALUES)
        events = len(case.reference.run.events)
        if not smoke and events < 9:
            raise RuntimeError(f"{mode}: {events} events; the case must have nine or more")
        name = f"{mode}, {case.waveform.until:g} s, {events} events"
        ours = _ours.single_runs(case, (), targets, sampled=False)
        others = list(baselines(case, targets, smoke))
        rows += compare(name, "run", ours, others, targets)
        if not smoke:
            ours_sampled = _ours.single_runs(case, (), targets, sampled=True)
            other = generated.sampled("CasADi erk, generated C", case.equations, "erk", case, targets, 0)
            rows += compare(name, "run with samples every ms", ours_sampled, [other], targets)
        curves[f"{mode}: {case.waveform.until:g} s with {events} events"] = ours + others
    rows += native_events.evidence()
    if plot is not None:
        _plot.work_precision(
            curves, "largest error of V_IT and P_g on the path, pu", targets, plot / "integrators"
        )
    return rows


def baselines(case: Case, targets: tuple[float, ...], smoke: bool) -> Any:
    """Curves of all baselines; a package that is not installed is named and left out."""
    eq = case.equations
    table: list[tuple[str, str, Callable[[], Callable[[float], Any]], tuple[float, ...]]] = [
        (
            "CasADi erk, generated C",
            "CasADi, generated C",
            lambda: generated.single(eq, "erk", case),
            TOLERANCES,
        ),
        (
            "CasADi erk, generated C, looks at guards",
            "CasADi, generated C",
            lambda: generated.single(eq, "erk", case, watching=True),
            TOLERANCES,
        ),
        ("CasADi cvodes, interpreted", "CasADi", lambda: interpreted.make(case, "cvodes", True), TOLERANCES),
    ]
    if not smoke:
        table += [
            ("CasADi rosenbrock, generated C", "CasADi, generated C",
             lambda: generated.single(eq, "rosenbrock", case), TOLERANCES),
            *((f"CasADi {p}, interpreted", "CasADi",
               lambda p=p: interpreted.make(case, p, True), TOLERANCES)
              for p in ("idas", "erk", "rosenbrock")),
            *((f"CasADi {p}, jit", "CasADi, jit",
               lambda p=p: interpreted.make(case, p, False), COARSE)
              for p in ("cvodes", "idas")),
            *((f"SciPy {m}", "SciPy", lambda m=m: python_solvers.scipy(case, m), COARSE)
              for m in ("LSODA", "RK45", "Radau", "BDF")),
            *((f"scikit-SUNDAE {m.upper()}", "scikit-SUNDAE",
               lambda m=m: python_solvers.sundae(case, m), COARSE)
              for m in ("cvode", "ida")),
            *((f"diffrax {m}", "diffrax", lambda m=m: Diffrax(case, m).make(), COARSE)
              for m in ("Tsit5", "Dopri5", "Kvaerno5")),
        ]  # fmt: skip
    for name, family, make, tolerances in table:
        try:
            made = make()
        except NotInstalled as missing:
            print(f"left out: {name}: {missing}", flush=True)
            continue

        def measure(rtol: float, made: Any = made) -> tuple[Callable[[], object], float]:
            solver = made(rtol)
            return solver.run, case.errors(solver.path())[0]

        yield walk(name, family, measure, targets, tolerances)
