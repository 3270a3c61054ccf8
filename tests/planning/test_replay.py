"""The verdict on a plan: what counts, what does not, and that nothing missing ever counts as a pass."""

from __future__ import annotations

import math

import pytest

from dcvrt.planning.replay import facility_rows, fault_label, fault_of, lost_rows, modes_passed
from dcvrt.planning.verdict import verdict

REQUEST = {
    "sites": [21, 75],
    "hosting": [30.0, 0.0],
    "period": {"name": "peak"},
    "runs": [["gfl", 1.2]],
    "faults": [
        {"bus": 32, "t_start_s": 0.2, "t_clear_ms": 100.0, "x_pu": 1e-4},
        {"bus": 34, "t_start_s": 0.2, "t_clear_ms": 83.3, "x_pu": 1e-4},
    ],
    "gradients": False,
}
H = {21: 30.0, 75: 0.0}


def row(
    site: int, fault: str, v: float, loss_margin: float, loss: float = 1.0, period: str = "peak", ok: int = 1
) -> dict:
    return {
        "site": site,
        "fault": fault,
        "period": period,
        "v_margin_pu": v,
        "loss_margin_mw": loss_margin,
        "loss_mw": loss,
        "ok": ok,
        "sequence": "NORMAL",
    }


def test_the_worst_run_decides() -> None:
    rows = [
        row(21, "a", 0.02, 3.0, loss=2.0),
        row(21, "b", 0.01, 5.0),
        row(21, "a", 0.03, -0.5, loss=4.0, period="light"),
    ]
    found = verdict(rows, H, expected=3)
    assert not found["passed"]
    assert found["n_failed"] == 0
    assert (found["worst_voltage_margin_pu"], found["worst_loss_margin_mw"]) == (0.01, -0.5)
    assert found["worst"]["voltage"] == {"site": 21, "fault": "b", "period": "peak", "sequence": "NORMAL"}
    assert found["worst"]["aggregate"] == {"period": "light", "fault": "a"}
    assert verdict(rows[:2], H, expected=2)["passed"]


def test_aggregate_loss_adds_the_sites_of_one_fault() -> None:
    both = {21: 30.0, 75: 50.0}
    rows = [
        row(21, "a", 0.1, 1.0, loss=2.0),
        row(75, "a", 0.1, 1.0, loss=3.0),
        row(21, "b", 0.1, 1.0, loss=4.0),
        row(75, "b", 0.1, 1.0, loss=0.5),
    ]
    found = verdict(rows, both, expected=4)
    assert found["aggregate_loss_mw"] == 5.0
    assert found["worst"]["aggregate"]["fault"] == "a"


def test_a_site_without_capacity_cannot_fail() -> None:
    rows = [row(21, "a", 0.1, 1.0), row(75, "a", -9.0, -9.0)]
    assert verdict(rows, H, expected=1)["passed"]


def test_a_failed_or_missing_run_fails_the_plan() -> None:
    good = row(21, "a", 0.1, 1.0)
    for rows in ([good, row(21, "b", math.nan, math.nan, ok=0)], [good], []):
        found = verdict(rows, H, expected=2)
        assert not found["passed"]
        assert found["n_failed"] == 2 - sum(r["ok"] for r in rows)


def test_a_plan_of_nothing_passes_with_nothing_to_show() -> None:
    found = verdict([], {21: 0.0, 75: 0.0}, expected=0)
    assert found == {
        "passed": True,
        "worst_voltage_margin_pu": None,
        "worst_loss_margin_mw": None,
        "aggregate_loss_mw": 0.0,
        "worst": {},
        "n_failed": 0,
    }


def test_lost_runs_are_rows_that_are_not_ok() -> None:
    rows = lost_rows(REQUEST, "took longer than 5 s", "task")
    assert len(rows) == 4
    assert {r["ok"] for r in rows} == {0}
    assert {(r["fault"], r["site"], r["status"], r["failed_in"]) for r in rows} == {
        (fault, site, "took longer than 5 s", "task")
        for fault in ("bus 32, 100 ms", "bus 34, 83.3 ms")
        for site in (21, 75)
    }
    assert all(math.isnan(r["v_margin_pu"]) and math.isnan(r["loss_margin_mw"]) for r in rows)


def test_faults_of_a_request_are_those_of_the_grid() -> None:
    from dcvrt.grid import BusFault

    entry = {"bus": 32, "t_start_s": 0.2, "t_clear_ms": 83.3, "x_pu": 1e-3}
    fault = fault_of(entry | {"opens": [32, 113]})
    assert (fault.bus, fault.start, fault.x_f, fault.opens) == (32, 0.2, 1e-3, (32, 113))
    assert fault.clear == pytest.approx(0.0833)
    assert fault_label(entry) == BusFault(32, clear=0.0833).label == "bus 32, 83.3 ms"


def test_modes_are_read_from_a_real_run() -> None:
    from dcvrt import Criteria, Simulator, Waveform, facility, margins

    sag = Waveform.sag(retained=0.6, start=0.1, length=0.1, until=0.5)
    run = Simulator(facility.gfl().compile(), save_at=2e-3)(sag, H=1.0, beta=1.3)
    assert modes_passed(margins(run, Criteria()).sequence) == [
        "NORMAL",
        *[event.target for event in run.events],
    ]
    assert run.events


def test_rows_keep_the_loading_before_the_fault() -> None:
    from dcvrt import Waveform

    sag = Waveform.sag(retained=0.8, start=0.1, length=0.1, until=0.4)
    request = {"parameters": {}, "pf": 0.98, "criteria": {}, "gradients": False}
    request |= {"sites": [21], "hosting": [30.0], "period": {"name": "peak", "dc_factor": 1.0}}
    ratings = [1.01, 1.2]
    waveforms = {"bus 32, 100 ms": {21: sag}}
    rows = facility_rows(request, "gfl", ratings, waveforms)
    preload = [r["diagnostics"]["preload"] for r in rows]
    assert preload[0] == pytest.approx(1.0, abs=1e-3)  # 1/0.98 would be needed
    assert preload[1] == pytest.approx(1 / (0.98 * 1.2), rel=1e-4)
