"""Plans with their facilities in the network: how far the margins of the open loop are off.

The open loop takes hosted load as an impedance in the fault. This phase simulates plans in both loops by the
native engine: the largest plan of each mode that passed, or every plan where the study asks for the closed
loop. Then samples and searches are in closed loop, and a plan that does not ride through there has not
passed. Studies whose faults ANDES simulates are left alone: their case may be one that the native engine does
not know.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from dcvrt.planning import coupling
from dcvrt.studies.campaign import Campaign, Task
from dcvrt.studies.findings import SAME_SHARE
from dcvrt.studies.setting import NO_VRT, Setting
from dcvrt.studies.store import Store, records

PHASE = "coupling"
Run = tuple[str, str, float]
"""Hosting vector, mode and rating of a plan."""


def run_coupling(campaign: Campaign, setting: Setting) -> list[str]:
    """Simulate plans in closed loop; messages of what was set aside."""
    store, grid = campaign.store, setting.file.grid
    if grid.engine == "andes":
        return []
    closed = grid.coupling == "closed"
    plans = [plan for plan in records(store.plans()) if plan["method"] != NO_VRT and plan["total_mw"] > 0]
    chosen = plans if closed else list(largest_passed(store, setting).values())
    by_hosting: dict[str, tuple[list[float], set[tuple[str, float]]]] = {}
    for plan in chosen:
        H = [plan["by_site"][str(bus)] for bus in setting.sites]
        by_hosting.setdefault(plan["hosting"], (H, set()))[1].add((plan["mode"], plan["beta"]))
    names: dict[str, str] = {}
    tasks = []
    for name, (H, runs) in by_hosting.items():
        for period in setting.periods:
            for run in sorted(runs):
                task = Task(PHASE, setting.request(H, period, [run], engine="native"))
                names[task.key] = name
                tasks.append(task)

    def record(task: Task, rows: Sequence[Mapping[str, Any]]) -> None:
        store.put("coupling", [{"hosting": names[task.key], **row} for row in rows])

    def record_lost(task: Task, reason: str) -> None:
        record(task, coupling.lost_rows(task.payload, reason))

    lost = campaign.run(PHASE, tasks, coupling.compare_plan, record, record_lost)
    if closed:
        _refuse(store, plans)
    return lost


def largest_passed(store: Store, setting: Setting) -> dict[str, dict[str, Any]]:
    """The plan of each mode with the largest total that passed replay and power flow; of equal ones, that of
    the smallest rating. Modes without such a plan are left out."""
    same = SAME_SHARE * max(setting.no_vrt.total_mw, 1.0)
    plans = [
        plan
        for plan in records(store.plans())
        if plan["method"] != NO_VRT
        and plan["passed"] == 1
        and plan["ac_passed"] == 1
        and plan["total_mw"] > 0
    ]
    largest = {}
    for mode in setting.file.facility.modes:
        here = [plan for plan in plans if plan["mode"] == mode]
        if here:
            most = max(plan["total_mw"] for plan in here)
            largest[mode] = min(
                (plan for plan in here if plan["total_mw"] >= most - same), key=lambda plan: plan["beta"]
            )
    return largest


def _refuse(store: Store, plans: list[dict[str, Any]]) -> None:
    """Plans that do not ride through in closed loop have not passed."""
    rides = rides_through(store)
    with store.transaction():
        for plan in plans:
            if plan["passed"] and not rides[plan["hosting"], plan["mode"], plan["beta"]]:
                store.put("plans", [plan | {"passed": 0}])


def rides_through(store: Store) -> dict[Run, bool]:
    """Whether the plans that were simulated in closed loop ride through there, every fault at every site."""
    rides: dict[Run, bool] = {}
    for row in records(store.coupling()):
        run = (row["hosting"], row["mode"], row["beta"])
        rides[run] = rides.get(run, True) and row["passed_closed"] == 1
    return rides
