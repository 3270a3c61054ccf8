"""Work-precision: time and error of one solver down its tolerances, and what it costs to meet an error."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from benchmarks.baselines import CannotRun
from benchmarks.harness import Result, least, result

TOLERANCES = tuple(float(f"{10**-e:.3g}") for e in np.arange(3.0, 10.01, 0.5))
COARSE = TOLERANCES[::2]
"""Whole decades, for solvers that take long."""


@dataclass
class Curve:
    """Runs of one solver.

    Attributes
    ----------
    name, family : how it is called in rows, and whose it is (colour in the plot).
    rtol, seconds, error : one entry a run; error is what the targets are about.
    failed : what went wrong where it did.
    """

    name: str
    family: str
    rtol: list[float] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    error: list[float] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)

    def at(self, target: float) -> tuple[float, float, float] | None:
        """Time, error and tolerance of the cheapest run whose error is within the target."""
        met = [k for k, e in enumerate(self.error) if e <= target]
        if not met:
            return None
        k = min(met, key=lambda k: self.seconds[k])
        return self.seconds[k], self.error[k], self.rtol[k]


def walk(
    name: str,
    family: str,
    measure: Callable[[float], tuple[Callable[[], object], float]],
    targets: Sequence[float],
    tolerances: Sequence[float] = TOLERANCES,
    budget: float = 0.25,
    longest: float = 20.0,
    most: int = 15,
    only_met: bool = False,
) -> Curve:
    """Walk down the tolerances until the tightest target is met twice, a run fails for good, or time is up.

    `measure(rtol)` returns the call to time and the error of its result. `only_met` times nothing but the
    first run that meets each target: enough for a table, where a run is long.
    """
    curve = Curve(name, family)
    beyond, spent = 0, 0.0
    for rtol in tolerances:
        try:
            call, error = measure(rtol)
            if not np.isfinite(error):
                raise CannotRun("other events than the reference, or values that are not finite")
            if only_met and not any(error <= t < min(curve.error, default=np.inf) for t in targets):
                continue
            took = least(call, budget, most)
        except CannotRun as problem:
            curve.failed.append(f"rtol {rtol:g}: {problem}")
            continue
        curve.rtol.append(rtol)
        curve.seconds.append(took)
        curve.error.append(error)
        beyond += error <= min(targets)
        spent += took
        if beyond >= (1 if only_met else 2) or spent > longest:
            break
    told = ", ".join(
        f"{r:.0e}: {1e3 * s:.3g} ms {e:.1e}"
        for r, s, e in zip(curve.rtol, curve.seconds, curve.error, strict=True)
    )
    print(f"  {name}: {told or curve.failed[:1]}", file=sys.stderr, flush=True)
    return curve


def compare(
    case: str, what: str, ours: Sequence[Curve], others: Sequence[Curve], targets: Sequence[float]
) -> list[Result]:
    """A row per target and baseline; ours is the cheaper of our methods at that target."""
    rows = []
    for target in targets:
        reached = [(c.at(target), c) for c in ours if c.at(target) is not None]
        if not reached:
            rows.append(result(case, f"{what}: ours does not reach {target:g}", None, "ms"))
            continue
        (seconds, error, rtol), best = min(reached, key=lambda pair: pair[0])  # type: ignore[arg-type, type-var, misc]
        metric = f"{what} at error {target:g}, {best.name} (rtol {rtol:.2g})"
        for other in others:
            theirs = other.at(target)
            if theirs is None:
                why = "not reached" if other.error else f"n/a: {(other.failed or ['not run'])[0]}"
                rows.append(result(case, metric, 1e3 * seconds, "ms", f"{other.name} ({why})", None, error))
                continue
            baseline = f"{other.name} (rtol {theirs[2]:.2g})"
            rows.append(result(case, metric, 1e3 * seconds, "ms", baseline, 1e3 * theirs[0], error))
    return rows
