"""Plans under system limits in a study: searched, replayed, judged, written, drawn and told."""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer

from dcvrt import cli
from dcvrt.planning import replay
from dcvrt.planning.requirement import SystemLimit
from dcvrt.planning.verdict import limit_verdict
from dcvrt.studies import outputs, plans
from dcvrt.studies.comparison import comparison
from dcvrt.studies.figures import system_limit as picture
from dcvrt.studies.findings import Findings
from dcvrt.studies.report import system_limit as page
from dcvrt.studies.setting import Setting
from dcvrt.studies.store import Store, records
from dcvrt.studies.study import Result
from dcvrt.studies.style import styled
from dcvrt.studies.system_limit import in_closed_loop, write_front
from tests.planning.test_requirement import SITES as BUSES
from tests.planning.test_requirement import D, exact
from tests.studies.stand_in import WORSE, run, setting, stand_in
from tests.studies.synthetic import CORNER, PERIODS, SITES, checked_run, make


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    return stand_in(monkeypatch)


def test_every_limit_has_a_plan_that_the_replay_passes(tmp_path: Path, asked: list) -> None:
    study = setting()
    plans = run(tmp_path, study)
    assert len(plans) == 2 * 2 * 6
    for plan in plans:
        key = (plan["mode"], plan["beta"], plan["limit_name"])
        assert plan["replayed"] == 1, key
        if not plan["total_mw"]:
            continue
        assert plan["passed"] == 1, key
        assert len(plan["losses"]) == len(PERIODS) * len(study.file.fault)
        H = np.array([plan["by_site"][str(bus)] for bus in SITES])
        for entry in plan["losses"]:  # against the closed form, not through the code under test
            d = PERIODS[entry["period"]][2]
            fault = next(f for f in study.file.fault if replay.fault_label(f.model_dump()) == entry["fault"])
            shares = [
                checked_run(study.file, entry["period"], fault, s, plan["mode"], plan["beta"], H)[
                    "loss_share"
                ]
                for s in SITES
            ]
            expected = d * float(H @ (np.array(shares) + WORSE))
            allowed = plan["limit_mw"] + plan["limit_share"] * d * H.sum()
            assert entry["loss_mw"] == pytest.approx(expected, abs=1e-9)
            assert entry["limit_mw"] == pytest.approx(allowed)
            assert entry["loss_mw"] <= allowed
        assert plan["aggregate_loss_mw"] == max(entry["loss_mw"] for entry in plan["losses"])


def test_capacity_rises_with_the_limit_up_to_what_the_network_takes(tmp_path: Path, asked: list) -> None:
    plans = run(tmp_path, setting())
    for mode in ("gfl", "gfm"):
        for beta in (1.15, 1.35):
            here = [p for p in plans if (p["mode"], p["beta"], p["limit_share"]) == (mode, beta, 0.0)]
            totals = [p["total_mw"] for p in sorted(here, key=lambda p: p["limit_mw"])]
            assert totals[0] == 0.0
            assert totals == sorted(totals)
            assert totals[-1] == pytest.approx(0.8 * sum(CORNER))
            (everything,) = [
                p for p in plans if (p["mode"], p["beta"], p["limit_share"]) == (mode, beta, 1.0)
            ]
            assert everything["total_mw"] == pytest.approx(totals[-1])


def test_every_mode_and_rating_has_a_front_of_what_was_replayed(tmp_path: Path, asked: list) -> None:
    study = setting()
    plans = run(tmp_path, study)
    with Store(tmp_path / "study.sqlite", write=True) as store:
        write_front(store, study)
        front, hostings = records(store.system_front()), records(store.hostings())
    by_name = {row["name"]: row["by_site"] for row in hostings}
    places = [(period, fault) for period in PERIODS for fault in study.file.fault]

    def lost(mode: str, beta: float, by_site: dict[str, float]) -> float:
        """In the worst fault, by the closed form; a site that does not hold its voltage is lost whole."""
        H = np.array([by_site[str(bus)] for bus in SITES])
        worst = 0.0
        for period, fault in places:
            runs = [checked_run(study.file, period, fault, s, mode, beta, H) for s in SITES]
            shares = [r["loss_share"] + WORSE if r["v_margin_pu"] >= 0 else 1.0 for r in runs]
            worst = max(worst, PERIODS[period][2] * float(H @ shares))
        return worst

    assert {(row["mode"], row["beta"]) for row in front} == set(study.runs)  # limits were searched at two
    for run_ in study.runs:
        here = [row for row in front if (row["mode"], row["beta"]) == run_]
        for row in here:
            assert row["loss_mw"] == pytest.approx(lost(*run_, by_name[row["hosting"]]), abs=1e-9)
            assert row["total_mw"] == pytest.approx(sum(by_name[row["hosting"]].values()))
        for less, more in itertools.pairwise(here):
            assert less["loss_mw"] <= more["loss_mw"]
            assert less["total_mw"] < more["total_mw"]
        for by_site in by_name.values():  # no candidate is better than the front
            replayed = [r for r in asked if not r["gradients"] and r["hosting"] == list(by_site.values())]
            if replayed and sum(by_site.values()) > 0:
                loss = lost(*run_, by_site) + 1e-9
                assert page.within(here, loss) >= sum(by_site.values()) - 1e-9
    for plan in plans:
        if plan["limit_share"] == 0.0:
            here = [row for row in front if (row["mode"], row["beta"]) == (plan["mode"], plan["beta"])]
            assert page.within(here, plan["limit_mw"]) >= plan["total_mw"] - 1e-9


