"""dcvrt's own solvers as the benchmarks run them, on one thread."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from benchmarks._case import Case
from benchmarks._precision import Curve, walk
from dcvrt import integrators
from dcvrt.errors import InputError
from dcvrt.integrators import Casadi, Simulator

METHODS = ("dp5", "rosenbrock")


def solvers() -> dict[str, Callable[[float], Any]]:
    """Name -> solver options at a tolerance: our kernel's methods, and our event loop around CasADi's erk."""
    found: dict[str, Callable[[float], Any]] = {}
    kernel = getattr(integrators, "Kernel", None)
    for method in METHODS if kernel is not None else ():
        try:
            kernel(method)
        except InputError as missing:
            print(f"left out: dcvrt {method}: {missing}", flush=True)
            continue
        found[f"dcvrt {method}"] = lambda rtol, m=method: kernel(m, rtol, rtol * 1e-2)
    if not found:
        print("there is no dcvrt.integrators.Kernel: ours is the event loop around CasADi's erk", flush=True)
    return found


def reference_loop() -> dict[str, Callable[[float], Any]]:
    """Our Python event loop around CasADi's explicit pair: the fallback of users without the kernel."""
    return {"dcvrt Casadi('erk')": lambda rtol: Casadi("erk", rtol, rtol * 1e-2)}


def single_runs(case: Case, wrt: tuple[str, ...], targets: tuple[float, ...], sampled: bool) -> list[Curve]:
    """Our methods on one case: they find the events, and the jumps of S at them, themselves.

    The error is taken on samples every ms. What is timed keeps these samples (`sampled`), or else as little
    as a baseline keeps: the ends of the stretches (and the points that the solver itself needs).
    """
    found = []
    for name, options in (solvers() or reference_loop()).items():

        def measure(
            rtol: float, options: Callable[[float], Any] = options
        ) -> tuple[Callable[[], object], float]:
            fine = Simulator(case.dae, options(rtol), wrt=wrt)
            error = case.reference.of(fine.attempt(case.waveform, **case.values))[1 if wrt else 0]
            on_kernel = not isinstance(options(rtol), Casadi)  # CasADi's loop looks for events on its samples
            coarse = Simulator(case.dae, options(rtol), wrt=wrt, save_at=case.waveform.until)
            timed = fine if sampled or not on_kernel else coarse

            def once() -> object:
                run = timed(case.waveform, **case.values)
                return run.outputs.sens if sampled else run  # computed when they are read

            return once, error

        found.append(walk(f"{name}{', samples every ms' if sampled else ''}", "dcvrt", measure, targets))
    return found
