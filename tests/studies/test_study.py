"""Whole studies: the same on any number of workers, resumed after a kill, refused in another folder."""

from __future__ import annotations

import itertools
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from dcvrt.errors import InputError
from dcvrt.planning import replay
from dcvrt.studies import outputs
from dcvrt.studies.config import load, template
from dcvrt.studies.store import Store, records
from dcvrt.studies.study import Result, Study, refuse_another_study, versions

SMALL = """
[study]
name = "small"
seed = 3

[grid]
case = "ieee118"
sites = [21, 75]
t_end_s = 1.0

[facility]
modes = ["gfl"]
beta = [1.1, 1.4]

[sampling]
n = 6
validation_share = 0.2

[system_limit]
loss_mw = [5.0]
beta = [1.1]

[[fault]]
bus = 25

[[fault]]
bus = 80

[[period]]
name = "peak"
hour = "peak"
"""


def small(folder: Path) -> Path:
    folder.mkdir(exist_ok=True)
    file = folder / "small.toml"
    file.write_text(SMALL)
    return file


def known(tmp_path: Path, study: dict, made_with: dict) -> Store:
    store = Store(tmp_path / "study.sqlite", write=True)
    store.note(study=study, versions=made_with)
    return store


def test_a_folder_of_the_same_study_is_taken(tmp_path: Path) -> None:
    file = load(template(), "a")
    with known(tmp_path, file.canonical(), versions()) as store:
        refuse_another_study(store, file, tmp_path)


def test_a_folder_of_another_study_is_refused_with_what_differs(tmp_path: Path) -> None:
    file = load(template(), "a")
    other = load(
        template().replace("loss_share = 0.25 ", "loss_share = 0.2 ").replace("bus = 25 ", "bus = 26 "), "b"
    )
    with (
        known(tmp_path, other.canonical(), versions()) as store,
        pytest.raises(InputError) as caught,
    ):
        refuse_another_study(store, file, tmp_path)
    assert str(caught.value) == (
        f"{tmp_path} holds the results of another study:\n"
        "  criteria.loss_share: was 0.2, is 0.25\n"
        "  fault[1].bus: was 26, is 25\n"
        "Way out: take another folder with --out, or undo the change."
    )


def test_a_folder_made_with_other_versions_is_refused(tmp_path: Path) -> None:
    file = load(template(), "a")
    with (
        known(tmp_path, file.canonical(), versions() | {"casadi": "3.6.0"}) as store,
        pytest.raises(InputError) as caught,
    ):
        refuse_another_study(store, file, tmp_path)
    assert str(caught.value) == (
        f"{tmp_path} was made with other versions:\n  casadi: was 3.6.0, is {versions()['casadi']}\n"
        "Way out: take another folder with --out, or undo the change."
    )


@pytest.mark.parametrize(
    ("out", "told"),
    [
        ("taken", "is a file, not a folder"),
        ("taken/below", "cannot be made: {place} is a file"),
        ("taken/far/below", "cannot be made: {place} is a file"),
    ],
)
def test_a_folder_that_cannot_be_is_refused_before_any_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, out: str, told: str
) -> None:
    monkeypatch.setattr(Study, "setting", lambda *_: pytest.fail("work was done"))
    (tmp_path / "taken").write_text("mine")
    with pytest.raises(InputError) as caught:
        Study.load(small(tmp_path)).run(tmp_path / out)
    told = told.format(place=tmp_path / "taken")
    assert str(caught.value) == f"{tmp_path / out} {told}. Way out: take another folder with --out."


