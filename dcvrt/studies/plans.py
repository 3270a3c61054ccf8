"""The plans of a study: the hosting programme for every method, mode and rating, each checked by AC power
flow."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from dcvrt.errors import DcvrtError
from dcvrt.planning.hosting import HostingProblem
from dcvrt.planning.plan import Plan
from dcvrt.planning.surrogate import Surrogate
from dcvrt.planning.sweep import sweep
from dcvrt.studies.setting import NO_VRT, REACTIVE, Setting
from dcvrt.studies.simulations import hosting_row
from dcvrt.studies.store import Store


def run_plans(store: Store, setting: Setting, fits: Sequence[Surrogate], progress: Any) -> None:
    """Solve the hosting programme for every method, mode and rating, and check each plan by AC power flow."""
    file = setting.file
    digest = hashlib.sha256(
        json.dumps(
            [
                [
                    fit.method,
                    fit.mode,
                    fit.site,
                    fit.fault,
                    fit.target,
                    fit.period,
                    fit.beta,
                    fit.intercept,
                    *fit.slopes.tolist(),
                    fit.rating_slope,
                    [[*place, why] for place, why in fit.unknown.items()],
                ]
                for fit in fits
            ]
        ).encode()
    ).hexdigest()
    if store.provenance().get("plans_from") == digest:
        return
    upper = setting.samples().upper
    total = len(file.surrogate.methods) * len(file.facility.modes) * len(file.facility.beta)
    rows = [plan_row(setting, NO_VRT, "", 0.0, setting.no_vrt, setting.no_vrt.closed, None)]
    checked: dict[str, dict[str, Any]] = {}
    found = []
    for k, swept in enumerate(
        sweep(setting.problem, fits, file.facility.modes, file.facility.beta, setting.d, upper), 1
    ):
        rows.append(
            plan_row(
                setting, swept.method, swept.mode, swept.beta, swept.plan, swept.closed, swept.carried_from
            )
        )
        found.append(swept.plan)
        progress("plans", k, total, 0)
    for row, plan in zip(rows, [setting.no_vrt, *found], strict=True):
        if row["hosting"] not in checked:
            checked[row["hosting"]] = power_flow(setting.problem, plan)
        row |= checked[row["hosting"]]
    with store.transaction():
        store.put("hostings", [plan_hosting(row) for row in rows])
        store.put("plans", rows)
        store.note(plans_from=digest)


def plan_row(
    setting: Setting,
    method: str,
    mode: str,
    beta: float,
    plan: Plan,
    closed: Mapping[int, str],
    carried_from: float | None,
) -> dict[str, Any]:
    """The row of `plans` of a plan, before its checks."""
    H = {str(bus): round(plan.by_site[bus], 6) + 0.0 for bus in setting.sites}
    # A closed site is told as such, not as one whose largest size is 0; other bounds are those of the sampled
    # box.
    edge = "sampled box" if method in setting.file.surrogate.methods else "trust region of the search"
    binding = [
        asdict(b) | ({"label": f"{edge} at site {b.bus}"} if b.kind == "bound" and method != NO_VRT else {})
        for b in plan.binding
        if not (b.kind == "bound" and b.bus in closed)
    ]
    return {
        "method": method,
        "mode": mode,
        "beta": beta,
        "hosting": plan_name(H),
        "total_mw": sum(H.values()),
        "by_site": H,
        "binding": binding,
        "closed": {str(bus): why for bus, why in closed.items()},
        "carried_from": carried_from,
    }


def plan_name(by_site: Mapping[str, float]) -> str:
    """Name of a hosting vector, the same for the same capacities."""
    return "p" + hashlib.sha256(json.dumps(by_site, sort_keys=True).encode()).hexdigest()[:10]


def power_flow(problem: HostingProblem, plan: Plan) -> dict[str, Any]:
    """Power-flow verdict of a plan; a power flow that cannot be made is a failed verdict, not a missing
    one."""
    try:
        seen = problem.check_ac(plan)
    except DcvrtError as error:
        return {"ac_passed": 0, "ac_v_min_pu": None, "ac_v_error_pu": None, "ac_status": str(error)}
    excess = {"plan": seen.reactive, "unhosted": seen.reactive_unhosted}
    return {
        "ac_passed": int(seen.passed),
        "ac_v_min_pu": seen.v_min_pu,
        "ac_v_error_pu": seen.v_error_pu,
        "ac_status": seen.status,
        "worst": {REACTIVE: {name: asdict(found) for name, found in excess.items() if found is not None}},
    }


def plan_hosting(plan: Mapping[str, Any]) -> dict[str, Any]:
    """The row of `hostings` of a plan."""
    return hosting_row(plan["hosting"], "plan", "", {int(bus): mw for bus, mw in plan["by_site"].items()})