def test_limits_change_nothing_of_the_frontier_and_simulate_nothing_twice(
    tmp_path: Path, asked: list
) -> None:
    def found(folder: Path, study: Setting) -> list[tuple]:
        run(folder, study)
        with Store(folder / "study.sqlite") as store:
            return [(p["mode"], p["beta"], p["by_site"]) for p in records(store.plans())]

    without = found(tmp_path / "without", setting(loss_mw=[], loss_share=[]))
    asked.clear()
    assert found(tmp_path / "with", setting()) == without
    faults = [
        (r["engine"], tuple(r["hosting"]), r["period"]["name"], fault["bus"], tuple(map(tuple, r["runs"])))
        for r in asked
        for fault in r["faults"]
    ]
    assert len(faults) == len(set(faults))


def test_a_finished_search_asks_nothing_more_and_another_limit_asks_for_itself(
    tmp_path: Path, asked: list
) -> None:
    first = run(tmp_path, setting())
    asked.clear()
    assert run(tmp_path, setting()) == first
    assert asked == []
    fewer = run(tmp_path, setting(loss_mw=[15.0, 25.0], loss_share=[]))
    assert {p["limit_name"] for p in fewer} == {"15 MW", "25 MW"}
    before = {(p["mode"], p["beta"]): p["by_site"] for p in first if p["limit_name"] == "15 MW"}
    after = {(p["mode"], p["beta"]): p["by_site"] for p in fewer if p["limit_name"] == "15 MW"}
    assert after.keys() == before.keys()
    for run_, by_site in after.items():
        assert sum(by_site.values()) == pytest.approx(sum(before[run_].values()), rel=0.005)


def test_what_limits_take_is_counted_apart(tmp_path: Path, asked: list) -> None:
    run(tmp_path / "without", setting(loss_mw=[], loss_share=[]))
    run(tmp_path / "with", setting())
    spent = []
    for name in ("without", "with"):
        with Store(tmp_path / name / "study.sqlite") as store:
            spent.append(comparison(store)["simulations"])
    assert spent[0]["frontier"] == spent[1]["frontier"]
    assert spent[0]["system_search"]["grid"] == spent[0]["system_replay"]["grid"] == 0
    assert spent[1]["system_replay"]["grid"] > 0


# -- verdict, tables, figure and page ------------------------------------------------------------------------


LIMITED = (
    # limit, MW at bus 75, passed, lost at once, lost whole, settled, refused searches' text
    (0.0, 0.0, 1, 0.0, [], True, []),
    (20.0, 90.0, 1, 19.9, [75], True, ["loss of all sites: bus 75: NORMAL becomes NORMAL>BATTERY"]),
    (40.0, 120.0, 0, 43.0, [], False, []),
    (80.0, 150.0, 1, 61.0, [], True, []),
)


FRONT = [{"total_mw": 80.0, "loss_mw": 12.0}, {"total_mw": 140.0, "loss_mw": 33.0}]


def put_limits(store: Store, runs: list[tuple[str, float]]) -> None:
    store.put("system_front", [
        {"mode": "gfl", "beta": 1.2, "hosting": f"p{k}", **row} for k, row in enumerate(FRONT)
    ])  # fmt: skip
    for mode, beta in runs:
        for mw, hosted, passed, lost, whole, settled, sequence in LIMITED:
            losses = [
                {"period": "peak", "fault": "bus 65, 100 ms", "loss_mw": lost, "limit_mw": mw, "whole": whole}
            ]
            by_site = {str(bus): hosted if bus == 75 else 0.0 for bus in SITES}
            store.put("system_plans", [{
                "mode": mode, "beta": beta, "limit_name": f"{mw:g} MW", "limit_mw": mw, "limit_share": 0.0,
                "hosting": plans.plan_name(by_site), "total_mw": hosted, "by_site": by_site, "binding": [],
                "closed": {}, "ac_passed": 1, "ac_status": "made up", "replayed": 1, "passed": passed,
                "aggregate_loss_mw": lost, "losses": losses if hosted else [],
                "search": {"candidates": 1, "refused": 0, "gap": 0.0, "settled": settled,
                           "by_sequence": sequence, "margins": [{"price": 2.5}] if mw == 20.0 else []},
            }])  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = make(tmp_path_factory.mktemp("study"), failing=False)
    with Store(folder / "study.sqlite", write=True) as store:
        for plan in records(store.plans()):
            if plan["method"] == "paper":
                store.put("plans", [plan | {"method": "frontier", "search": {"margins": []}}])
        put_limits(store, [("gfl", 1.15), ("gfl", 1.35), ("gfm", 1.15), ("gfm", 1.35)])
        outputs.write_results(folder, store)
    return folder


