"""What a study folder holds for people and programs, made from the store alone: summary.json, table.csv,
validation.csv, coupling.csv, frontier.json, sensitivity.json.

Each file is written beside itself and then moved into place: a file that is there is whole.
"""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dcvrt.errors import InputError
from dcvrt.planning.surrogate import score
from dcvrt.studies.campaign import LOST
from dcvrt.studies.comparison import comparison, fault_runs
from dcvrt.studies.store import DETAILS, RUN_FAILED, Store, records
from dcvrt.studies.system_limit import system_limits

if TYPE_CHECKING:
    import pandas as pd

COUPLING, FRONTIER, SENSITIVITY = "coupling.csv", "frontier.json", "sensitivity.json"
SYSTEM_KEYS = (
    "mode", "beta", "limit", "limit_mw", "limit_share", "total_mw", "by_site", "passed", "ac_passed",
    "aggregate_loss_mw", "lost_whole", "price_mw_per_mw", "closed_loop",
)  # fmt: skip
"""What the summary says of a plan under a system limit; `frontier.json` has the rest."""
STORE, SUMMARY, TABLE, VALIDATION, STUDY = (
    "study.sqlite",
    "summary.json",
    "table.csv",
    "validation.csv",
    "study.toml",
)


def refuse_unusable(folder: Path) -> None:
    """Refuse a folder that cannot be made or written into, before any work is done; leaves no trace.

    Raises
    ------
    InputError
        Saying what is in the way.
    """
    way_out = "Way out: take another folder with --out."
    place = folder
    try:
        while not place.exists():
            place = place.parent
        if not place.is_dir():
            what = "is a file, not a folder" if place == folder else f"cannot be made: {place} is a file"
            raise InputError(f"{folder} {what}. {way_out}")
        with tempfile.TemporaryFile(dir=place):
            pass
    except OSError as error:
        raise InputError(f"{folder} cannot be written: {place}: {error.strerror}. {way_out}") from None


def write_atomically(path: Path, text: str) -> Path:
    """Write a file so that it is there whole or not at all."""
    fresh = path.with_name(f".{path.name}.tmp")
    with fresh.open("w", encoding="utf-8", newline="") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    os.replace(fresh, path)
    return path


def write_results(folder: Path, store: Store) -> list[Path]:
    """Write the tables of a finished study; the summary last, as it says that the rest is there."""
    return [
        write_atomically(folder / TABLE, plan_table(store).to_csv(index=False)),
        write_atomically(folder / VALIDATION, validation_table(store).to_csv(index=False)),
        write_atomically(folder / COUPLING, store.coupling().to_csv(index=False)),
        write_atomically(
            folder / FRONTIER,
            json.dumps(
                _clean(comparison(store) | {"system_limit": system_limits(store)}), indent=2, allow_nan=False
            )
            + "\n",
        ),
        write_atomically(
            folder / SENSITIVITY, json.dumps(_clean(sensitivity(store)), indent=2, allow_nan=False) + "\n"
        ),
        write_atomically(folder / SUMMARY, json.dumps(summary(store), indent=2, allow_nan=False) + "\n"),
    ]


def sensitivity(store: Store) -> dict[str, Any]:
    """Sensitivities of one plan of each mode: the plans, the assumptions with most at stake first, and what
    was simulated for them."""
    known = store.provenance()
    return {
        "plans": known.get("sensitivity_plans", {}),
        "rows": records(store.sensitivities()),
        "simulations": known.get("sensitivity_runs", {"grid": 0, "facility": 0}),
    }


def summary(store: Store) -> dict[str, Any]:
    """The result of a study as plain data; its keys are fixed."""
    plans = records(store.plans())
    known = store.provenance()
    none = next(plan for plan in plans if plan["method"] == "none")
    return _clean(
        {
            "no_vrt": {"total_mw": none["total_mw"], "by_site": none["by_site"]},
            "rows": [_plan(plan, known["engine"]) for plan in plans if plan["method"] != "none"],
            "system_limit": [
                {name: row[name] for name in SYSTEM_KEYS} for row in system_limits(store)["rows"]
            ],
            "surrogate": surrogate_scores(store),
            "simulations": simulations(store),
            "wall_s": known.get("wall_s", 0.0),
            "versions": known["versions"],
        }
    )


def _plan(plan: Mapping[str, Any], engine: str) -> dict[str, Any]:
    return {
        "mode": plan["mode"],
        "beta": plan["beta"],
        "method": plan["method"],
        "total_mw": plan["total_mw"],
        "by_site": plan["by_site"],
        "binding": binding(plan),
        "replay": {
            "engine": engine,
            "passed": bool(plan["passed"]) if plan["total_mw"] > 0 else None,  # nothing to replay
            **{
                key: plan[key]
                for key in ("worst_voltage_margin_pu", "worst_loss_margin_mw", "aggregate_loss_mw")
            },
        },
        "ac": {
            "passed": bool(plan["ac_passed"]),
            "v_min_pu": plan["ac_v_min_pu"],
            "v_error_pu": plan["ac_v_error_pu"],
        },
    }


