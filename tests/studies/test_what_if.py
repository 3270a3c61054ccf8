"""The last phase of a study: least ratings on the kept waveforms, found once; anew when asked otherwise."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from dcvrt.studies import what_if
from dcvrt.studies.config import StudyFile, load
from dcvrt.studies.progress import Silent
from dcvrt.studies.store import Store

STUDY = """
[study]
name = "two sites"
[grid]
case = "ieee118"
sites = [21, 75]
[hosting]
pf = 1.0
[[fault]]
bus = 25
[[period]]
name = "peak"
hour = "peak"
"""
SHARES = """
[[what_if]]
loss_share = 0.20
[[what_if]]
label = "half as fast"
modes = ["gfl"]
parameters = { "lag.tau" = 0.008 }
[[what_if]]
label = "no patience"
parameters = { "sup.T_dip" = 0.05 }
"""
RETAINED = {21: 0.62, 75: 0.30}
"""Voltage that the fault leaves; nothing is hosted at the second site."""


def setting(text: str) -> Any:
    file: StudyFile = load(text, "x")
    return SimpleNamespace(file=file, d={"peak": 1.0}, no_vrt=SimpleNamespace(total_mw=60.0))


def plan(beta: float, total: float, **more: Any) -> dict[str, Any]:
    return {
        "method": "share",
        "mode": "gfl",
        "beta": beta,
        "hosting": f"p{total:g}",
        "total_mw": total,
        "by_site": {"21": total, "75": 0.0},
        "binding": [],
        "closed": {},
        "ac_passed": 1,
        "replayed": 1,
        "passed": 1,
    } | more


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    """A store with replayed plans and the voltages of the largest that passed."""
    t = np.array([0.0, 0.1, 0.1, 0.2, 0.2, 0.6])
    with Store(tmp_path / "study.sqlite", write=True) as store:
        store.put(
            "plans",
            [
                plan(1.2, 20.0),
                plan(1.3, 50.0),
                plan(1.4, 50.01),
                plan(1.5, 60.0, passed=0),
                plan(1.6, 60.0, ac_passed=0),
                plan(1.5, 60.0, mode="gfm", passed=0),
            ],
        )
        for bus, least in RETAINED.items():
            v = np.array([1.0, 1.0, least, least, 1.0, 1.0])
            store.put_waveform(
                {"t_s": t, "v_re_pu": v, "v_im_pu": 0 * v},
                hosting="p50",
                period="peak",
                fault="bus 25, 100 ms",
                site=bus,
            )
        yield store


def rows(store: Store) -> list[dict[str, Any]]:
    return [{str(k): v for k, v in row.items()} for row in store.what_ifs().to_dict("records")]


def test_the_largest_plan_that_passed_everything_at_the_least_rating_is_asked(store: Store) -> None:
    """50 and 50.01 MW count as equal; a mode without a plan that passed is left out."""
    chosen = what_if.largest_passed(store, setting(STUDY))
    assert {mode: (p["beta"], p["total_mw"]) for mode, p in chosen.items()} == {"gfl": (1.3, 50.0)}


def test_ratings_follow_the_static_law_at_open_sites(store: Store) -> None:
    what_if.run_what_ifs(store, setting(STUDY + SHARES), Silent())
    base, share, slow, hasty = rows(store)
    assert [r["label"] for r in (base, share, slow, hasty)] == [
        "as studied",
        "criteria.loss_share = 0.2",
        "half as fast",
        "no patience",
    ]
    assert base["rating"] == pytest.approx(0.75 / RETAINED[21], rel=3e-3)
    assert share["rating"] == pytest.approx(0.80 / RETAINED[21], rel=3e-3)
    assert np.isnan(hasty["rating"])  # on battery during the dip: the whole import is lost at any rating
    assert base["n_waveforms"] == 1
    assert (base["low"], base["high"], base["beta"], base["total_mw"]) == (1.0, 2.0, 1.3, 50.0)
    assert slow["changes"] == [{"name": "lag.tau", "unit": "s", "studied": 0.004, "varied": 0.008}]


def test_nothing_is_done_twice_and_all_of_it_when_the_question_changes(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    what_if.run_what_ifs(store, setting(STUDY + SHARES), Silent())
    before, runs = rows(store), []
    monkeypatch.setattr(what_if, "least_rating", lambda *given: runs.append(given) or 1.5)
    what_if.run_what_ifs(store, setting(STUDY + SHARES), Silent())
    assert runs == []
    assert str(rows(store)) == str(before)

    what_if.run_what_ifs(store, setting(STUDY + SHARES.replace("0.008", "0.006")), Silent())
    assert len(runs) == 4
    assert [row["rating"] for row in rows(store)] == [1.5] * 4

    store.put("plans", [plan(1.25, 50.0)])  # the same vector, found to pass at a smaller rating
    what_if.run_what_ifs(store, setting(STUDY + SHARES.replace("0.008", "0.006")), Silent())
    assert {row["beta"] for row in rows(store)} == {1.25}

    what_if.run_what_ifs(store, setting(STUDY), Silent())
    assert rows(store) == []


def test_an_interrupted_phase_leaves_the_rows_before_it(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    what_if.run_what_ifs(store, setting(STUDY + SHARES), Silent())
    before = str(rows(store))

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(what_if, "least_rating", interrupted)
    with pytest.raises(KeyboardInterrupt):
        what_if.run_what_ifs(store, setting(STUDY + SHARES.replace("0.20", "0.15")), Silent())
    assert str(rows(store)) == before


def test_no_plan_that_passed_means_no_rows(store: Store) -> None:
    store.put("plans", [p | {"passed": 0} for p in store.plans().to_dict("records")])
    what_if.run_what_ifs(store, setting(STUDY + SHARES), Silent())
    assert rows(store) == []
