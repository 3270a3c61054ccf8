"""What every benchmark shares: the row it reports, the clock it uses, and how rows are printed and stored.

A benchmark is a module of this package with one function ``run(smoke) -> list[Result]``, or
``run(smoke, plot)`` when it also draws. Ratios are quoted, absolute times are not: they belong to the
machine.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypedDict


class Result(TypedDict):
    """One row: ours beside a baseline; `ratio` = baseline_value / value, `error` the accuracy of both."""

    case: str
    metric: str
    value: float | None
    unit: str
    baseline: str
    baseline_value: float | None
    ratio: float | None
    error: float | None


def result(
    case: str,
    metric: str,
    value: float | None,
    unit: str,
    baseline: str = "",
    baseline_value: float | None = None,
    error: float | None = None,
) -> Result:
    """Make a row; the ratio follows from the two values."""
    ratio = baseline_value / value if baseline_value is not None and value else None
    return Result(
        case=case,
        metric=metric,
        value=value,
        unit=unit,
        baseline=baseline,
        baseline_value=baseline_value,
        ratio=ratio,
        error=error,
    )


def pin() -> str:
    """Keep this process on one processor, where the system allows it; says what was done."""
    if not hasattr(os, "sched_setaffinity"):
        return "one thread (this system pins no process to a processor)"
    processor = max(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {processor})
    return f"one thread on processor {processor}"


def spent() -> float:
    """Processor time of this process and of the compilers that it ran, s."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def seconds(call: Callable[[], Any], repeats: int = 5) -> float:
    """Least processor time of `repeats` calls, s, after one call that warms caches.

    Not wall time: on a shared machine that is other people's work.
    """
    call()
    best = float("inf")
    for _ in range(repeats):
        start = time.process_time()
        call()
        best = min(best, time.process_time() - start)
    return best


def least(call: Callable[[], Any], budget: float = 0.5, most: int = 15) -> float:
    """Least processor time of a call, s: as many repetitions as a time of `budget` s holds, 2 to `most`."""
    start = time.process_time()
    call()
    first = time.process_time() - start
    if first > budget:  # nothing to warm that would show
        start = time.process_time()
        call()
        return min(first, time.process_time() - start)
    start = time.process_time()
    call()
    once = time.process_time() - start
    return min(once, seconds(call, max(2, min(most, int(budget / max(once, 1e-6))))))


def least_in_turn(calls: Sequence[Callable[[], Any]], budget: float = 0.5, most: int = 15) -> list[float]:
    """Least processor time of each of several calls, s, made in turn: for ratios of calls that are alike.

    What else the machine does in the meantime meets all of them.
    """
    for call in calls:
        call()
    best, spent_, rounds = [float("inf")] * len(calls), 0.0, 0
    while rounds < 3 or (rounds < most and spent_ < budget * len(calls)):
        for k, call in enumerate(calls):
            start = time.process_time()
            call()
            took = time.process_time() - start
            best[k], spent_ = min(best[k], took), spent_ + took
        rounds += 1
    return best


def table(rows: Sequence[Result]) -> str:
    """Rows as aligned text."""
    columns = ("case", "metric", "value", "unit", "baseline", "baseline_value", "ratio", "error")
    cells = [columns, *(tuple(_text(row[c]) for c in columns) for row in rows)]  # type: ignore[literal-required]
    widths = [max(len(line[k]) for line in cells) for k in range(len(columns))]
    return "\n".join(
        "  ".join(c.ljust(w) for c, w in zip(line, widths, strict=True)).rstrip() for line in cells
    )


def _text(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def write_json(rows: Sequence[Result], path: str | Path) -> None:
    """Store rows as a JSON list."""
    Path(path).write_text(json.dumps(list(rows), indent=1) + "\n", encoding="utf-8")
