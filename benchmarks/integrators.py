"""Facility integrators: CasADi's solvers in our event loop against cvodes between events, at equal error.

One facility run of 5 s with a deep fault, a dip and a swell, in which the supervisor jumps nine times or
more. The error of a run is the largest difference of V_IT and P_g to cvodes at 1e-11 on the samples of the
run that are more than 1 ms away from any jump (a jump that is 1e-8 s off is not an error of the size of the
jump). Every solver walks down its tolerances until it meets the target error; the least time of several runs
counts. One thread.
"""

from __future__ import annotations

import numpy as np

from benchmarks.harness import Result, result, seconds
from dcvrt import Waveform, facility
from dcvrt.dae import Dae
from dcvrt.integrators import Casadi, Simulator
from dcvrt.trajectory import Trajectory

TARGET = 1e-5
TOLERANCES = (1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9)
SIGNALS = ("v_it", "p_g")
THETAS = ("beta", "H", "dc.T_hold", "bess.T_b", "sup.w_sag", "dc_loop.K_p")
SOLVERS = (
    ("erk, compiled", "erk", False),
    ("erk, interpreted", "erk", True),
    ("rosenbrock, compiled", "rosenbrock", False),
    ("rosenbrock, interpreted", "rosenbrock", True),
)


def disturbances(smoke: bool) -> Waveform:
    """Deep fault with recovery, dip, swell; cut after the fault for the smoke run."""
    if smoke:
        return Waveform.segments([(0.0, 1.0), (0.1, 0.45 * np.exp(-0.3j)), (0.2, 1.0)], until=0.4)
    return Waveform.segments(
        [
            (0.0, 1.0),
            (0.5, 0.45 * np.exp(-0.4j)),
            (0.6, 0.75 * np.exp(0.14j), 0.98),
            (1.0, 0.98, 1.0),
            (2.4, 0.7 * np.exp(-0.14j)),
            (2.75, 1.0),
            (4.2, 1.15 * np.exp(0.07j)),
            (4.35, 1.0),
        ],
        until=5.0,
    )


def path_error(run: Trajectory, reference: Trajectory) -> float:
    """Largest difference of the signals away from jumps; infinite when the sequence of modes differs."""
    if run.sequence != reference.sequence:
        return float("inf")
    edges = reference.t[reference.breaks]
    k = np.flatnonzero(np.abs(run.t[:, None] - edges).min(axis=1) > 1e-3)
    return max(float(np.abs(run[n][k] - reference.at(n, run.t[k])).max()) for n in SIGNALS)


def at_equal_error(
    dae: Dae, wave: Waveform, reference: Trajectory, plugin: str, interpreted: bool, smoke: bool
) -> tuple[float, float, float]:
    """Time, error and tolerance of the loosest run that meets the target."""
    error = float("inf")
    for rtol in TOLERANCES:
        simulator = Simulator(dae, Casadi(plugin, rtol, rtol * 1e-2, interpreted))  # type: ignore[arg-type]
        error = path_error(simulator.attempt(wave, beta=1.15), reference)
        if error <= TARGET:
            return seconds(lambda s=simulator: s(wave, beta=1.15), 1 if smoke else 7), error, rtol
    raise RuntimeError(f"{plugin} does not reach {TARGET:g}: error {error:.2g} at rtol {TOLERANCES[-1]:g}")


def run(smoke: bool) -> list[Result]:
    """Rows for both facility modes: plain runs, then runs with six sensitivities."""
    rows: list[Result] = []
    wave = disturbances(smoke)
    for mode in ("gfl",) if smoke else ("gfl", "gfm"):
        dae = getattr(facility, mode)().compile()
        reference = Simulator(dae, Casadi("cvodes", 1e-11, 1e-13), save_at=1e-4)(wave, beta=1.15)
        if not smoke and len(reference.events) < 9:
            raise RuntimeError(f"{mode}: {len(reference.events)} events; the case must have nine or more")
        case = f"{mode}, {wave.until:g} s, {len(reference.events)} events"
        baselines = {
            kind: at_equal_error(dae, wave, reference, "cvodes", kind == "interpreted", smoke)
            for kind in ("interpreted", "compiled")
        }
        for name, plugin, interpreted in SOLVERS:
            if smoke and plugin == "rosenbrock" and interpreted:
                continue
            time, error, rtol = at_equal_error(dae, wave, reference, plugin, interpreted, smoke)
            for kind, (base, _, base_rtol) in baselines.items():
                baseline = f"cvodes, {kind}, rtol {base_rtol:g}"
                rows.append(
                    result(case, f"run, {name}, rtol {rtol:g}", 1e3 * time, "ms", baseline, 1e3 * base, error)
                )
        rows += with_sensitivities(dae, wave, case, smoke)
    return rows


def with_sensitivities(dae: Dae, wave: Waveform, case: str, smoke: bool) -> list[Result]:
    """Six forward sensitivities in the error norm; the error is that of dV_IT/dtheta, times theta."""
    thetas = THETAS[:2] if smoke else THETAS
    tight = Simulator(dae, Casadi("erk", 1e-10, 1e-12), wrt=thetas)(wave, beta=1.15)
    size = np.array([tight.parameters[n] for n in thetas])
    t = np.arange(wave.start, wave.until, 2e-3)
    t = t[np.abs(t[:, None] - tight.t[tight.breaks]).min(axis=1) > 1e-3]

    def sampled(run: Trajectory) -> np.ndarray:
        return np.column_stack([np.interp(t, run.t, run.sens["v_it", n]) for n in thetas]) * size

    timed = {}
    for plugin in ("erk", "cvodes"):
        simulator = Simulator(dae, Casadi(plugin, 1e-6, 1e-8), wrt=thetas)  # type: ignore[arg-type]
        error = float(np.abs(sampled(simulator(wave, beta=1.15)) - sampled(tight)).max())
        timed[plugin] = (seconds(lambda s=simulator: s(wave, beta=1.15), 1 if smoke else 3), error)
    (time, error), (base, _) = timed["erk"], timed["cvodes"]
    metric = f"run with {len(thetas)} sensitivities, erk, compiled, rtol 1e-06"
    return [result(case, metric, 1e3 * time, "ms", "cvodes, interpreted, rtol 1e-06", 1e3 * base, error)]
