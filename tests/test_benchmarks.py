"""The benchmarks run on their smallest case and report rows of the agreed shape; no claim about time."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from benchmarks import _case, ensemble, integrators, sensitivities
from benchmarks.__main__ import names
from benchmarks._plot import work_precision
from benchmarks._precision import Curve, compare, walk
from benchmarks.baselines import CannotRun, generated, interpreted, native_events, python_solvers
from benchmarks.harness import Result, table, write_json
from dcvrt import facility
from dcvrt.integrators import find_compiler

COLUMNS = {"case", "metric", "value", "unit", "baseline", "baseline_value", "ratio", "error"}
needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="generated C needs a compiler")


def check(rows: list[Result], tmp_path: Path) -> None:
    assert rows
    for row in rows:
        assert set(row) == COLUMNS
        if row["ratio"] is not None:
            assert row["ratio"] == pytest.approx(row["baseline_value"] / row["value"])  # type: ignore[operator]
    path = tmp_path / "rows.json"
    write_json(rows, path)
    assert json.loads(path.read_text()) == json.loads(json.dumps(rows))
    assert len(table(rows).splitlines()) == len(rows) + 1


def test_what_is_a_benchmark() -> None:
    assert names() == ["ensemble", "frontier", "grid", "hosting", "integrators", "sensitivities"]


@needs_compiler
@pytest.mark.parametrize("module", [integrators, sensitivities, ensemble])
def test_smoke(module: object, tmp_path: Path) -> None:
    rows = module.run(smoke=True)  # type: ignore[attr-defined]
    check(rows, tmp_path)
    assert any(row["ratio"] is not None for row in rows)


@needs_compiler
def test_baselines_solve_the_case_that_they_are_given() -> None:
    """Tight, each agrees with the reference: what is compared is the same problem."""
    dae = facility.gfl().compile()
    case = _case.build("gfl", dae, _case.disturbances(smoke=True), values={"beta": 1.15})
    assert case.reference.run.events
    for make in (
        generated.single(case.equations, "erk", case),
        interpreted.make(case, "idas", True),
        python_solvers.scipy(case, "LSODA"),
    ):
        path, _ = case.errors(make(1e-9).path())
        assert path < 1e-6


@needs_compiler
def test_sensitivities_of_baselines_cross_events_on_states() -> None:
    dae = facility.gfm().compile()
    values = {"beta": 1.05, "sup.V_dip": 0.3, "sup.V_low": 0.25, "sup.V_deep": 0.2, "sup.V_back": 0.9}
    case = _case.build("gfm", dae, _case.disturbances(smoke=True), ("beta", "dc.T_hold"), values)
    assert np.abs(case.jump).max() > 1e-3
    for forward in (True, False):
        _, error = case.errors(generated.single(case.equations, "erk", case, forward)(1e-11).path())
        assert error < 1e-4
    object.__setattr__(case, "jump", np.zeros_like(case.jump))
    _, error = case.errors(generated.single(case.equations, "erk", case)(1e-9).path())
    assert error > 1e-2


def test_native_events_miss_what_a_fault_does() -> None:
    fired = {row["metric"]: row["value"] for row in native_events.evidence()}
    assert fired["fired: a state crosses a guard (control)"] == 1.0


def test_the_cheapest_run_within_the_error_counts() -> None:
    curve = Curve("a", "f", [1e-3, 1e-4, 1e-5], [3.0, 1.0, 2.0], [1e-2, 5e-5, 1e-6])
    assert curve.at(1e-4) == (1.0, 5e-5, 1e-4)
    assert curve.at(1e-7) is None


def test_a_solver_that_fails_says_so_in_its_row() -> None:
    def fails(rtol: float) -> tuple[object, float]:
        raise CannotRun("too stiff")

    curve = walk("theirs", "x", fails, (1e-3,), (1e-3,))  # type: ignore[arg-type]
    ours = Curve("ours", "dcvrt", [1e-3], [1.0], [1e-4])
    (row,) = compare("case", "run", [ours], [curve], (1e-3,))
    assert row["baseline"] == "theirs (n/a: rtol 0.001: too stiff)"
    assert row["ratio"] is None


def test_ours_that_misses_the_target_is_told() -> None:
    ours = Curve("ours", "dcvrt", [1e-3], [1.0], [math.inf])
    (row,) = compare("case", "run", [ours], [], (1e-3,))
    assert row["metric"] == "run: ours does not reach 0.001"
    assert row["value"] is None


def test_picture(tmp_path: Path) -> None:
    curve = Curve("ours", "dcvrt", [1e-3, 1e-4], [1.0, 2.0], [1e-3, 1e-4])
    work_precision({"case": [curve]}, "error", (1e-3,), tmp_path / "made" / "picture")
    assert (tmp_path / "made" / "picture.svg").stat().st_size > 0
    assert (tmp_path / "made" / "picture.png").stat().st_size > 0
