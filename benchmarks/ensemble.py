"""Ensembles: many runs that differ in H, beta and waveform; and a sampled waveform beside a stepped one.

Ours finds the events and judges every run by margins; the baseline is handed the events, keeps the states at
the ends of its stretches and judges nothing. README.md in this folder says how it is measured.
"""

from __future__ import annotations

import os
import platform
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks import _case, _ours
from benchmarks._case import POINTS, THETAS, Case
from benchmarks._precision import Curve, compare, walk
from benchmarks.baselines import interpreted
from benchmarks.baselines.generated import Generated, tabled
from benchmarks.harness import Result, least, result
from dcvrt import Criteria, Waveform, facility
from dcvrt.dae import Dae
from dcvrt.integrators import Casadi, Kernel, Simulator, find_compiler
from dcvrt.integrators.equations import Equations

RUNS = 1000
CHECKED = 24
"""Runs of the ensemble whose error is taken; that of the ensemble is the 90th percentile."""
TARGETS = (1e-4, 1e-5)
TARGETS_SENSITIVITIES = (1e-3,)
SAMPLED = 5e-3
SEED = 1
LANED = 200
"""Runs on sampled waveforms in one batch."""


@dataclass(frozen=True, eq=False)
class Ensemble:
    """Waveforms and parameters of many runs."""

    waveforms: tuple[Waveform, ...]
    table: dict[str, list[float]]

    def values(self, k: int) -> dict[str, float]:
        return {name: column[k] for name, column in self.table.items()}


def draw(runs: int, smoke: bool = False) -> Ensemble:
    """Fault, dip and swell with random depths, lengths and angles; random H and beta."""
    random = np.random.default_rng(SEED)
    waveforms = []
    for _ in range(runs):
        deep, dip, swell = random.uniform(0.3, 0.75), random.uniform(0.65, 0.88), random.uniform(1.08, 1.18)
        length, angle = random.uniform(0.06, 0.18), random.uniform(-0.5, 0.5)
        steps: list[Any] = [
            (0.0, 1.0),
            (0.2, deep * np.exp(1j * angle)),
            (0.2 + length, random.uniform(0.7, 0.9) * np.exp(-0.3j * angle), 0.98),
            (0.8, 0.98, 1.0),
        ]
        if not smoke:
            steps += [
                (2.4, dip * np.exp(-0.3j * angle)),
                (2.4 + 2 * length, 1.0),
                (4.0, swell * np.exp(0.2j * angle)),
                (4.0 + length, 1.0),
            ]
        waveforms.append(Waveform.segments(steps, until=1.0 if smoke else 5.0))
    table = {"H": random.uniform(0.8, 1.25, runs).tolist(), "beta": random.uniform(1.05, 1.4, runs).tolist()}
    return Ensemble(tuple(waveforms), table)


def run(smoke: bool) -> list[Result]:
    """Rows for both facility modes."""
    rows: list[Result] = []
    for mode in ("gfl",) if smoke else ("gfl", "gfm"):
        dae = getattr(facility, mode)().compile()
        rows += ensembles(mode, dae, smoke)
        if not smoke:
            rows += widths(mode, dae)
            rows += sampled(mode, dae)
    return rows


# -- ensembles --------------------------------------------------------------------------------------------


def ensembles(mode: str, dae: Dae, smoke: bool) -> list[Result]:
    """The ensemble without and with sensitivities."""
    runs, checked = (8, 4) if smoke else (RUNS, CHECKED)
    ensemble = draw(runs, smoke)
    cases = stretches(mode, dae, ensemble, checked)
    events = np.mean([len(c.reference.run.events) for c in cases[:checked]])
    name = f"{mode}, {len(cases)} runs of {ensemble.waveforms[0].until:g} s, {events:.1f} events each"
    if len(cases) < runs:
        print(f"{mode}: {runs - len(cases)} of {runs} runs end before their time and are left out")
    keep = [c.values for c in cases]
    ensemble = Ensemble(tuple(c.waveform for c in cases), {n: [v[n] for v in keep] for n in ensemble.table})
    targets = (1e-2,) if smoke else TARGETS
    plain = Equations(dae, (), False)
    small = [without_sensitivities(c, plain) for c in cases]
    who, given = "CasADi erk, generated C", (plain, small, checked, targets, 0)
    others = [
        generated_curve(f"{who}, ends only", *given),
        generated_curve(f"{who}, {POINTS} samples a stretch", *given, POINTS),
        generated_curve(f"{who}, {POINTS} samples a stretch, looks at guards", *given, POINTS, watching=True),
    ]
    ours = ours_on(dae, ensemble, small, checked, (), targets)
    rows = compare(name, "a run with events and margins", ours, others, targets)
    if smoke:
        return rows
    eq = cases[0].equations
    with_S = (eq, cases, checked, TARGETS_SENSITIVITIES, 1)
    others = [
        generated_curve("CasADi erk forward, generated C, ends only", *with_S, 1, True),
        generated_curve("CasADi erk, S in the norm, generated C, ends only", *with_S),
    ]
    ours = ours_on(dae, ensemble, cases, checked, THETAS, TARGETS_SENSITIVITIES)
    metric = f"a run with events, margins and {len(THETAS)} sensitivities"
    return rows + compare(name, metric, ours, others, TARGETS_SENSITIVITIES)


