"""The frontier of a study: what it starts from, what it writes, when it is searched again, what is lost."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dcvrt.planning import replay
from dcvrt.studies import frontier, simulations
from dcvrt.studies import plans as plans_module
from dcvrt.studies.campaign import Campaign, crew_of
from dcvrt.studies.progress import Silent
from dcvrt.studies.setting import Setting
from dcvrt.studies.store import Store, records
from tests.studies.stand_in import WORSE, answers, run, setting, stand_in
from tests.studies.synthetic import CORNER, PERIODS, SITES, checked_run, study_file


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    return stand_in(monkeypatch)


def every_site() -> Setting:
    return setting(loss_mw=[], loss_share=[])


def plans_of(folder: Path) -> list[dict[str, Any]]:
    with Store(folder / "study.sqlite") as store:
        return records(store.plans())


def with_another_plan(folder: Path, study: Setting) -> None:
    """Search, then add a plan of another method, which the search has not replayed."""
    folder.mkdir()
    with Store(folder / "study.sqlite", write=True) as store, crew_of(1) as crew:
        assert frontier.run_frontier(Campaign(store, crew), study, Silent()) == []
        known = next(p for p in records(store.plans()) if p["total_mw"] > 0)
        by_site = {bus: 0.9 * mw for bus, mw in known["by_site"].items()}
        other = {"method": "paper", "by_site": by_site, "total_mw": sum(by_site.values()), "search": {}}
        store.put("plans", [known | other | {"hosting": plans_module.plan_name(by_site), "replayed": 0}])


def verdicts(folder: Path, study: Setting) -> list[tuple[Any, ...]]:
    """Of all plans, after the replays that are missing."""
    with Store(folder / "study.sqlite", write=True) as store, crew_of(1) as crew:
        assert simulations.run_replays(Campaign(store, crew), study) == []
        names = ("method", "mode", "beta", "passed", "n_failed", "aggregate_loss_mw")
        return [tuple(str(plan[name]) for name in names) for plan in records(store.plans())]


def test_replays_that_were_interrupted_between_periods_are_ended_and_no_more(
    tmp_path: Path, asked: list, monkeypatch: pytest.MonkeyPatch
) -> None:
    study = every_site()
    with_another_plan(tmp_path / "whole", study)
    asked.clear()
    whole = verdicts(tmp_path / "whole", study)
    assert [r["period"]["name"] for r in asked] == list(PERIODS)  # of the other plan alone
    with_another_plan(tmp_path / "cut", study)
    answer, made = replay.check_hosting, []

    def once(request: dict[str, Any]) -> dict[str, Any]:
        if made:
            raise KeyboardInterrupt
        made.append(request)
        return answer(request)

    with monkeypatch.context() as cut:
        cut.setattr(replay, "check_hosting", once)
        with pytest.raises(KeyboardInterrupt):
            verdicts(tmp_path / "cut", study)
    asked.clear()
    assert verdicts(tmp_path / "cut", study) == whole
    assert len(asked) == len(PERIODS) - 1


def test_coarse_samples_begin_with_everything_and_next_to_nothing() -> None:
    study = every_site()
    samples = frontier.coarse_samples(study)
    assert samples.shape == (study.file.frontier.samples, len(SITES))
    assert samples[0] == pytest.approx(CORNER)
    assert (samples[1] > 0).all()
    assert samples[1].sum() < 0.02 * sum(CORNER)


def test_every_mode_and_rating_has_the_largest_plan_whose_sites_all_pass(tmp_path: Path, asked: list) -> None:
    """Against the closed form of every run in every period and fault, as the replay has it."""
    study = every_site()
    run(tmp_path, study)
    plans = plans_of(tmp_path)
    assert [(p["mode"], p["beta"]) for p in plans] == sorted(study.runs)
    assert {p["method"] for p in plans} == {"frontier"}
    for plan in plans:
        H = np.array([plan["by_site"][str(bus)] for bus in SITES])
        worst = {
            site: min(
                checked_run(study.file, period, fault, site, plan["mode"], plan["beta"], H)[
                    "loss_margin_share"
                ]
                for period in PERIODS
                for fault in study.file.fault
            )
            - WORSE
            for site in SITES
        }
        for site, mw in zip(SITES, H, strict=True):
            if mw > 0:
                assert worst[site] >= 0.0
            else:  # not even with the others as they are could it be opened
                assert worst[site] < 0.0 or H.sum() == pytest.approx(0.8 * sum(CORNER))
                assert str(site) in plan["closed"]
        assert plan["total_mw"] == pytest.approx(H.sum())
        assert plan["passed"] == 1
        assert plan["search"]["settled"]
        assert plan["search"]["refused"] >= 0


def test_margins_that_bind_are_written_with_their_prices(tmp_path: Path, asked: list) -> None:
    run(tmp_path, every_site())
    items = [item for plan in plans_of(tmp_path) for item in plan["search"]["margins"]]
    for item in items:
        assert set(item) == {"period", "fault", "site", "target", "label", "price", "by_beta"}
        assert item["site"] in SITES
        assert item["period"] in PERIODS
        assert item["price"] > 0


def test_search_and_replay_ask_their_own_engines(tmp_path: Path, asked: list) -> None:
    study = every_site()
    run(tmp_path, study)
    for request in asked:
        searching = request["gradients"]
        assert request["engine"] == (study.file.grid.engine if searching else study.file.replay.engine)
        assert request["keep"] is not searching
    with Store(tmp_path / "study.sqlite") as store:
        roles = set(store.hostings().role)
    assert {"search", "plan"} <= roles <= {"search", "candidate", "plan"}


def test_a_finished_search_is_not_made_again_until_a_task_is_opened(tmp_path: Path, asked: list) -> None:
    run(tmp_path, every_site())
    before = plans_of(tmp_path)
    asked.clear()
    run(tmp_path, every_site())
    assert asked == []
    with Store(tmp_path / "study.sqlite", write=True) as store:
        key = next(t["hash"] for t in records(store.tasks()) if t["phase"] == simulations.FRONTIER)
        store.set_task(key, "open")
    run(tmp_path, every_site())
    assert len(asked) == 1
    assert [(p["mode"], p["beta"], p["by_site"]) for p in plans_of(tmp_path)] == [
        (p["mode"], p["beta"], p["by_site"]) for p in before
    ]


def test_no_search_where_none_is_asked_for(tmp_path: Path, asked: list) -> None:
    study = every_site()
    off = study.file.model_copy(update={"frontier": study.file.frontier.model_copy(update={"search": False})})
    run(tmp_path, Setting(off, study.folder, study.problem, study.periods))
    assert plans_of(tmp_path) == []
    assert asked == []


def test_what_is_set_aside_is_told_and_is_never_a_pass(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, asked: list
) -> None:
    """Every replay of one period dies: nothing passes, and the messages say what was lost."""
    good = answers(study_file("limits"), [])

    def fragile(request: dict[str, Any]) -> dict[str, Any]:
        if not request["gradients"] and request["period"]["name"] == "light":
            raise RuntimeError("the light went out")
        return dict(good(request))

    monkeypatch.setattr(replay, "check_hosting", fragile)
    study = setting(loss_mw=[40.0], loss_share=[])
    with Store(tmp_path / "study.sqlite", write=True) as store, crew_of(1) as crew:
        lost = frontier.run_frontier(Campaign(store, crew), study, Silent())
        plans, limited = records(store.plans()), records(store.system_plans())
    assert lost
    assert all("the light went out" in line for line in lost)
    assert {plan["total_mw"] for plan in [*plans, *limited]} == {0.0}
