"""The last phase of a study on a real one: two sites, two faults, a rating whose plan a margin holds, and one
whose plan the network holds."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from dcvrt.studies import sensitivity
from dcvrt.studies.campaign import Campaign, InProcess
from dcvrt.studies.config import load
from dcvrt.studies.progress import Silent
from dcvrt.studies.sensitivity import headline, run_sensitivity
from dcvrt.studies.store import Store, records
from dcvrt.studies.study import Result, Study

TINY = """
[study]
name = "two sites"
[grid]
case = "ieee118"
sites = [21, 75]
[hosting]
hours = [4000, 4024]
[[fault]]
bus = 25
[[fault]]
bus = 80
[[period]]
name = "peak"
hour = "peak"
[facility]
modes = ["gfl"]
beta = [1.1, 1.15]
[sampling]
n = 6
[surrogate]
methods = ["paper"]
[replay]
engine = "native"
[sensitivity]
change = 0.05
reruns = 2
[sensitivity.ranges]
"criteria.loss_share" = [0.245, 0.255]
"lag.tau" = [0.0035, 0.006]
"lim.w_full" = [1.0, 1.5]
"sup.V_dip" = [0.88, 0.95]
"sup.T_dip" = [0.05, 0.4]
"""


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Study:
    file = tmp_path_factory.mktemp("study") / "tiny.toml"
    file.write_text(TINY)
    return Study.load(file)


@pytest.fixture(scope="module")
def result(study: Study) -> Result:
    return study.run(study.folder / "results")


@pytest.fixture(scope="module")
def rows(result: Result) -> dict[str, dict[str, Any]]:
    with Store(result.folder / "study.sqlite") as store:
        return {row["path"]: row for row in records(store.sensitivities())}


@pytest.fixture(scope="module")
def about(result: Result) -> dict[str, Any]:
    with Store(result.folder / "study.sqlite") as store:
        return store.provenance()["sensitivity_plans"]["gfl"]


def test_the_plan_that_a_margin_holds_is_looked_at(about: dict[str, Any]) -> None:
    assert about["beta"] == 1.1
    (item,) = about["binding"]
    assert (item["site"], item["target"], item["fault"]) == (21, "loss", "bus 25, 100 ms")
    assert item["price"] > 0


def test_the_loss_share_is_worth_the_price_of_the_margin(
    rows: dict[str, dict[str, Any]], about: dict[str, Any]
) -> None:
    share = rows["criteria.loss_share"]
    assert share["by_unit"] == pytest.approx(about["binding"][0]["price"])
    for side in ("low", "high"):
        end = share["sides"][side]
        assert end["linear_mw"] == pytest.approx(share["by_unit"] * (end["value"] - 0.25))


def test_a_search_confirms_what_gradients_say_and_the_network_ends(
    rows: dict[str, dict[str, Any]], about: dict[str, Any], result: Result
) -> None:
    """Tightened, the plan shrinks by what gradients say, to their curvature; relaxed, both end at the plan
    without ride-through, well before the first order does."""
    low, high = (rows["criteria.loss_share"]["sides"][side] for side in ("low", "high"))
    found = [end["rerun_mw"] - about["rerun_mw"] for end in (low, high)]
    assert low["gradient_mw"] == pytest.approx(low["linear_mw"], rel=0.01)
    assert found[0] == pytest.approx(low["gradient_mw"], rel=0.05)
    room = result.summary["no_vrt"]["total_mw"] - about["total_mw"]
    assert found[1] == pytest.approx(room, abs=0.01)
    assert high["gradient_mw"] == pytest.approx(room, abs=0.01)
    assert high["linear_mw"] > 1.5 * room


def test_events_that_are_gained_are_seen_by_runs_where_gradients_are_blind(
    rows: dict[str, dict[str, Any]],
) -> None:
    """With 50 ms of patience the supervisor leaves the grid in a dip of 100 ms; no gradient knows of it."""
    hasty = rows["sup.T_dip"]
    assert hasty["by_unit"] == 0.0
    assert set(hasty["sides"]["low"]["unseen"]) == {"21", "75"}
    for why in hasty["sides"]["low"]["unseen"].values():
        assert why.endswith("by other events: NORMAL>MIXED>NORMAL becomes NORMAL>MIXED>BATTERY>RETURN>NORMAL")
    assert hasty["sides"]["high"]["unseen"] == {}


def test_what_is_at_stake_decides_what_is_searched_again(
    rows: dict[str, dict[str, Any]], about: dict[str, Any]
) -> None:
    hasty = rows["sup.T_dip"]
    assert hasty["stake_mw"] == pytest.approx(about["total_mw"])
    assert hasty["sides"]["low"]["rerun_mw"] == 0.0
    assert hasty["sides"]["high"]["rerun_mw"] == pytest.approx(about["rerun_mw"], abs=0.01)
    again = [path for path, row in rows.items() if row["sides"]["high"]["rerun_mw"] is not None]
    assert set(again) == {"sup.T_dip", "criteria.loss_share"}
    by_stake = sorted(rows.values(), key=lambda row: row["number"])
    stakes = [row["stake_mw"] for row in by_stake]
    assert stakes == sorted(stakes, reverse=True)


def test_values_that_cannot_be_are_told_and_not_searched(rows: dict[str, dict[str, Any]]) -> None:
    blocked = rows["lim.w_full"]["sides"]["low"]
    assert blocked["refused"] == "no run has a result: gfl: no equilibrium at the first value of the waveform"
    chattering = rows["sup.V_dip"]["sides"]["high"]
    assert "leave no gap between them (V_dip = 0.95, V_back = 0.92)" in chattering["refused"]
    assert blocked["stake_mw"] == chattering["stake_mw"] == 0.0


def test_a_plan_that_the_network_holds_has_no_gradients(study: Study, result: Result) -> None:
    """Asked at the other rating; the runs at the ends of the ranges still tell what fails."""
    asked = study.file.sensitivity.model_copy(update={"beta": 1.15, "reruns": 0})
    file = study.file.model_copy(update={"sensitivity": asked})
    with Store(result.folder / "study.sqlite") as store:
        plan = headline(store, file, "gfl")
    assert plan is not None
    request = {"study": file.model_dump(mode="json"), "folder": str(study.folder), "mode": "gfl"}
    answer = sensitivity.of_plan(request | {"plan": sensitivity._needed(plan)})
    found, told = answer["rows"], answer["plan"]
    assert (told["beta"], told["binding"], told["rerun_mw"]) == (1.15, [], None)
    assert told["limits"]
    assert {row["by_unit"] for row in found} == {None}
    assert {(near["site"], near["target"]) for near in told["near"]} == {(21, "loss")}
    ends = [end for row in found for end in row["sides"].values()]
    assert {end["linear_mw"] for end in ends} == {None}
    assert found[0]["path"] == "sup.T_dip"
    # The network lets no relaxed margin be used; a margin that is near and falls short takes something away.
    assert max(end["gradient_mw"] for end in ends) == pytest.approx(0.0, abs=1e-3)


def test_nothing_is_done_twice_and_all_of_it_when_the_question_changes(
    study: Study, result: Result, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    setting = study.setting()
    asked: list[str] = []

    def answer(request: Any) -> dict[str, Any]:
        asked.append(request["mode"])
        plan = {"beta": request["plan"]["beta"]}
        return {"mode": request["mode"], "rows": [], "plan": plan, "grid": 0, "facility": 0}

    monkeypatch.setattr(sensitivity, "of_plan", answer)
    copy = tmp_path / "study.sqlite"
    copy.write_bytes((result.folder / "study.sqlite").read_bytes())
    with Store(copy, write=True) as store:
        before = str(records(store.sensitivities()))
        assert run_sensitivity(Campaign(store, InProcess()), setting, Silent()) == []
        assert asked == []
        assert str(records(store.sensitivities())) == before
        other = study.file.sensitivity.model_copy(update={"beta": 1.15})
        varied = study.setting(study.file.model_copy(update={"sensitivity": other}))
        run_sensitivity(Campaign(store, InProcess()), varied, Silent())
        assert asked == ["gfl"]
        assert store.provenance()["sensitivity_plans"] == {"gfl": {"beta": 1.15}}


def test_an_interrupted_phase_leaves_the_rows_before_it(
    study: Study, result: Result, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(sensitivity, "of_plan", interrupted)
    copy = tmp_path / "study.sqlite"
    copy.write_bytes((result.folder / "study.sqlite").read_bytes())
    other = study.file.sensitivity.model_copy(update={"change": 0.1})
    setting = study.setting(study.file.model_copy(update={"sensitivity": other}))
    with Store(copy, write=True) as store:
        before = str(records(store.sensitivities()))
        with pytest.raises(KeyboardInterrupt):
            run_sensitivity(Campaign(store, InProcess()), setting, Silent())
        assert str(records(store.sensitivities())) == before


def test_a_mode_without_an_answer_is_told_and_asked_again(
    study: Study, result: Result, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(request: Any) -> dict[str, Any]:
        raise ValueError("no luck")

    copy = tmp_path / "study.sqlite"
    copy.write_bytes((result.folder / "study.sqlite").read_bytes())
    other = study.file.sensitivity.model_copy(update={"change": 0.1})
    setting = study.setting(study.file.model_copy(update={"sensitivity": other}))
    monkeypatch.setattr(sensitivity, "of_plan", broken)
    with Store(copy, write=True) as store:
        for _ in range(2):
            lost = run_sensitivity(Campaign(store, InProcess()), setting, Silent())
            assert lost == ["sensitivities of gfl: failed: ValueError: no luck"]
        assert records(store.sensitivities()) == []


def test_in_closed_loop_there_are_none(study: Study, result: Result, tmp_path: Path) -> None:
    """There the voltages depend on what would be varied."""
    copy = tmp_path / "study.sqlite"
    copy.write_bytes((result.folder / "study.sqlite").read_bytes())
    grid = study.file.grid.model_copy(update={"coupling": "closed"})
    setting = study.setting(study.file.model_copy(update={"grid": grid}))
    with Store(copy, write=True) as store:
        assert run_sensitivity(Campaign(store, InProcess()), setting, Silent()) == []
        assert records(store.sensitivities()) == []
        assert store.provenance()["sensitivity_plans"] == {}


# -- which plan ----------------------------------------------------------------------------------------------


def plan(beta: float, total: float, price: float = 0.0, **more: Any) -> dict[str, Any]:
    margins = [{"price": price}] if price else []
    return {
        "method": "frontier",
        "mode": "gfl",
        "beta": beta,
        "hosting": f"p{beta:g}",
        "total_mw": total,
        "by_site": {"21": total},
        "binding": [],
        "closed": {},
        "passed": 1,
        "search": {"margins": margins},
    } | more


@pytest.mark.parametrize(
    ("plans", "named", "chosen"),
    [
        ([plan(1.1, 50.0, 9.0), plan(1.2, 60.0, 9.0), plan(1.3, 90.0)], None, 1.2),
        ([plan(1.1, 50.0, 9.0), plan(1.2, 60.0, 9.0, passed=0), plan(1.3, 90.0)], None, 1.1),
        ([plan(1.1, 50.0), plan(1.2, 90.0), plan(1.3, 90.01)], None, 1.2),
        ([plan(1.1, 50.0, 9.0), plan(1.2, 60.0)], 1.2, 1.2),
        ([plan(1.1, 50.0, 9.0), plan(1.2, 0.0)], 1.2, None),
        ([plan(1.1, 50.0, 9.0, method="paper")], None, None),
    ],
)
def test_which_plan_is_looked_at(
    tmp_path: Path, plans: list[dict[str, Any]], named: float | None, chosen: float | None
) -> None:
    file = load(TINY, "x")
    asked = SimpleNamespace(sensitivity=file.sensitivity.model_copy(update={"beta": named}))
    with Store(tmp_path / "study.sqlite", write=True) as store:
        store.put("plans", plans)
        found = headline(store, asked, "gfl")  # type: ignore[arg-type]
    assert (None if found is None else found["beta"]) == chosen