def binding(plan: Mapping[str, Any]) -> list[dict[str, Any]]:
    """What keeps a plan from hosting more, and the sites that it closes, each with the reason."""
    carried = plan["carried_from"]
    found: list[dict[str, Any]] = (
        []
        if carried is None or carried != carried
        else [
            {
                "kind": "carried",
                "label": f"found at beta {carried:g}: larger than the fits of this beta allow by themselves",
            }
        ]
    )
    found += [dict(item) for item in plan["binding"]]
    return found + [{"kind": "closed", "bus": int(bus), "label": why} for bus, why in plan["closed"].items()]


def surrogate_scores(store: Store) -> list[dict[str, Any]]:
    """Validation figures per method, mode and target, over all sites, faults, periods and ratings."""
    points, fits = store.predictions(), store.surrogates()
    rows = []
    for (method, mode, target), fitted in fits.groupby(["method", "mode", "target"], sort=True):
        here = points[(points.method == method) & (points["mode"] == mode) & (points.target == target)]
        s = score(here.predicted.to_numpy(), here.margin.to_numpy())
        rows.append(
            {
                "method": method,
                "mode": mode,
                "target": target,
                "mae": s.mae,
                "rmse": s.rmse,
                "worst_over": s.worst_over,
                "worst_under": s.worst_under,
                "violation_rate": s.violation_rate,
                "n_fit": int(fitted.n_fit.sum()),
                "n_validation": s.n,
                "n_validation_failed": s.n_failed,
            }
        )
    return rows


def simulations(store: Store) -> dict[str, int]:
    """How many simulations were made, how many failed, how many tasks were set aside.

    A fault without a waveform is one failure, however many facility runs it would have fed.
    """
    margins, tasks = store.margins(leave=DETAILS), store.tasks()
    faults = fault_runs(store, margins[margins.failed_in != "task"])
    ran = margins[margins.failed_in.isin(["", *RUN_FAILED])]
    return {
        "grid": len(faults),
        "facility": len(ran),
        "failed": int((faults.failed_in == "grid").sum() + ran.failed_in.isin(RUN_FAILED).sum()),
        "quarantined": int(tasks.status.isin(LOST).sum()),
    }


def plan_table(store: Store) -> pd.DataFrame:
    """One row per plan, the one without ride-through first, those under system limits last: capacities,
    verdicts, what is worst and what closes."""
    import pandas as pd

    rows = []
    plans = records(store.plans())
    for plan in sorted(plans, key=lambda p: (p["method"] != "none", p["method"], p["mode"], p["beta"])):
        vrt = plan["method"] != "none"
        worst = plan["worst"]
        rows.append(
            {
                "method": plan["method"] if vrt else "no ride-through",
                "mode": plan["mode"],
                "beta": plan["beta"] if vrt else None,
                "total_mw": plan["total_mw"],
                **{f"bus_{bus}_mw": mw for bus, mw in plan["by_site"].items()},
                "replay": verdict_word(plan) if vrt else "",
                "worst_voltage_margin_pu": plan["worst_voltage_margin_pu"],
                "worst_loss_margin_mw": plan["worst_loss_margin_mw"],
                "aggregate_loss_mw": plan["aggregate_loss_mw"],
                "failed_runs": plan["n_failed"],
                "worst_voltage_at": _place(worst.get("voltage")),
                "worst_loss_at": _place(worst.get("loss")),
                "ac": "passed" if plan["ac_passed"] else "failed",
                "ac_v_min_pu": plan["ac_v_min_pu"],
                "ac_v_error_pu": plan["ac_v_error_pu"],
                "closed_sites": " ".join(plan["closed"]),
                "carried_from_beta": plan["carried_from"],
            }
        )
    for plan in records(store.system_plans()):
        rows.append(
            {
                "method": f"system limit {plan['limit_name']}",
                "mode": plan["mode"],
                "beta": plan["beta"],
                "total_mw": plan["total_mw"],
                **{f"bus_{bus}_mw": mw for bus, mw in plan["by_site"].items()},
                "replay": verdict_word(plan),
                "aggregate_loss_mw": plan["aggregate_loss_mw"],
                "failed_runs": plan["n_failed"],
                "ac": "passed" if plan["ac_passed"] else "failed",
                "ac_v_min_pu": plan["ac_v_min_pu"],
                "ac_v_error_pu": plan["ac_v_error_pu"],
                "closed_sites": " ".join(plan["closed"]),
            }
        )
    return pd.DataFrame(rows)


def verdict_word(plan: Mapping[str, Any]) -> str:
    """passed, failed, not replayed, or nothing hosted."""
    if plan["total_mw"] == 0:
        return "nothing hosted"
    if not plan["replayed"]:
        return "not replayed"
    return "passed" if plan["passed"] else "failed"


def _place(where: Mapping[str, Any] | None) -> str:
    return "" if not where else f"bus {where['site']}, fault {where['fault']}, {where['period']}"


def validation_table(store: Store) -> pd.DataFrame:
    """One row per fitted margin with its counts and validation figures."""
    import pandas as pd

    frame = store.surrogates()
    slopes = pd.DataFrame([{f"slope_{bus}": value for bus, value in row.items()} for row in frame.slopes])
    return pd.concat([frame.drop(columns=["slopes"]), slopes], axis=1)


def _clean(value: Any) -> Any:
    """NaN as null, NumPy scalars as plain numbers."""
    if isinstance(value, Mapping):
        return {str(key): _clean(item) for key, item in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_clean(item) for item in value]
    if hasattr(value, "item"):
        value = value.item()
    return None if isinstance(value, float) and value != value else value