def test_the_verdict_counts_what_is_missing_and_what_has_no_result() -> None:
    limit = SystemLimit(BUSES, D, mw=30.0)
    fine = exact([10.0, 20.0, 0.0], [[0.1, 0.2]] * 3, [0.25, 1.0, 0.1])
    found = limit_verdict([fine], limit, 1)
    assert found["passed"]
    assert found["aggregate_loss_mw"] == pytest.approx(0.8 * 22.5)
    assert found["losses"] == [
        {"period": "peak", "fault": "a", "loss_mw": pytest.approx(18.0), "limit_mw": 30.0, "whole": [75]}
    ]
    assert not limit_verdict([fine], limit, 2)["passed"]
    assert limit_verdict([fine], limit, 2)["n_failed"] == 1
    unknown = exact([10.0, 20.0, 0.0], [[0.1, 0.2], [np.nan, np.nan], [0.1, 0.2]], [0.25, np.nan, 0.1])
    found = limit_verdict([unknown], limit, 1)
    assert (found["passed"], found["n_failed"], found["aggregate_loss_mw"]) == (False, 1, None)
    too_much = exact([100.0, 20.0, 0.0], [[0.1, 0.2]] * 3, [0.25, 1.0, 0.1])
    assert not limit_verdict([too_much], limit, 1)["passed"]
    assert limit_verdict([], limit, 0)["passed"]


def test_tables_tell_the_plans_and_their_verdicts(folder: Path) -> None:
    summary = json.loads((folder / "summary.json").read_text())
    row = next(
        r for r in summary["system_limit"] if (r["mode"], r["beta"], r["limit"]) == ("gfl", 1.15, "20 MW")
    )
    assert row["total_mw"] == 90.0
    assert row["passed"] is True
    assert row["lost_whole"] == [75]
    assert row["price_mw_per_mw"] == 2.5
    assert not any("system" in r["method"] for r in summary["rows"])
    full = json.loads((folder / "frontier.json").read_text())["system_limit"]
    assert {r["limit"] for r in full["rows"]} == {"0 MW", "20 MW", "40 MW", "80 MW"}
    frontier = [p for p in summary["rows"] if p["method"] == "frontier"]
    assert len(full["every_site"]) == len(frontier)
    table = Result(folder).table()
    mine = table[table.method == "system limit 40 MW"]
    assert set(mine.replay) == {"failed"}
    assert set(mine.bus_75_mw) == {120.0}


def test_the_figure_has_a_curve_a_rating_and_crosses_out_what_failed(folder: Path) -> None:
    findings = Findings(folder)
    with styled():
        figure = picture.draw(findings)
    assert figure is not None
    assert len(figure.axes) == 2
    for axes, betas in zip(figure.axes, (("1.15", "1.2", "1.35"), ("1.15", "1.35")), strict=True):
        labels = axes.get_legend_handles_labels()[1]
        assert labels == [f"β = {beta}" for beta in betas]
        crosses = [line for line in axes.lines if line.get_marker() == "x"]
        assert [line.get_xydata().tolist() for line in crosses] == [[[43.0, 120.0]] * 2]
        assert axes.get_xlim()[1] > 61.0
    (steps,) = [line for line in figure.axes[0].lines if line.get_label() == "β = 1.2"]
    assert steps.get_drawstyle() == "steps-post"
    assert steps.get_xydata()[:3].tolist() == [[0.0, 0.0], [12.0, 80.0], [33.0, 140.0]]
    texts = [text.get_text() for text in figure.legends[0].get_texts()]
    assert texts == [
        "without ride-through", "replayed: as much at this loss, or more", "searched within a limit",
        "every site rides through", "failed the replay",
    ]  # fmt: skip


