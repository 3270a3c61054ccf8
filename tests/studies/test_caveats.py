"""What the report says of its own limits is counted on the rows, and silent where a store does not say."""

from __future__ import annotations

import re
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from dcvrt.planning.reactive import Beyond, ReactiveExcess
from dcvrt.studies import outputs, simulations
from dcvrt.studies.findings import Findings
from dcvrt.studies.plans import power_flow
from dcvrt.studies.report import answer, caveats, hypotheses, plans
from dcvrt.studies.store import Store, records
from tests.studies.synthetic import CORNER, PERIODS, SITES, make, study_file

HOSTED = ReactiveExcess(Beyond(3, 17, 12.5, 77, 19), Beyond(2, 18, 11.5, 34, 20))
UNHOSTED = ReactiveExcess(Beyond(), Beyond(4, 18, 10.2, 34, 20))


@pytest.fixture(scope="module", autouse=True)
def no_pictures(request: pytest.FixtureRequest) -> Any:
    """The figures are tested elsewhere; here only the words count."""
    patch = pytest.MonkeyPatch()
    patch.setattr(plans, "figure", lambda *_, **__: "")
    yield
    patch.undo()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return make(tmp_path)


def change(folder: Path, **values: Any) -> Findings:
    """The study with other values in every plan; a function gets the plan."""
    with Store(folder / "study.sqlite", write=True) as store:
        for plan in records(store.plans()):
            new = {name: value(plan) if callable(value) else value for name, value in values.items()}
            store.put("plans", [plan | new])
        outputs.write_results(folder, store)
    return Findings(folder)


def words(text: str) -> str:
    return re.sub(r"\s+", " ", re.sub("<[^>]+>", " ", text))


# -- reactive limits -----------------------------------------------------------------------------------------


def test_units_beyond_reactive_limits_are_in_the_answer_and_in_the_checks(folder: Path) -> None:
    both = {"plan": asdict(HOSTED), "unhosted": asdict(UNHOSTED)}
    findings = change(folder, worst=lambda plan: plan["worst"] | {"reactive": both})
    text = words(answer.answer(findings))
    best = findings.best()
    assert best is not None
    assert "Units beyond their reactive limits" in text
    assert (
        f"Units beyond their limits at the largest plan ({caveats.name_of(best)}), in the worst hours: 3 "
        "above q_max (hour 17), by up to 12.5 Mvar (bus 77, hour 19); 2 below q_min (hour 18), by up to 11.5 "
        "Mvar (bus 34, hour 20)."
    ) in text
    assert (
        "The same with nothing hosted: none above q_max; 4 below q_min (hour 18), by up to 10.2 Mvar (bus "
        "34, hour 20). The difference is due to the hosted load."
    ) in text
    checks = plans.plans(findings)
    checks = checks[checks.index("<caption>Checks of each plan") :]
    assert checks.count(">12.5</td>") == checks.count(">11.5</td>") == len(findings.rows()) + 1


def test_nothing_is_said_where_no_unit_is_beyond_or_the_store_does_not_say(folder: Path) -> None:
    assert caveats.reactive_limits(Findings(folder)) == []
    nowhere = asdict(ReactiveExcess())
    findings = change(folder, worst={"reactive": {"plan": nowhere, "unhosted": nowhere}})
    assert caveats.reactive_limits(findings) == []
    assert "reactive limits" not in answer.answer(findings)


def test_power_flow_writes_the_excess_and_the_replay_keeps_it(folder: Path) -> None:
    verdict = SimpleNamespace(
        passed=True,
        v_min_pu=0.95,
        v_error_pu=1e-9,
        status="All hours solve.",
        reactive=HOSTED,
        reactive_unhosted=UNHOSTED,
    )
    row = power_flow(SimpleNamespace(check_ac=lambda plan: verdict), None)  # type: ignore[arg-type]
    change(folder, **row, replayed=0)
    setting = SimpleNamespace(
        file=study_file("again"), sites=SITES, periods=PERIODS, runs=[], request=lambda *_, **__: {}
    )
    with Store(folder / "study.sqlite", write=True) as store:
        campaign = SimpleNamespace(store=store, run=lambda *_: [])
        simulations.run_replays(campaign, setting)  # type: ignore[arg-type]
    for plan in records(Findings(folder).plans):
        assert caveats.reactive_excess(plan) == HOSTED
        assert caveats.reactive_excess(plan, "unhosted") == UNHOSTED
        if plan["method"] != "none" and plan["total_mw"] > 0:
            assert {"voltage", "loss", "aggregate", "reactive"} == set(plan["worst"])


# -- the sampled box -----------------------------------------------------------------------------------------


def at_the_edge(plan: dict[str, Any]) -> list[dict[str, Any]]:
    entry = {
        "kind": "bound",
        "label": "sampled box at site 75",
        "price": 0.7,
        "unit": "MW/MW",
        "limit": 153.9,
    }
    return plan["binding"] + ([entry | {"hour": None, "bus": 75}] if plan["by_site"]["75"] > 0 else [])


