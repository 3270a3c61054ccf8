"""Plans with their facilities in the network: how far the margins of the open loop are off.

The open loop takes hosted load as an impedance in the fault. This phase simulates every plan in both loops by
the native engine, those under system limits too. Where the study asks for the closed loop, samples and
searches are in it, and a plan that does not ride through there has not passed. Studies whose faults ANDES
simulates are left alone: their case may be one that the native engine does not know.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from dcvrt.planning import coupling
from dcvrt.studies.campaign import Campaign, Task
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
    plans = [plan for plan in records(store.plans()) if plan["method"] != NO_VRT and plan["total_mw"] > 0]
    limited = [plan for plan in records(store.system_plans()) if plan["total_mw"] > 0]
    by_hosting: dict[str, tuple[list[float], set[tuple[str, float]]]] = {}
    for plan in [*plans, *limited]:
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
    if grid.coupling == "closed":
        _refuse(store, plans)
    return lost


def _refuse(store: Store, plans: list[dict[str, Any]]) -> None:
    """Plans that do not ride through in closed loop have not passed."""
    rides = rides_through(store)
    with store.transaction():
        for plan in plans:
            if plan["passed"] and not rides[plan["hosting"], plan["mode"], plan["beta"]]:
                store.put("plans", [plan | {"passed": 0}])


def rides_through(store: Store) -> dict[Run, bool]:
    """Whether the plans that were simulated in closed loop ride through there, every fault at every site."""
    return rides_of(records(store.coupling()))


def rides_of(rows: Iterable[Mapping[str, Any]]) -> dict[Run, bool]:
    """The same, of rows of the store."""
    rides: dict[Run, bool] = {}
    for row in rows:
        run = (row["hosting"], row["mode"], row["beta"])
        rides[run] = rides.get(run, True) and row["passed_closed"] == 1
    return rides
