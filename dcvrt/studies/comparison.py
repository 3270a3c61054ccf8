"""The paper's method and the frontier on the same study, side by side, as plain data."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from dcvrt.studies.coupling import rides_of
from dcvrt.studies.store import DETAILS, RUN_FAILED, Store, records

if TYPE_CHECKING:
    import pandas as pd

PAPER, FRONTIER = "paper", "frontier"
KINDS = {
    "sample": "paper",
    "search": "frontier",
    "candidate": "replay",
    "plan": "replay",
    "system search": "system_search",
    "system candidate": "system_replay",
}
"""What hosting vectors are simulated for, by their roles."""


def comparison(store: Store) -> dict[str, Any]:
    """What the two methods host at every mode and rating, and what each spent.

    Returns
    -------
    dict
        `rows`: mode, beta; for each method total_mw, by_site, passed (the replay; None where nothing is
        hosted), false_pass (it hosts and failed), closed_loop (whether it rides through with its facilities
        in the network; None where that was not simulated) and closed; gain_mw: what the frontier hosts beyond
        the paper's method, None where the plan of either failed; of the frontier: margins (what binds),
        by_sequence, candidates, refused, gap, settled.
        `simulations`: by role of the hosting vector (`paper`: the samples of the fits; `frontier`: samples
        and candidates of the search; `replay`: both methods' replays; `system_search`, `system_replay`: what
        system limits took beyond that), fault simulations and facility runs, with gradients or without, and
        how many failed.
        `ratio`: fault simulations of the search over those of the paper's sampling.
        `hidden`: sentences on capacity that passed the replay and that the paper's fits did not allow.
    """
    plans = {(p["method"], p["mode"], p["beta"]): p for p in records(store.plans())}
    rides = rides_of(records(store.coupling()))
    runs = [(mode, beta) for method, mode, beta in plans if method == FRONTIER]
    rows = [
        _row(plans[PAPER, mode, beta], plans[FRONTIER, mode, beta], rides)
        for mode, beta in runs
        if (PAPER, mode, beta) in plans
    ]
    spent = _simulations(store)
    paper, search = spent["paper"]["grid"], spent["frontier"]["grid"]
    return {
        "rows": rows,
        "simulations": spent,
        "ratio": search / paper if paper else None,
        "hidden": [text for row in rows if (text := _hidden(row))],
    }


def _row(
    paper: Mapping[str, Any], frontier: Mapping[str, Any], rides: Mapping[tuple[str, str, float], bool]
) -> dict[str, Any]:
    row: dict[str, Any] = {"mode": frontier["mode"], "beta": frontier["beta"]}
    for name, plan in ((PAPER, paper), (FRONTIER, frontier)):
        hosts = plan["total_mw"] > 0
        row[name] = {
            "total_mw": plan["total_mw"],
            "by_site": plan["by_site"],
            "passed": bool(plan["passed"]) if hosts else None,
            "false_pass": bool(hosts and not plan["passed"]),
            "closed_loop": rides.get((plan["hosting"], plan["mode"], plan["beta"])) if hosts else None,
            "closed": plan["closed"],
        }
    search = frontier["search"]
    equal = not row[PAPER]["false_pass"] and not row[FRONTIER]["false_pass"]
    row["gain_mw"] = frontier["total_mw"] - paper["total_mw"] if equal else None
    return row | {
        name: search.get(name)
        for name in ("margins", "by_sequence", "candidates", "refused", "gap", "settled")
    }


def fault_runs(store: Store, margins: pd.DataFrame) -> pd.DataFrame:
    """The first facility run of every fault simulation; in closed loop each mode and rating has its own."""
    study = store.provenance().get("study")
    if study is None or study["grid"]["coupling"] != "closed":
        return margins.drop_duplicates(["hosting", "period", "fault"])
    roles = dict(zip(store.hostings().name, store.hostings().role, strict=True))
    kinds = [KINDS[roles[name]] for name in margins.hosting]
    runs = zip(kinds, margins["mode"], margins.beta, strict=True)
    own = ["" if kind.endswith("replay") else f"{mode} {beta}" for kind, mode, beta in runs]
    keyed = margins.assign(run=own)
    return keyed.drop_duplicates(["hosting", "period", "fault", "run"])


def _simulations(store: Store) -> dict[str, dict[str, int]]:
    margins = store.margins(leave=DETAILS)
    role = dict(zip(store.hostings().name, store.hostings().role, strict=True))
    margins = margins.assign(kind=[KINDS[role[name]] for name in margins.hosting])
    spent = {}
    for kind in dict.fromkeys(KINDS.values()):
        gradients = kind in ("frontier", "system_search")
        here = margins[(margins.kind == kind) & (margins.failed_in != "task")]
        faults = fault_runs(store, here)
        ran = here[here.failed_in != "grid"]
        spent[kind] = {
            "grid": len(faults),
            "grid_with_gradients": len(faults) if gradients else 0,
            "grid_failed": int((faults.failed_in == "grid").sum()),
            "facility": len(ran),
            "facility_with_gradients": len(ran) if gradients else 0,
            "facility_failed": int(ran.failed_in.isin(RUN_FAILED).sum()),
        }
    return spent


def _hidden(row: Mapping[str, Any]) -> str:
    """A sentence where the paper's fits did not allow what passes the replay; empty elsewhere."""
    paper, frontier = row[PAPER], row[FRONTIER]
    gain = frontier["total_mw"] - paper["total_mw"]
    if not frontier["passed"] or not gain > 0.005 * frontier["total_mw"]:
        return ""
    shut = [bus for bus in paper["closed"] if frontier["by_site"][bus] > 0]
    sites = f", closing bus {', '.join(shut)}" if shut else ""
    return (
        f"{row['mode']}, beta {row['beta']:g}: {frontier['total_mw']:.1f} MW pass the replay; the paper's "
        f"fits allow {paper['total_mw']:.1f} MW{sites}. The {gain:.1f} MW between are an effect of the fit "
        "and of the box that it was sampled in, not of the system."
    )


def buses(by_site: Mapping[str, float]) -> str:
    """Open sites with their capacities, in words.

    >>> buses({"21": 0.0, "75": 145.7})
    '75: 145.7'
    """
    return ", ".join(f"{bus}: {mw:.1f}" for bus, mw in by_site.items() if mw > 0) or "–"