def test_a_plan_at_the_edge_of_the_sampled_region_is_a_lower_bound(folder: Path) -> None:
    findings = change(folder, binding=at_the_edge)
    told = caveats.lower_bounds(findings)
    capped = [
        row
        for row in findings.rows()
        if row["by_site"]["75"] > 0 and row["total_mw"] < findings.no_vrt_mw - findings.tolerance_mw
    ]
    full = [row for row in findings.rows() if row["total_mw"] >= findings.no_vrt_mw - findings.tolerance_mw]
    assert capped
    assert full
    assert len(told) == len({(row["mode"], row["method"]) for row in capped})
    for mode, method in {(row["mode"], row["method"]) for row in capped}:
        ratings = ", ".join(
            f"{r['beta']:g}" for r in findings.rows(mode, method) if any(r is other for other in capped)
        )
        assert (
            f"{mode.upper()}, method {method}, β = {ratings}: bus 75 stands at {CORNER[1]:.1f} MW, the edge "
            "of the sampled region."
        ) in told
    for text in (words(answer.answer(findings)), words(plans.plans(findings))):
        assert "Where its edge binds, the capacity is a lower bound" in text
        assert told[0] in text


def test_without_a_capped_plan_nothing_is_a_lower_bound(folder: Path) -> None:
    findings = Findings(folder)
    assert caveats.lower_bounds(findings) == []
    assert "lower bound" not in answer.answer(findings) + plans.plans(findings)


# -- capacity over the rating --------------------------------------------------------------------------------


def test_capacity_never_falls_says_how_much_of_it_is_construction(folder: Path) -> None:
    findings = Findings(folder)
    assert not findings.falls()
    assert hypotheses._never_falls(findings) == (
        hypotheses.HOLDS,
        "In every mode and with every method (0 of 16 plans were carried over from a smaller rating; the "
        "paper fit cannot fall by construction).",
    )
    findings = change(
        folder, carried_from=lambda p: 1.0 if p["method"] == "share" and p["beta"] > 1.2 else None
    )
    line = (
        "Capacity never falls as β rises (4 of 16 plans were carried over from a smaller rating; the paper "
        "fit cannot fall by construction)."
    )
    assert line in words(answer.answer(findings))


# -- the converter before the fault --------------------------------------------------------------------------


def preload(folder: Path, loading: Any) -> Findings:
    with Store(folder / "study.sqlite", write=True) as store:
        for row in records(store.margins("plan")):
            store.put("margins", [row | {"diagnostics": {"preload": loading(row)}}])
    return Findings(folder)


def test_a_limiter_that_is_active_before_the_fault_is_told_with_its_plans(folder: Path) -> None:
    findings = preload(
        folder, lambda r: 0.9998 if (r["beta"], r["site"], r["period"]) == (1.35, 75, "peak") else 0.9
    )
    told = caveats.limited_before_fault(findings)
    hosting = [row for row in findings.rows() if row["total_mw"] > 0]
    limited = [row for row in hosting if row["beta"] == 1.35 and row["by_site"]["75"] > 0]
    assert limited
    assert told == [
        f"In {len(limited)} of {len(hosting)} plans the current limiter of a converter is already active "
        "before the fault. Such a facility draws less reactive power than the grid model assumes.",
        *[f"{caveats.name_of(row)}: at bus 75, period peak" for row in limited],
    ]
    text = words(plans.plans(findings))
    assert all(sentence in text for sentence in told)


def test_no_limiter_active_before_the_fault_is_said_with_the_largest_loading(folder: Path) -> None:
    findings = preload(folder, lambda r: 0.8 + 1e-3 * (r["site"] == 75) + 1e-4 * (r["beta"] == 1.5))
    (told,) = caveats.limited_before_fault(findings)
    assert told.startswith("In no plan is the current limiter of a converter active before the fault.")
    assert "0.801 of the current limit, at bus 75 (" in told
    assert "β = 1.5" in told


def test_a_store_without_the_loading_says_so(folder: Path) -> None:
    assert caveats.limited_before_fault(Findings(folder)) == [
        "The store does not say how the converters of the plans are loaded before the fault."
    ]


# -- numbers -------------------------------------------------------------------------------------------------


def test_the_error_of_the_linear_screen_shows_its_size(folder: Path) -> None:
    text = plans.plans(change(folder, ac_v_error_pu=2.58e-9))
    assert text.count(">2.6e-09</td>") == len(Findings(folder).rows()) + 1


def test_limits_are_named_by_their_price(folder: Path) -> None:
    findings = Findings(folder)
    assert "Highest-priced limits: line 80-99 in hour 17 (0.52 MW/MVA)." in " ".join(
        findings.limits_of(row) for row in findings.rows()
    )