def stretches(mode: str, dae: Dae, ensemble: Ensemble, checked: int) -> list[Case]:
    """The stretches of every run that completes; the first `checked` with a fine, tight reference."""
    equations = Equations(dae, THETAS, False)
    fine = Simulator(dae, Casadi("erk", 1e-10, 1e-12), THETAS, save_at=2e-4)
    rough = Simulator(dae, Casadi("erk", 1e-8, 1e-10), THETAS, save_at=4e-3)
    cases: list[Case] = []
    for k, waveform in enumerate(ensemble.waveforms):
        done = (fine if len(cases) < checked else rough).attempt(waveform, **ensemble.values(k))
        if done.completed:
            cases.append(_case.cut(mode, dae, waveform, done, equations, ensemble.values(k)))
            if len(cases) > checked:
                object.__setattr__(cases[-1], "reference", None)  # a thousand trajectories fill the memory
        if k % 250 == 249:
            print(f"  reference runs: {k + 1}", file=sys.stderr, flush=True)
    return cases


def without_sensitivities(case: Case, plain: Equations) -> Case:
    """The same stretches for the plain equations."""
    n_P = len(case.dae.p_names) + plain.nq + plain.na
    return Case(
        case.name, case.dae, case.waveform, case.values, plain, case.reference, case.X0[: plain.nx],
        case.P[:, :n_P], case.group, case.jump[:, : plain.nx], case.seeds[:, :0],
    )  # fmt: skip


def generated_curve(
    name: str, equations: Equations, cases: Sequence[Case], checked: int, targets: Sequence[float],
    which: int, points: int = 1, forward: bool = False, watching: bool = False,
) -> Curve:  # fmt: skip
    """Generated C in a loop in C; seconds are per run. `which`: 0 path error, 1 sensitivity error."""
    timed = Generated(equations, "erk", points, forward, watching=watching)
    fine = timed if points == POINTS else Generated(equations, "erk", POINTS, forward)
    given = timed.arguments(cases)
    some = fine.arguments(cases[:checked])
    borders = np.cumsum(some[0])[:-1]

    def measure(rtol: float) -> tuple[Callable[[], object], float]:
        X = np.split(fine.call(*some, rtol), borders)
        errors = [c.errors(x)[which] for c, x in zip(cases[:checked], X, strict=True)]
        return lambda: timed.call(*given, rtol), float(np.quantile(errors, 0.9))

    curve = walk(name, "CasADi, generated C", measure, targets, budget=3.0, longest=90.0, only_met=True)
    curve.seconds = [s / len(cases) for s in curve.seconds]
    return curve


def ours_on(
    dae: Dae,
    ensemble: Ensemble,
    cases: Sequence[Case],
    checked: int,
    wrt: tuple[str, ...],
    targets: Sequence[float],
) -> list[Curve]:
    """Our batch with events and margins; without the kernel, the loop on the checked runs alone."""
    found = []
    kernel = _ours.solvers()
    runs = len(ensemble.waveforms) if kernel else checked
    waveforms = ensemble.waveforms[:runs]
    table = {n: column[:runs] for n, column in ensemble.table.items()}
    for name, options in (kernel or _ours.reference_loop()).items():

        def measure(
            rtol: float, options: Callable[[float], Any] = options
        ) -> tuple[Callable[[], object], float]:
            simulate = Simulator(dae, options(rtol), wrt=wrt)
            errors = []
            for k, case in enumerate(cases[:checked]):
                done = simulate.attempt(case.waveform, **ensemble.values(k))
                errors.append(case.reference.of(done)[1 if wrt else 0])
            return (
                lambda: simulate.batch(waveforms, table, criteria=Criteria()),
                float(np.quantile(errors, 0.9)),
            )

        curve = walk(name, "dcvrt", measure, targets, budget=3.0, longest=90.0, only_met=True)
        curve.seconds = [s / runs for s in curve.seconds]
        found.append(curve)
    return found


# -- lanes and threads --------------------------------------------------------------------------------------


