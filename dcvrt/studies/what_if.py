"""How the least rating moves with the assumptions: the last phase of a study, on the waveforms it has kept.

For the largest plan of each mode that passed, the least converter rating is sought with the study's own
values and with those of each `[[what_if]]`, on the voltages that the grid gave at the plan's open sites in
all periods and faults. The hosted capacities stay; no fault is simulated again.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from dcvrt.criteria import Criteria
from dcvrt.planning import replay
from dcvrt.planning.rating import least_rating
from dcvrt.studies.config import CriteriaSection, StudyFile, WhatIfEntry
from dcvrt.studies.findings import SAME_SHARE
from dcvrt.studies.phases import NO_VRT, Setting, criteria
from dcvrt.studies.store import Store, records
from dcvrt.waveform import Waveform

if TYPE_CHECKING:
    from dcvrt.integrators import Simulator

LOW, HIGH, TOLERANCE = 1.0, 2.0, 0.001
"""Ratings that are searched, and how close the result lies."""

CRITERIA_UNITS = {"v_it_min_pu": "pu", "window_ms": "ms", "loss_window_ms": "ms"}
AS_STUDIED = "as studied"


def run_what_ifs(store: Store, setting: Setting, progress: Any) -> None:
    """Find the least rating of each mode's largest plan under every what-if, and write them as a whole.

    Nothing is done when the plans, the waveforms, the study's values and the what-ifs are those of the rows
    that are there.
    """
    file = setting.file
    entries = list(enumerate(file.what_if, start=1))
    plans = largest_passed(store, setting) if entries else {}
    found = {mode: _at_open_sites(store, plan) for mode, plan in plans.items()}
    digest = hashlib.sha256(
        json.dumps(
            [
                [LOW, HIGH, TOLERANCE, setting.d, file.hosting.pf, criteria(file)],
                [entry.model_dump() for entry in file.what_if],
                [
                    [mode, plan["method"], plan["beta"], plan["hosting"], parameters_of(file, mode)]
                    for mode, plan in plans.items()
                ],
                [[mode, list(waveforms)] for mode, waveforms in found.items()],
            ]
        ).encode()
    ).hexdigest()
    if store.provenance().get("what_ifs_from") == digest:
        return
    asked = {
        mode: [(0, None), *[(k, entry) for k, entry in entries if mode in (entry.modes or [mode])]]
        for mode in plans
    }
    total = sum(map(len, asked.values()))
    rows: list[dict[str, Any]] = []
    for mode, plan in plans.items():
        simulator = replay.simulator_of(mode, parameters_of(file, mode))
        for number, entry in asked[mode]:
            rows.append(
                {
                    "mode": mode,
                    "number": number,
                    **_described(file, mode, simulator, entry),
                    **{name: plan[name] for name in ("method", "beta", "hosting", "total_mw")},
                    "n_waveforms": len(found[mode]),
                    "low": LOW,
                    "high": HIGH,
                    "rating": _rating(setting, simulator, found[mode], entry),
                }
            )
            progress("what-ifs", len(rows), total, 0)
    with store.transaction():
        store.clear("what_ifs")
        store.put("what_ifs", rows)
        store.note(what_ifs_from=digest)


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


def parameters_of(file: StudyFile, mode: str) -> dict[str, float]:
    """Parameters that the study sets for a mode."""
    return file.facility.parameters | file.facility.parameters_by_mode.get(mode, {})


def changes_of(
    entry: WhatIfEntry, units: Mapping[str, str], values: Mapping[str, float], studied: CriteriaSection
) -> list[dict[str, Any]]:
    """What an entry changes: name, unit, the value of the study and the varied one.

    Parameters
    ----------
    entry : the what-if.
    units, values : units of the facility's parameters and their values in the study, by path.
    studied : criteria of the study.
    """
    changes = [
        {"name": path, "unit": units[path], "studied": values[path], "varied": value}
        for path, value in entry.parameters.items()
    ]
    return changes + [
        {
            "name": f"criteria.{name}",
            "unit": CRITERIA_UNITS.get(name, "1"),
            "studied": getattr(studied, name),
            "varied": value,
        }
        for name, value in entry.criteria().items()
    ]


def values_text(changes: Sequence[Mapping[str, Any]], which: str, named: bool = True) -> str:
    """Values of some changes in words.

    >>> change = {"name": "lag.tau", "unit": "s", "studied": 0.004, "varied": 0.008}
    >>> values_text([change], "studied"), values_text([change], "varied", named=False)
    ('lag.tau = 0.004 s', '0.008 s')
    """
    parts = []
    for change in changes:
        value = change[which]
        text = value if isinstance(value, str) else f"{value:g}"
        text += "" if change["unit"] == "1" else f" {change['unit']}"
        parts.append(f"{change['name']} = {text}" if named else text)
    return ", ".join(parts)


def _at_open_sites(store: Store, plan: Mapping[str, Any]) -> dict[tuple[str, str, int], Waveform]:
    """POI voltages of the replay of a plan, by period, fault and open site."""
    return {
        (key["period"], key["fault"], key["site"]): Waveform(
            signals["t_s"].astype(np.float64),
            signals["v_re_pu"] + 1j * signals["v_im_pu"],
            name=f"{key['period']}, {key['fault']}, site {key['site']}",
        )
        for key, signals in store.waveforms(hosting=plan["hosting"], mode="")
        if plan["by_site"][str(key["site"])] > 0
    }


def _described(file: StudyFile, mode: str, simulator: Simulator, entry: WhatIfEntry | None) -> dict[str, Any]:
    if entry is None:
        return {"label": AS_STUDIED, "changes": []}
    table = {row.path: row for row in simulator.dae.parameters}
    changes = changes_of(
        entry,
        {path: row.unit for path, row in table.items()},
        {path: row.value for path, row in table.items()},
        file.criteria,
    )
    return {"label": entry.label or values_text(changes, "varied"), "changes": changes}


def _rating(
    setting: Setting,
    simulator: Simulator,
    waveforms: Mapping[tuple[str, str, int], Waveform],
    entry: WhatIfEntry | None,
) -> float | None:
    file = setting.file
    varied = {} if entry is None else entry.criteria()
    asked = file.model_copy(update={"criteria": file.criteria.model_copy(update=varied)})
    return least_rating(
        simulator,
        list(waveforms.values()),
        [setting.d[period] for period, _, _ in waveforms],
        file.hosting.pf,
        Criteria(**criteria(asked)),
        LOW,
        HIGH,
        TOLERANCE,
        {} if entry is None else entry.parameters,
    )
