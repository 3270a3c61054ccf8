"""Plans under a limit on the load that all sites together lose at once: which are wanted, and what came of
them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict
from typing import Any

from dcvrt.planning.exact import Run, exact_of
from dcvrt.planning.requirement import Requirement, SystemLimit
from dcvrt.planning.search import Found
from dcvrt.planning.verdict import limit_verdict
from dcvrt.studies import plans
from dcvrt.studies.setting import Setting
from dcvrt.studies.store import DETAILS, Store, records

ROLES = ("system search", "system candidate")
"""Roles of the hosting vectors that are simulated for these plans alone, and of those replayed for them."""


REPLAYED = ("plan", "candidate", "system candidate")
"""Roles of hosting vectors that are replayed, if they host anything."""


def wanted(setting: Setting) -> list[tuple[Run, Requirement]]:
    """Every limit of the study file with every mode and rating that it is tried on."""
    asked = setting.file.system_limit
    limits = [SystemLimit(setting.sites, setting.d, mw=mw) for mw in asked.loss_mw]
    limits += [SystemLimit(setting.sites, setting.d, share=share) for share in asked.loss_share]
    runs = [run for run in setting.runs if asked.beta is None or run[1] in asked.beta]
    return [(run, limit) for run in runs for limit in limits]


def write_front(store: Store, setting: Setting) -> None:
    """Write what may be hosted at what loss, by all replays; nothing where no limit was asked for.

    A hosting vector is replayed under all faults for every mode and rating, whatever search or method asked
    for it. So each of them has a front from below, also where no limit was searched at its rating. The
    network allows these vectors: candidates of searches, and plans that AC power flow confirms.
    """
    rows: list[dict[str, Any]] = []
    if wanted(setting):
        refused = {p["hosting"] for p in records(store.plans()) if p["ac_passed"] == 0}
        hostings = {
            row["name"]: row["by_site"]
            for row in records(store.hostings())
            if row["role"] in REPLAYED and row["name"] not in refused
        }
        margins = store.margins(hosting=list(hostings), leave=DETAILS)
        replayed = {str(name): records(of_vector) for name, of_vector in margins.groupby("hosting")}
        for run, points in _losses(setting, hostings, replayed).items():
            rows += front(run, points)
    with store.transaction():
        store.clear("system_front")
        store.put("system_front", rows)


Point = tuple[float, float, str]
"""What is lost at once in the worst fault, MW; what is hosted, MW; the name of the hosting vector."""


def _losses(
    setting: Setting,
    hostings: Mapping[str, Mapping[str, float]],
    replayed: Mapping[str, Iterable[Mapping[str, Any]]],
) -> dict[Run, list[Point]]:
    places = len(setting.periods) * len(setting.file.fault)
    limit = SystemLimit(setting.sites, setting.d)
    points: dict[Run, list[Point]] = {}
    for name, rows in replayed.items():
        H = [hostings[name][str(bus)] for bus in setting.sites]
        for run, exact in exact_of(rows, setting.sites, H).items():
            told = limit_verdict(exact, limit, places)
            if not told["n_failed"]:
                points.setdefault(run, []).append((told["aggregate_loss_mw"], sum(H), name))
    return points


def front(run: Run, points: Iterable[Point]) -> list[dict[str, Any]]:
    """Rows of `system_front`: the points of a mode and rating that no other dominates.

    >>> points = [(9.0, 50.0, "b"), (8.0, 40.0, "a"), (9.0, 45.0, "c"), (9.5, 50.0, "d")]
    >>> [row["hosting"] for row in front(("gfl", 1.2), points)]
    ['a', 'b']
    """
    rows: list[dict[str, Any]] = []
    mode, beta = run
    for loss, total, name in sorted(points, key=lambda point: (point[0], -point[1], point[2])):
        if not rows or total > rows[-1]["total_mw"]:
            rows.append(dict(mode=mode, beta=beta, hosting=name, total_mw=total, loss_mw=loss))
    return rows


def plan_row(setting: Setting, limit: Requirement, found: Found) -> dict[str, Any]:
    """The row of `system_plans` of what was found, before its checks."""
    assert isinstance(limit, SystemLimit)
    row = plans.plan_row(setting, "", found.mode, found.beta, found.plan, found.closed, None)
    del row["method"], row["carried_from"]
    return row | {
        "limit_name": limit.name,
        "limit_mw": limit.mw,
        "limit_share": limit.share,
        "search": told(found),
    }


def told(found: Found) -> dict[str, Any]:
    """How a plan was found, as plain data."""
    return {
        "candidates": found.candidates,
        "refused": found.failed,
        "gap": found.gap,
        "settled": found.settled,
        "by_sequence": list(found.by_sequence),
        "margins": [asdict(margin) for margin in found.binding],
    }


def system_limits(store: Store) -> dict[str, Any]:
    """Plans under system limits, beside those whose every site rides through, as plain data.

    Returns
    -------
    dict
        `rows`, by mode, rating and rising limit: mode, beta, limit (name), limit_mw, limit_share; total_mw,
        by_site, closed; passed (the replay; None where nothing is hosted), aggregate_loss_mw (the largest of
        the replay), losses (one by one: period, fault, loss_mw, limit_mw, whole: sites that lose all),
        lost_whole (sites that do so in any), n_failed; price_mw_per_mw: hosted MW gained for each MW more
        that may be lost, 0 where the limit does not bind; candidates, refused, gap, settled, by_sequence,
        margins of the search; closed_loop (aggregate_loss_mw and passed once the facilities act on the
        network; None where that was not simulated).
        `front`, by mode, rating and rising loss: mode, beta, hosting, total_mw, loss_mw of every replayed
        vector of which no other hosts more and loses less, by a search or not.
        `every_site`: mode, beta, total_mw, passed and aggregate_loss_mw of the frontier, whose sites each
        meet their own criteria.
    """
    known, coupled = store.provenance(), records(store.coupling())
    rows = [
        _row(plan) | {"closed_loop": in_closed_loop(plan, coupled, known["periods"], known["criteria"])}
        for plan in records(store.system_plans())
    ]
    every = [p for p in records(store.plans()) if p["method"] == "frontier" and rows]
    return {
        "rows": rows,
        "front": records(store.system_front()),
        "every_site": [
            {name: p[name] for name in ("mode", "beta", "total_mw")}
            | {"passed": _passed(p), "aggregate_loss_mw": p["aggregate_loss_mw"]}
            for p in every
        ],
    }


def _row(plan: Mapping[str, Any]) -> dict[str, Any]:
    search = plan["search"]
    return {
        "mode": plan["mode"],
        "beta": plan["beta"],
        "limit": plan["limit_name"],
        "limit_mw": plan["limit_mw"],
        "limit_share": plan["limit_share"],
        "total_mw": plan["total_mw"],
        "by_site": plan["by_site"],
        "closed": plan["closed"],
        "passed": _passed(plan),
        "aggregate_loss_mw": plan["aggregate_loss_mw"],
        "losses": plan["losses"],
        "lost_whole": sorted({bus for entry in plan["losses"] for bus in entry["whole"]}),
        "n_failed": plan["n_failed"],
        "ac_passed": bool(plan["ac_passed"]),
        "price_mw_per_mw": sum(item["price"] for item in search["margins"]),
        **search,
    }


def in_closed_loop(
    plan: Mapping[str, Any],
    coupled: Iterable[Mapping[str, Any]],
    periods: Mapping[str, Mapping[str, Any]],
    criteria: Mapping[str, Any],
) -> dict[str, Any] | None:
    """What a plan loses at once with its facilities in the network, and whether that is within its limit.

    A run without a result there counts as lost whole, and fails the plan.
    """
    run = tuple(plan[name] for name in ("hosting", "mode", "beta"))
    rows = [row for row in coupled if (row["hosting"], row["mode"], row["beta"]) == run]
    if not rows:
        return None
    lost: dict[tuple[str, str], float] = {}
    for row in rows:
        known = row["loss_closed"] is not None and row["loss_closed"] == row["loss_closed"]
        held = known and row["voltage_closed"] >= 0
        share = criteria["loss_share"] - row["loss_closed"] if held else 1.0
        place = (row["period"], row["fault"])
        mw = periods[row["period"]]["dc_factor"] * plan["by_site"][str(row["site"])] * share
        lost[place] = lost.get(place, 0.0) + mw
    before = {name: period["dc_factor"] * plan["total_mw"] for name, period in periods.items()}
    passed = all(not row["status"] for row in rows) and all(
        mw <= plan["limit_mw"] + plan["limit_share"] * before[period] for (period, _), mw in lost.items()
    )
    return {"aggregate_loss_mw": max(lost.values()), "passed": passed}


def _passed(plan: Mapping[str, Any]) -> bool | None:
    return bool(plan["passed"]) if plan["total_mw"] > 0 else None
