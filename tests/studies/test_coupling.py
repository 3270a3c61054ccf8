"""Plans in closed loop: which are simulated, what that makes of their verdict, what the report says."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from dcvrt.planning import coupling as planning
from dcvrt.planning import replay
from dcvrt.studies import coupling, outputs
from dcvrt.studies.campaign import Campaign, InProcess
from dcvrt.studies.config import load
from dcvrt.studies.findings import Findings
from dcvrt.studies.report import coupling as report
from dcvrt.studies.report.answer import in_closed_loop
from dcvrt.studies.simulations import hosting_row
from dcvrt.studies.store import Store, records
from tests.studies.synthetic import make

STUDY = """
[study]
name = "two sites"
[grid]
case = "ieee118"
sites = [21, 75]
coupling = "COUPLING"
engine = "ENGINE"
[facility]
modes = ["gfl"]
[[fault]]
bus = 25
[[period]]
name = "peak"
hour = "peak"
"""
CLOSED = {1.2: True, 1.3: False, 1.4: True}
"""Whether the plan of a rating rides through in closed loop."""


def setting(coupled: str, engine: str = "native") -> Any:
    file = load(STUDY.replace("COUPLING", coupled).replace("ENGINE", engine), "x")

    def request(H: list[float], period: str, runs: list[tuple[str, float]], *, engine: str) -> dict[str, Any]:
        faults = [fault.model_dump() for fault in file.fault]
        return {"sites": [21, 75], "hosting": H, "period": {"name": period}, "runs": runs, "faults": faults}

    no_vrt = SimpleNamespace(total_mw=60.0)
    return SimpleNamespace(file=file, sites=(21, 75), periods={"peak": {}}, no_vrt=no_vrt, request=request)


def plan(beta: float, total: float, **more: Any) -> dict[str, Any]:
    return {
        "method": "share", "mode": "gfl", "beta": beta, "hosting": f"p{total:g}", "total_mw": total,
        "by_site": {"21": total, "75": 0.0}, "binding": [], "closed": {}, "ac_passed": 1, "replayed": 1,
        "passed": 1,
    } | more  # fmt: skip


def answer(request: dict[str, Any]) -> list[dict[str, Any]]:
    """Rows of one site; a loss margin that falls with the loop closed."""
    ((mode, beta),) = request["runs"]
    rides = CLOSED[beta]
    return [
        {"period": "peak", "mode": mode, "beta": beta, "fault": "bus 25, 100 ms", "site": 21, "status": "",
         "v_poi_min_open": 0.62, "v_poi_min_closed": 0.61, "voltage_open": 0.08, "voltage_closed": 0.079,
         "loss_open": 0.02, "loss_closed": 0.01 if rides else -0.005, "passed_open": True,
         "passed_closed": rides, "same_sequence": True},
    ]  # fmt: skip


def run(folder: Path, given: Any) -> tuple[list[str], dict[float, int], list[dict[str, Any]]]:
    """Messages, verdicts by rating and compared runs, after two passes over the same store."""
    with Store(folder / "study.sqlite", write=True) as store:
        store.put("plans", [plan(1.2, 40.0), plan(1.3, 60.0), plan(1.4, 60.0), plan(1.5, 0.0)])
        campaign = Campaign(store, InProcess())
        lost = coupling.run_coupling(campaign, given)
        store.put("plans", [plan(1.3, 60.0)])  # the replay's verdict, which a resumed study writes again
        lost += coupling.run_coupling(campaign, given)
        verdicts = {p["beta"]: p["passed"] for p in records(store.plans())}
        return lost, verdicts, records(store.coupling())


def test_every_plan_is_compared_and_keeps_its_verdict(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[Any] = []
    monkeypatch.setattr(planning, "compare_plan", lambda r: asked.append(r["runs"]) or answer(r))
    lost, verdicts, rows = run(tmp_path, setting("open"))
    assert (lost, sorted(asked)) == ([], [[("gfl", 1.2)], [("gfl", 1.3)], [("gfl", 1.4)]])  # once each
    assert sorted(row["beta"] for row in rows) == [1.2, 1.3, 1.4]
    assert set(verdicts.values()) == {1}


def test_in_closed_loop_every_plan_is_held_against_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(planning, "compare_plan", answer)
    lost, verdicts, rows = run(tmp_path, setting("closed"))
    assert lost == []
    assert verdicts == {1.2: 1, 1.3: 0, 1.4: 1, 1.5: 1}  # a plan of nothing has nothing to ride through
    assert sorted(row["beta"] for row in rows) == [1.2, 1.3, 1.4]


def test_a_comparison_that_fails_is_no_pass(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(request: dict[str, Any]) -> None:
        raise ValueError("no such grid")

    monkeypatch.setattr(planning, "compare_plan", refuse)
    lost, verdicts, rows = run(tmp_path, setting("closed"))
    assert len(lost) >= 3
    assert verdicts == {1.2: 0, 1.3: 0, 1.4: 0, 1.5: 1}
    assert {(row["site"], row["fault"]) for row in rows} == {(21, "bus 25, 100 ms")}
    assert all("no such grid" in row["status"] for row in rows)


def test_studies_by_andes_are_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(planning, "compare_plan", lambda r: pytest.fail("compared"))
    assert run(tmp_path, setting("open", "andes")) == ([], {1.2: 1, 1.3: 1, 1.4: 1, 1.5: 1}, [])


def words(page: str) -> str:
    return re.sub(r"\s+", " ", re.sub(r"<[^>]*>", " ", page))


def test_the_report_tells_how_far_the_open_loop_is_off(tmp_path: Path) -> None:
    folder = make(tmp_path / "study")
    none = words(report.coupling(Findings(folder)))
    assert "were not compared: the store holds no comparison." in none
    best = Findings(folder).best("gfm")
    assert best is not None
    with Store(folder / "study.sqlite", write=True) as store:
        (found,) = [
            p for p in records(store.plans()) if all(p[k] == best[k] for k in ("method", "mode", "beta"))
        ]
        row = answer({"runs": [("gfm", 1.2)]})[0] | {"hosting": found["hosting"], "beta": best["beta"]}
        worse = row | {"site": 75, "loss_closed": -0.03, "passed_closed": False, "same_sequence": False}
        store.put("coupling", [row, worse])
    findings = Findings(folder)
    told = words(report.coupling(findings))
    assert "-0.0100 -0.0010 -0.0500 2 1 0 passed FAILED" in told  # voltage, margins, runs, sequence, verdicts
    assert "bus 25, 100 ms peak 75 0.6200 0.6100 0.0800 0.0790 0.0200 -0.0300 no" in told
    assert "with GFL: none of the plans; with GFM:" in in_closed_loop(findings)
    assert findings.best("gfm") == best
    turned = findings.best("gfm", closed_loop=True)
    assert turned is None  # the one plan that was simulated there fails
    (sentence,) = report.turned(findings)
    assert "1 of 2 runs, the first at bus 75, fault bus 25, 100 ms, peak: a margin is negative" in sentence


@pytest.mark.parametrize(("coupled", "count"), [("open", 2), ("closed", 3)])
def test_each_mode_and_rating_has_its_own_fault_simulations_in_closed_loop(
    tmp_path: Path, coupled: str, count: int
) -> None:
    """Two ratings of a sample share a simulation in open loop only; replays share theirs in both."""
    with Store(tmp_path / "study.sqlite", write=True) as store:
        store.note(study=setting(coupled).file.canonical())
        for name, role in (("s0000", "sample"), ("p40", "plan")):
            store.put("hostings", [hosting_row(name, role, "", {21: 40.0, 75: 0.0})])
            for beta in (1.2, 1.3):
                place = ("peak", "bus 25, 100 ms", 21, "gfl", beta)
                store.put("margins", [{"hosting": name, **replay._row(*place, 40.0, "", "")}])
        assert outputs.simulations(store)["grid"] == count
        assert outputs.simulations(store)["facility"] == 4