def test_the_page_tells_the_trade_off_and_what_it_rests_on(folder: Path) -> None:
    text = page.system_limit(Findings(folder))
    assert "4 plan(s) within a limit failed the replay and must not be used" in text
    assert "GFL at β 1.15 within 40 MW: 120.0 MW, loses 43.0 MW at once" in text
    assert "GFL, β = 1.15: within 20 MW: 90.0 MW, 80 MW: 150.0 MW." in text
    assert "Searches that ended before nothing was left to gain: GFL at β 1.15 within 40 MW" in text
    assert "bus 75: NORMAL becomes NORMAL&gt;BATTERY" in text
    assert "both read in secondary sources" in text
    assert "The largest plans were searched at 2 of the 4 ratings studied: 1.15, 1.35." in text
    assert "At least hosted within a limit (MW), by what was replayed" in text
    assert page.within(FRONT, 20.0) == 80.0


def loses(mw: float) -> dict[str, Any]:
    return {"passed": True, "aggregate_loss_mw": mw}


def test_sentences_compare_with_sites_that_all_ride_through() -> None:
    found = {
        "rows": [
            loses(10.0) | {"mode": "gfl", "beta": 1.1, "limit": "10 MW", "total_mw": 90.0},
            loses(30.0) | {"mode": "gfl", "beta": 1.1, "limit": "30 MW", "total_mw": 99.0},
            {"mode": "gfm", "beta": 1.1, "limit": "20 MW", "total_mw": 0.0, "passed": None},
        ],
        "every_site": [
            {"mode": "gfl", "beta": 1.1, "total_mw": 50.0, "passed": True, "aggregate_loss_mw": 12.0},
            {"mode": "gfm", "beta": 1.1, "total_mw": 0.0, "passed": None, "aggregate_loss_mw": 0.0},
        ],
    }
    assert page.sentences(found) == [
        "GFL, β = 1.1: within 10 MW: 90.0 MW, 30 MW: 99.0 MW. With every site riding through 50.0 MW, of "
        "which up to 12.0 MW are lost at once. Within 10 MW more is hosted and less is lost.",
        "GFM, β = 1.1: no limit lets it host. With every site riding through nothing can be hosted.",
    ]


def test_in_closed_loop_the_losses_of_all_sites_are_added_up() -> None:
    """By hand: 100 MW at 0.9, of which 60 at bus 21 lose 0.1 and 40 at bus 75 lose 0.3."""
    plan = {
        "hosting": "p1", "mode": "gfl", "beta": 1.15, "total_mw": 100.0, "by_site": {"21": 60.0, "75": 40.0},
        "limit_mw": 16.0, "limit_share": 0.0,
    }  # fmt: skip
    place = {"hosting": "p1", "mode": "gfl", "beta": 1.15, "period": "peak", "fault": "bus 25", "status": ""}
    rows = [
        place | {"site": 21, "loss_closed": 0.15, "voltage_closed": 0.05},
        place | {"site": 75, "loss_closed": -0.05, "voltage_closed": 0.05},
        place | {"hosting": "p2", "site": 75, "loss_closed": -0.7, "voltage_closed": 0.05},
    ]
    periods, criteria = {"peak": {"dc_factor": 0.9}}, {"loss_share": 0.25}

    def told(rows: list[dict[str, Any]], **limit: float) -> tuple[float, bool]:
        found = in_closed_loop(plan | limit, rows, periods, criteria)
        assert found is not None
        return found["aggregate_loss_mw"], found["passed"]

    assert told(rows) == (pytest.approx(0.9 * (60 * 0.1 + 40 * 0.3)), False)
    assert told(rows, limit_mw=0.0, limit_share=0.2) == (pytest.approx(16.2), True)
    unheld = [rows[0] | {"voltage_closed": -0.01}, rows[1]]  # servers drop off: all of it
    assert told(unheld, limit_mw=70.0) == (pytest.approx(0.9 * (60 + 40 * 0.3)), True)
    nan = float("nan")
    failed = [rows[0] | {"loss_closed": nan, "voltage_closed": nan, "status": "no run"}, rows[1]]
    assert told(failed, limit_mw=100.0) == (pytest.approx(0.9 * (60 + 40 * 0.3)), False)
    assert in_closed_loop(plan, [], periods, criteria) is None


def test_without_limits_there_is_neither_page_nor_figure(tmp_path: Path) -> None:
    findings = Findings(make(tmp_path))
    assert page.system_limit(findings) == ""
    assert picture.draw(findings) is None
    assert json.loads((tmp_path / "summary.json").read_text())["system_limit"] == []


def test_a_failed_plan_under_a_limit_ends_as_a_failed_plan_elsewhere(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Shown as failed; the exit code is that of the study, as for every other plan."""
    cli._show(Result(folder))
    assert "system limit 40 MW" in capsys.readouterr().out
    with pytest.raises(typer.Exit) as ended:
        cli._show(Result(folder, ["candidates task: timeout"]))
    assert ended.value.exit_code == cli.INCOMPLETE