def test_a_folder_without_permission_is_refused_before_any_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(**_: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(outputs.tempfile, "TemporaryFile", refused)
    with pytest.raises(InputError) as caught:
        outputs.refuse_unusable(tmp_path / "a" / "b")
    assert str(caught.value) == (
        f"{tmp_path / 'a' / 'b'} cannot be written: {tmp_path}: Permission denied. "
        "Way out: take another folder with --out."
    )
    assert list(tmp_path.iterdir()) == []


def test_what_is_refused_before_the_first_task_leaves_no_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    study = Study.load(small(tmp_path))
    with pytest.raises(InputError, match="no dask scheduler answers"):
        study.run(tmp_path / "out", scheduler="tcp://127.0.0.1:9")
    replay._simulator.cache_clear()
    monkeypatch.setenv("CC", "/bin/false")
    with pytest.raises(InputError, match=r"^CC = '/bin/false' is not a compiler that runs"):
        study.run(tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_values_that_no_run_takes_are_refused_before_the_first_task(tmp_path: Path) -> None:
    request = {
        "case": "ieee118",
        "dynamics": None,
        "sites": [21],
        "redispatch": "proportional",
        "reactive_limits": True,
        "engine": "native",
        "gradients": False,
        "runs": [["gfl", 1.0], ["gfl", 9.0]],
        "parameters": {},
        "period": {"dc_factor": 0.05},
        "pf": 0.98,
    }
    with pytest.raises(InputError) as caught:
        replay.prepare_facility(request | {"runs": [["gfl", 1.0]]})
    assert str(caught.value) == "d = 0.05 is outside [0.1, 1.2]."
    with pytest.raises(InputError) as caught:
        replay.prepare_facility(request | {"period": {"dc_factor": 1.0}})
    assert str(caught.value) == "beta = 9 is outside [0.8, 2]."


def test_an_unfinished_study_has_no_result(tmp_path: Path) -> None:
    known(tmp_path, {}, {}).close()
    with pytest.raises(InputError) as caught:
        Result.of(tmp_path)
    assert str(caught.value) == (
        f"{tmp_path}: the study is not finished. Way out: the same 'dcvrt study run' resumes it."
    )


def test_a_file_is_there_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    outputs.write_atomically(tmp_path / "summary.json", "first")

    def full(_: int) -> None:
        raise OSError("no space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="no space left"):
        outputs.write_atomically(tmp_path / "summary.json", "second, half-written")
    assert (tmp_path / "summary.json").read_text() == "first"


@pytest.mark.slow
def test_a_study_on_one_and_two_workers_and_after_a_kill_gives_the_same(tmp_path: Path) -> None:
    """One worker without a break; two workers, killed in the middle and started again: the same numbers."""
    file = small(tmp_path)
    one = Study.load(file).run(tmp_path / "one", workers=1)
    assert one.complete
    finished_first = finished(tmp_path / "one", seconds=True)

    command = [sys.executable, "-m", "dcvrt.cli", "study", "run", str(file)]
    command += ["--out", str(tmp_path / "two"), "--workers", "2"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    first = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    done: set[str] = set()
    deadline = time.monotonic() + 300
    while len(done) < 2 and first.poll() is None and time.monotonic() < deadline:
        time.sleep(0.1)
        done = finished(tmp_path / "two")
    first.send_signal(signal.SIGKILL)
    first.wait()
    assert not (tmp_path / "two" / "summary.json").exists(), "nothing half-done may look like a result"
    with pytest.raises(InputError, match="is not finished"):
        Result.of(tmp_path / "two")
    before = finished(tmp_path / "two", seconds=True)
    assert before
    subprocess.run(command, check=True, timeout=500, env=environment, capture_output=True)
    after = finished(tmp_path / "two", seconds=True)
    assert before <= after, "a finished task was done again"

    two = Result.of(tmp_path / "two")
    a, b = one.summary, two.summary
    for key in ("no_vrt", "rows", "surrogate", "simulations"):
        assert a[key] == b[key], key
    for role in ("sample", "plan"):
        with Store(tmp_path / "one" / "study.sqlite") as s, Store(tmp_path / "two" / "study.sqlite") as t:
            assert s.margins(role).equals(t.margins(role))
            assert s.system_plans().equals(t.system_plans())

    check_summary(a)
    stored = json.loads((tmp_path / "one" / "summary.json").read_text())
    assert stored == a
    Study.load(file).run(tmp_path / "one", workers=1)
    with Store(tmp_path / "one" / "study.sqlite") as s:
        assert not [t for t in records(s.tasks()) if t["status"] != "done"]
        again = {(t["hash"], t["seconds"]) for t in records(s.tasks())}
    assert again == finished_first, "a finished study asked for more simulations"
    for name in ("table.csv", "validation.csv", "study.toml", "report.html"):
        assert (tmp_path / "one" / name).stat().st_size > 0


def finished(folder: Path, seconds: bool = False) -> set:
    """Keys of the tasks done so far, with the time they took (a task done again takes another time)."""
    if not (folder / "study.sqlite").is_file():
        return set()
    try:
        with Store(folder / "study.sqlite") as store:
            tasks = records(store.tasks())
    except InputError:
        return set()  # being made
    return {(t["hash"], t["seconds"]) if seconds else t["hash"] for t in tasks if t["status"] == "done"}


def check_summary(summary: dict) -> None:
    """The keys that programs rely on, and what must be true of every study."""
    assert set(summary) == {
        "no_vrt", "rows", "system_limit", "surrogate", "simulations", "wall_s", "versions",
    }  # fmt: skip
    assert set(summary["no_vrt"]) == {"total_mw", "by_site"}
    assert set(summary["simulations"]) == {"grid", "facility", "failed", "quarantined"}
    (limited,) = summary["system_limit"]
    assert limited["passed"] is True
    assert 0.0 < limited["aggregate_loss_mw"] <= limited["limit_mw"]
    totals: dict[tuple[str, str], list[float]] = {}
    for row in summary["rows"]:
        assert set(row) == {"mode", "beta", "method", "total_mw", "by_site", "binding", "replay", "ac"}
        assert set(row["replay"]) == {
            "engine", "passed", "worst_voltage_margin_pu", "worst_loss_margin_mw", "aggregate_loss_mw",
        }  # fmt: skip
        assert (row["replay"]["passed"] is None) == (row["total_mw"] == 0)
        assert set(row["ac"]) == {"passed", "v_min_pu", "v_error_pu"}
        assert row["total_mw"] == pytest.approx(sum(row["by_site"].values()))
        assert row["total_mw"] <= summary["no_vrt"]["total_mw"] + 1e-3
        totals.setdefault((row["method"], row["mode"]), []).append(row["total_mw"])
    for (method, _), values in totals.items():
        if method == "frontier":  # more rating can cost margin in grid-forming mode, and the search sees it
            continue
        assert all(b >= a - 1e-6 for a, b in itertools.pairwise(values))
    for row in summary["surrogate"]:
        assert set(row) == {
            "method", "mode", "target", "mae", "rmse", "worst_over", "worst_under", "violation_rate", "n_fit",
            "n_validation", "n_validation_failed",
        }  # fmt: skip
