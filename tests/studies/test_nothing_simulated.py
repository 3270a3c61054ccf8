"""A study in which every run fails still ends with its tables, figures and report, and they say so."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from dcvrt.studies.figures import draw_all
from dcvrt.studies.findings import Findings
from dcvrt.studies.report import write_report
from dcvrt.studies.study import Result
from tests.studies.synthetic import make


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make(tmp_path_factory.mktemp("nothing"), nothing=True)


def test_every_figure_is_drawn_without_a_warning(folder: Path) -> None:
    drawn = {path.stem for path in draw_all(Findings(folder))}  # warnings are errors here
    assert {"capacity", "allocation", "validation", "retained_voltage", "network_map", "framework"} <= drawn


def test_the_report_says_that_nothing_could_be_simulated(folder: Path) -> None:
    text = write_report(Findings(folder)).read_text(encoding="utf-8")
    runs = 16 * 2 * 4 * 4 * 2 * 4  # samples, periods, faults, sites, modes, ratings
    assert (
        f"Nothing could be simulated: none of the {runs} facility runs has a result, so that no hosted load "
        "could be tested. Without ride-through it would be 391.8 MW."
    ) in text
    assert "What holds" not in text
    assert "No fit has a validation point." in text
    assert "gfl: no equilibrium at the first value of the waveform: 2048 run(s), at β = 1, 1.15," in text


def test_the_summary_hosts_nothing_and_has_no_verdict(folder: Path) -> None:
    result = Result.of(folder)
    rows = result.summary["rows"]
    assert {row["total_mw"] for row in rows} == {0.0}
    assert {row["replay"]["passed"] for row in rows} == {None}
    assert set(result.table().replay) == {"", "nothing hosted"}
    assert {score["violation_rate"] for score in result.summary["surrogate"]} == {None}
    assert json.loads((folder / "summary.json").read_text())["simulations"]["failed"] > 0