def widths(mode: str, dae: Dae) -> list[Result]:
    """The ensemble on fewer lanes, and on two threads (wall time: only there do other processors help)."""
    ensemble, rtol = draw(RUNS), 1e-6
    name = f"{mode}, {RUNS} runs of {ensemble.waveforms[0].until:g} s, rtol {rtol:g}"
    metric = "a run with events and margins"

    def batch(threads: int = 1) -> Callable[[], object]:
        simulate = Simulator(dae, Kernel("dp5", rtol, rtol * 1e-2, threads=threads))
        return lambda: simulate.batch(ensemble.waveforms, ensemble.table, criteria=Criteria())

    if find_compiler() is None:
        return []
    native, rows = least(batch(), 2.0) / RUNS, []
    for march in ("x86-64-v3", "x86-64") if platform.machine() == "x86_64" else ():
        with instructions(march):
            fewer = least(batch(), 2.0) / RUNS
        rows.append(
            result(name, f"{metric}, all instructions", 1e3 * native, "ms", f"with {march}", 1e3 * fewer)
        )
    with every_processor() as processors:
        if processors > 1:
            took = [_wall(batch(threads)) / RUNS for threads in (2, 1)]
            rows.append(
                result(
                    name,
                    f"{metric}, two threads, wall",
                    1e3 * took[0],
                    "ms",
                    "one thread, wall",
                    1e3 * took[1],
                )
            )
    return rows


def _wall(call: Callable[[], object]) -> float:
    """Least wall time of three calls."""
    call()
    took = []
    for _ in range(3):
        start = time.perf_counter()
        call()
        took.append(time.perf_counter() - start)
    return min(took)


@contextmanager
def instructions(march: str) -> Iterator[None]:
    """Compile for other instructions than this processor's."""
    before = os.environ.get("DCVRT_MARCH")
    os.environ["DCVRT_MARCH"] = march
    try:
        yield
    finally:
        os.environ.pop("DCVRT_MARCH")
        if before is not None:
            os.environ["DCVRT_MARCH"] = before


@contextmanager
def every_processor() -> Iterator[int]:
    """Let this process use all processors; yields their number."""
    if not hasattr(os, "sched_setaffinity"):
        yield os.cpu_count() or 1
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, range(os.cpu_count() or 1))
    try:
        yield len(os.sched_getaffinity(0))
    finally:
        os.sched_setaffinity(0, before)


# -- a sampled waveform -----------------------------------------------------------------------------------


def sampled(mode: str, dae: Dae) -> list[Result]:
    """What a waveform with a sample every 5 ms costs; `ratio` is the time on the stepped one over it."""
    wave = _case.disturbances()
    dense = wave.resampled(SAMPLED)
    values = {"beta": 1.15}
    stepped = _case.build(mode, dae, wave, values=values)
    fine = _case.cut(mode, dae, dense, stepped.reference.run, stepped.equations, values)
    rtol = 1e-6
    name = f"{mode}, {wave.until:g} s, a sample every {1e3 * SAMPLED:g} ms, rtol {rtol:g}"
    rows = []

    def row(
        who: str, on_steps: Callable[[], object], on_samples: Callable[[], object], error: float | None
    ) -> None:
        a, b = least(on_steps), least(on_samples)
        rows.append(
            result(
                name, f"sampled waveform, {who}", 1e3 * b, "ms", f"stepped waveform, {who}", 1e3 * a, error
            )
        )

    for who, options in (_ours.solvers() or _ours.reference_loop()).items():
        simulate = Simulator(dae, options(rtol), save_at=wave.until)
        other = Simulator(dae, options(rtol), save_at=wave.until)
        error = stepped.reference.of(other.attempt(dense, **values))[0]
        row(who, lambda s=simulate: s(wave, **values), lambda s=other: s(dense, **values), error)
    for who, options in _ours.solvers().items():
        ensemble, simulate = draw(LANED), Simulator(dae, options(rtol))
        fine_waves = [w.resampled(SAMPLED) for w in ensemble.waveforms]

        def batch(
            waves: Sequence[Waveform], s: Simulator = simulate, table: dict[str, list[float]] = ensemble.table
        ) -> Callable[[], object]:
            return lambda: s.batch(waves, table, criteria=Criteria())

        row(f"{who}, batch of {LANED}", batch(ensemble.waveforms), batch(fine_waves), None)

    eq = stepped.equations
    plain, seen = Generated(eq, "erk", 1), Generated(eq, "erk", 4)
    on_steps, on_samples = plain.arguments([stepped]), plain.arguments([fine])
    row(
        "CasADi erk, generated C, stops at samples", lambda: plain.call(*on_steps, rtol),
        lambda: plain.call(*on_samples, rtol), fine.errors(seen.call(*on_samples, rtol))[0],
    )  # fmt: skip
    pieces = len(fine.group)
    looked, looked_fine = (Generated(eq, "erk", n, table=pieces) for n in (1, POINTS))
    *given, table = tabled(fine, stepped)
    row(
        "CasADi erk, generated C, table in the equations", lambda: plain.call(*on_steps, rtol),
        lambda: looked.call(*given, rtol, table), stepped.errors(looked_fine.call(*given, rtol, table))[0],
    )  # fmt: skip
    cvodes = [interpreted.make(c, "cvodes", True)(rtol) for c in (stepped, fine)]
    row("CasADi cvodes, stops at samples", cvodes[0].run, cvodes[1].run, stepped.errors(cvodes[0].path())[0])
    return rows
