"""The paper's method and the frontier side by side: data, page, and what is said when nothing is a plan."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import typer

from dcvrt import cli
from dcvrt.studies import outputs
from dcvrt.studies.comparison import comparison
from dcvrt.studies.findings import Findings
from dcvrt.studies.report.frontier import frontier
from dcvrt.studies.store import Store, records
from dcvrt.studies.study import Result
from tests.studies.synthetic import CORNER, SITES, make

MARGIN = {
    "period": "peak",
    "fault": "bus 32, 100 ms",
    "site": 21,
    "target": "loss",
    "label": "loss at bus 21",
    "price": 2000.0,
    "by_beta": 1400.0,
    "mechanism": "limiter",
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A study whose frontier hosts everything from a rating of 1.35, and whose paper's fits pass or fail."""
    make(tmp_path, failing=True)
    with Store(tmp_path / "study.sqlite", write=True) as store:
        for plan in records(store.plans()):
            if plan["method"] != "paper":
                continue
            everything = plan["beta"] >= 1.35
            H = {str(bus): mw if everything else 0.0 for bus, mw in zip(SITES, CORNER, strict=True)}
            own = {
                "method": "frontier",
                "by_site": H,
                "total_mw": sum(H.values()),
                "passed": 1,
                "replayed": 1,
                "closed": {} if everything else {str(bus): "too weak" for bus in SITES},
                "search": {
                    "candidates": 2,
                    "refused": 0,
                    "gap": 0.001,
                    "settled": plan["beta"] != 1.5,
                    "by_sequence": ["loss at bus 75: NORMAL becomes NORMAL>BATTERY"],
                    "margins": [MARGIN] if everything else [],
                },
            }
            store.put("plans", [plan | own])
            if (plan["mode"], plan["beta"]) == ("gfl", 1.5):  # a false pass of the fits
                full = {str(bus): mw for bus, mw in zip(SITES, CORNER, strict=True)}
                false = {"by_site": full, "total_mw": sum(CORNER), "passed": 0, "closed": {}}
                store.put("plans", [plan | false])
        outputs.write_results(tmp_path, store)
    return tmp_path


def test_gain_counts_where_both_plans_passed(folder: Path) -> None:
    with Store(folder / "study.sqlite") as store:
        found = comparison(store)
        plans = {(p["method"], p["mode"], p["beta"]): p for p in records(store.plans())}
    assert len(found["rows"]) == 8
    for row in found["rows"]:
        paper = plans["paper", row["mode"], row["beta"]]
        fails = bool(paper["total_mw"] > 0 and not paper["passed"])
        assert row["paper"]["false_pass"] == fails
        if fails:
            assert row["gain_mw"] is None
        else:
            own = row["frontier"]["total_mw"]
            assert row["gain_mw"] == pytest.approx(own - paper["total_mw"])
    assert any(row["paper"]["false_pass"] for row in found["rows"])
    assert found["simulations"]["paper"]["grid"] == 16 * 2 * 4
    assert found["ratio"] == 0.0  # no search was made for these rows
    assert json.loads((folder / "frontier.json").read_text())["rows"][0]["mode"] in ("gfl", "gfm")


def test_hidden_capacity_is_said_in_words(folder: Path) -> None:
    with Store(folder / "study.sqlite") as store:
        found = comparison(store)
    for row in found["rows"]:
        more = row["frontier"]["total_mw"] - row["paper"]["total_mw"]
        said = [text for text in found["hidden"] if text.startswith(f"{row['mode']}, beta {row['beta']:g}:")]
        assert bool(said) == bool(row["frontier"]["passed"] and more > 0.005 * row["frontier"]["total_mw"])


def test_the_page_tells_limits_mechanisms_and_unsettled_searches(folder: Path) -> None:
    text = frontier(Findings(folder))
    assert "limiter; +14.0 MW per 0.01 of β" in text
    assert "bus 21 closed: too weak" in text
    assert "loss at bus 75: NORMAL becomes NORMAL&gt;BATTERY" in text
    assert "Searches that ended before nothing was left to gain: gfl at β 1.5, gfm at β 1.5." in text


def test_the_page_tells_from_which_rating_on_each_site_is_open(folder: Path) -> None:
    findings = Findings(folder)
    text = frontier(findings)
    rows = [row for row in findings.comparison["rows"] if row["mode"] == "gfl"]
    for bus in SITES:
        betas = [row["beta"] for row in rows if row["frontier"]["by_site"][str(bus)] > 0]
        since = f"from β = {min(betas):g}" if betas else "at none"
        assert f"bus {bus} {since}" in text.split("GFL: ", 1)[1].split("</li>", 1)[0]


def test_without_a_frontier_there_is_no_page(tmp_path: Path) -> None:
    assert frontier(Findings(make(tmp_path))) == ""


def test_no_plan_at_all_ends_with_code_3_and_the_reasons(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make(tmp_path, nothing=True)
    with pytest.raises(typer.Exit) as ended:
        cli._show(Result.of(tmp_path))
    assert ended.value.exit_code == cli.INFEASIBLE
    said = capsys.readouterr().err
    assert "No plan meets the criteria: every site is closed at every rating, in every mode." in said
    assert "gfl, beta 1.5, bus 21: " in said
