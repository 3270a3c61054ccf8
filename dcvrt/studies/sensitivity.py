"""How the headline moves with every assumption: the last phase of a study.

For one plan of the frontier in each mode, the hosted MW gained for each unit of an assumption is the sum of
the prices of its binding margins times their derivatives (`dcvrt.planning.sensitivity`). What gradients
cannot see is looked for by running the facility at both ends of the range of each assumption, on the voltages
of the plan: whether the plan still passes, and whether it passes through other events. Where most is at
stake, the frontier is searched again with the varied value.
"""

from __future__ import annotations

import hashlib
import itertools
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from dcvrt.criteria import Criteria
from dcvrt.errors import InputError, first_sentence
from dcvrt.planning import replay
from dcvrt.planning.design import TARGETS, Exposure, Trial, on_facility
from dcvrt.planning.exact import Exact, Run
from dcvrt.planning.sensitivity import (
    CRITERIA,
    LEVELS,
    Assumption,
    Key,
    Priced,
    assumptions,
    first_order,
    margin_gradient,
    resolved,
)
from dcvrt.studies.campaign import Campaign, Task
from dcvrt.studies.checks import SHARED
from dcvrt.studies.config import StudyFile
from dcvrt.studies.findings import SAME_SHARE
from dcvrt.studies.frontier import METHOD
from dcvrt.studies.rerun import Reruns
from dcvrt.studies.setting import Setting, criteria, setting_of
from dcvrt.studies.store import Store, records
from dcvrt.waveform import Waveform

PHASE = "sensitivities"
SIDES = ("low", "high")
BY_SEQUENCE = "(by sequence)"
"""How the label of a limit ends that was set by bisection at a change of events."""
NEAR = 0.05
"""Margin, pu or share, below which the gradients of a margin that does not bind are asked for as well."""
SMALL = 0.5
"""Change up to which the first order is taken for the programme, MW."""
SHOWN = 0.05
"""Change of the hosted capacity from which on there is something to tell, MW."""


def run_sensitivity(campaign: Campaign, setting: Setting, progress: Any) -> list[str]:
    """Find the sensitivities of one plan of each mode, a task each, and write them as a whole; messages of
    what was set aside.

    Nothing is done when the plans, the study and what is asked are those of the rows that are there, and none
    are found where searches are in closed loop: the voltages then depend on what is varied.
    """
    store, tasks = campaign.store, _tasks(campaign.store, setting)
    if _known(store, tasks):
        return []
    answers: dict[str, dict[str, Any]] = {}
    lost: list[str] = []
    starts: Counter[str] = Counter()

    def started(task: Task) -> int:
        starts[task.key] += 1
        return starts[task.key]

    crew = campaign.crew.run(tasks, of_plan, campaign.timeout_s, campaign.tries, started)
    for number, (task, outcome) in enumerate(crew, start=1):
        mode = task.payload["mode"]
        if outcome.state == "done":
            answers[mode] = outcome.result
        else:
            lost.append(f"{PHASE} of {mode}: {outcome.state}: {outcome.message}")
        progress(PHASE, number, len(tasks), len(lost))
    found = [answers[task.payload["mode"]] for task in tasks if task.payload["mode"] in answers]
    with store.transaction():
        store.clear(PHASE)
        store.put(PHASE, [row for answer in found for row in answer["rows"]])
        store.note(
            sensitivities_from="" if lost else _digest(tasks),
            sensitivity_plans={answer["mode"]: answer["plan"] for answer in found},
            sensitivity_runs={kind: sum(answer[kind] for answer in found) for kind in ("grid", "facility")},
        )
    return lost


def sensitivity_ahead(campaign: Campaign, setting: Setting) -> None:
    """Let idle workers find sensitivities, once the plans of the frontier are judged."""
    tasks = _tasks(campaign.store, setting)
    if not _known(campaign.store, tasks):
        campaign.crew.ahead(tasks, of_plan)


def _tasks(store: Store, setting: Setting) -> list[Task]:
    """One task for each mode that has a plan."""
    file = setting.file
    modes = [] if setting.closed else file.facility.modes
    plans = {mode: plan for mode in modes if (plan := headline(store, file, mode)) is not None}
    study = {"study": file.model_dump(mode="json"), "folder": str(setting.folder.resolve())}
    return [Task(PHASE, study | {"mode": mode, "plan": _needed(plan)}) for mode, plan in plans.items()]


def _digest(tasks: Sequence[Task]) -> str:
    return hashlib.sha256("".join(task.key for task in tasks).encode()).hexdigest()


def _known(store: Store, tasks: Sequence[Task]) -> bool:
    """Whether the rows that are there are the answers to these tasks."""
    return store.provenance().get("sensitivities_from") == _digest(tasks)


def _needed(plan: Mapping[str, Any]) -> dict[str, Any]:
    """What is needed of a row of `plans`, as plain data."""
    return {name: plan[name] for name in ("beta", "hosting", "total_mw", "by_site", "closed")} | {
        "binding": [
            {"kind": item["kind"], "label": item["label"], "price": item.get("price", 0.0)}
            for item in plan["binding"]
        ],
        "margins": plan["search"].get("margins", []),
    }


def headline(store: Store, file: StudyFile, mode: str) -> dict[str, Any] | None:
    """The plan of the frontier whose sensitivities are found, or None where the frontier hosts nothing.

    That of the rating which the study names; else the largest of those that passed and are held by a margin;
    else the largest that passed, at its least rating.
    """
    plans = [
        plan
        for plan in records(store.plans())
        if (plan["method"], plan["mode"]) == (METHOD, mode) and plan["total_mw"] > 0 and plan["passed"] == 1
    ]
    named = file.sensitivity.beta
    if named is not None:
        return next((plan for plan in plans if plan["beta"] == named), None)
    held = [plan for plan in plans if any(item["price"] > 0 for item in plan["search"].get("margins", []))]
    among = held or plans
    if not among:
        return None
    most = max(plan["total_mw"] for plan in among)
    return min(
        (plan for plan in among if plan["total_mw"] >= (1.0 - SAME_SHARE) * most), key=lambda p: p["beta"]
    )


def parameters_of(file: StudyFile, mode: str) -> dict[str, float]:
    """Parameters that the study sets for a mode."""
    return file.facility.parameters | file.facility.parameters_by_mode.get(mode, {})


# -- one plan ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Case:
    """A plan with all that drives its facilities, and what holds it.

    Attributes
    ----------
    run : mode and rating ratio.
    H : capacities in the order of the sites, MW.
    values, asked : parameters and criteria of the study.
    exposures, buses : POI voltages at open sites, and whose they are.
    watched, keys, gradients : margins that hold it, and with a price of 0 those that are near to that, with
        their derivatives by every assumption.
    tangents : margins with total gradients at the plan.
    base : the runs of the study itself.
    total_mw : the hosting programme under these tangents.
    """

    setting: Setting
    run: Run
    H: tuple[float, ...]
    values: dict[str, float]
    asked: dict[str, Any]
    exposures: list[Exposure]
    buses: list[int]
    watched: list[Priced]
    keys: list[Key]
    gradients: list[dict[str, float]]
    tangents: list[Exact]

    def by_site(self, bus: int) -> float:
        return self.H[self.setting.sites.index(bus)]

    def varied(self, assumption: Assumption, value: float) -> tuple[dict[str, float], dict[str, Any]]:
        """Parameters and criteria with one assumption at another value."""
        if not assumption.field:
            return self.values | {assumption.path: value}, self.asked
        return self.values, self.asked | {assumption.field: CRITERIA[assumption.path][2] * value}

    def trial(self, values: Mapping[str, float], asked: Mapping[str, Any]) -> Trial:
        """Run every facility of the plan."""
        mode, beta = self.run
        pf = self.setting.file.hosting.pf
        attempt = on_facility(
            replay.simulator_of(mode, {}), self.exposures, Criteria(**asked), "beta", {**values, "pf": pf}
        )
        (found,) = attempt([beta])
        return found

    @cached_property
    def base(self) -> Trial:
        return self.trial(self.values, self.asked)

    @cached_property
    def total_mw(self) -> float:
        return self.resolved(None, 0.0)

    @property
    def held(self) -> bool:
        """Whether a margin holds the plan."""
        return any(one.price > 0 for one in self.watched)

    def first_order(self, path: str) -> float | None:
        """MW per unit; None where no margin holds the plan."""
        return first_order(self.watched, self.gradients, path) if self.held else None

    def by_gradient(self, path: str, change: float) -> float | None:
        """Change of the total with the watched margins shifted as their gradients say; None where none is
        watched. The programme is solved again only where something moves at first order or falls short."""
        if not self.watched:
            return None
        linear = (self.first_order(path) or 0.0) * change
        room = {(*one.place, *at): value for one in self.tangents for at, value in np.ndenumerate(one.value)}
        shifts = self._shifts(path, change)
        short = any(room[key] + shift < 0.0 for key, shift in shifts.items() if self.H[key[2]] > 0)
        if abs(linear) < SMALL and not short:
            return linear
        return self.resolved(path, change) - self.total_mw

    def _shifts(self, path: str | None, change: float) -> dict[Key, float]:
        """Change of the watched margins; of all margins of a target where a criterion shifts all alike."""
        shifts: dict[Key, float] = {}
        if path in LEVELS:
            target, derivative = LEVELS[path]
            shifts = {
                (*one.place, site, TARGETS.index(target)): derivative * change
                for one in self.tangents
                for site in range(len(self.H))
            }
        elif path is not None:
            both = zip(self.keys, self.gradients, strict=True)
            shifts = {key: gradient[path] * change for key, gradient in both}
        return shifts

    def resolved(self, path: str | None, change: float) -> float:
        """Total of the programme with the margins shifted."""
        problem = self.setting.problem
        held_by = [key for key, one in zip(self.keys, self.watched, strict=True) if one.price > 0]
        shifts = self._shifts(path, change)
        return resolved(problem, np.array(self.H), self.tangents, held_by, shifts, problem.upper)


def of_plan(request: Mapping[str, Any]) -> dict[str, Any]:
    """The sensitivities of one plan; takes and gives plain data, so that it can run in any process.

    Parameters
    ----------
    request : mapping of plain data
        `study`, `folder`: the study file, and what its relative paths start from; `mode`; `plan`: beta,
        hosting, total_mw, by_site, closed, binding {kind, label, price}, margins (that bind).

    Returns
    -------
    dict
        `mode`; `rows` of the store's `sensitivities`; `plan`: what holds it, and what the search with the
        values of the study finds; `grid`, `facility`: simulations made.
    """
    setting = setting_of(StudyFile.model_validate(request["study"]), Path(request["folder"]))
    _ = setting.no_vrt  # its cuts are what later solves, which look at few hours, start from
    mode, plan, reruns = request["mode"], request["plan"], Reruns(setting)
    file = setting.file
    parameters = replay.simulator_of(mode, parameters_of(file, mode)).dae.parameters
    studied = {path: float(getattr(file.criteria, path.split(".")[1])) for path in CRITERIA}
    asked = assumptions(parameters, studied, file.sensitivity.change, file.sensitivity.ranges, SHARED)
    case = _case(setting, reruns, mode, plan, [a.path for a in asked])
    rows = [_row(case, assumption) for assumption in asked]
    rows.sort(key=lambda row: -row["stake_mw"])
    ends = sum(end["value"] != row["value"] for row in rows for end in row["sides"].values())
    reruns.facility += len(case.exposures) * (1 + ends)
    about = {
        "beta": plan["beta"],
        "hosting": plan["hosting"],
        "total_mw": plan["total_mw"],
        "by_site": plan["by_site"],
        "binding": plan["margins"],
        "by_sequence": [
            item["label"]
            for item in plan["binding"]
            if item["kind"] == "row" and item["price"] > 0 and item["label"].endswith(BY_SEQUENCE)
        ],
        "limits": [
            f"{item['kind']} {item['label']}"
            for item in plan["binding"]
            if item["kind"] != "row" and item["price"] > 0
        ],
        "closed": dict(plan["closed"]),
        "near": [
            {
                "period": one.exposure.period,
                "fault": one.exposure.fault,
                "site": one.site,
                "target": one.target,
            }
            for one in case.watched
            if one.price == 0
        ],
        "rerun_mw": None,
    }
    chosen = [row for row in rows if row["stake_mw"] >= SHOWN][: file.sensitivity.reruns]
    if chosen:
        again = reruns.search(case.run, case.H, case.values, case.asked)
        about["rerun_mw"] = again.plan.total_mw
    by_path = {a.path: a for a in asked}
    for row in chosen:
        for end in row["sides"].values():
            if end["refused"] or end["value"] == row["value"]:
                continue
            found = reruns.search(case.run, case.H, *case.varied(by_path[row["path"]], end["value"]))
            end["rerun_mw"] = found.plan.total_mw
            end["rerun_by_site"] = {str(bus): mw for bus, mw in found.plan.by_site.items()}
            end["rerun_settled"] = found.settled
    return {
        "mode": mode,
        "rows": [row | {"mode": mode, "number": k} for k, row in enumerate(rows, start=1)],
        "plan": about,
        "grid": reruns.grid,
        "facility": reruns.facility,
    }


def _case(
    setting: Setting, reruns: Reruns, mode: str, plan: Mapping[str, Any], paths: Sequence[str]
) -> _Case:
    file, run = setting.file, (mode, plan["beta"])
    H = tuple(plan["by_site"][str(bus)] for bus in setting.sites)
    values, asked = parameters_of(file, mode), criteria(file)
    at: dict[tuple[str, str, int], Exposure] = {}
    for period in setting.periods:
        faults = [fault for _, fault in reruns.places]
        for fault, waveforms in reruns.waveforms(H, period, list(dict.fromkeys(faults)), True).items():
            for bus, waveform in (waveforms or {}).items():
                if plan["by_site"][str(bus)] > 0:
                    plain = Waveform(waveform.t, waveform.v, name=waveform.name)
                    at[period, fault, bus] = Exposure(period, fault, plain, setting.d[period])
    tangents = reruns.exact(run, H, values, asked)
    prices: dict[Key, float] = dict.fromkeys(_near(H, tangents), 0.0)
    for item in plan["margins"]:
        site, target = setting.sites.index(item["site"]), TARGETS.index(item["target"])
        if item["price"] > 0:
            prices[item["period"], item["fault"], site, target] = item["price"]
    watched = [
        Priced(setting.sites[i], TARGETS[t], price, at[period, fault, setting.sites[i]])
        for (period, fault, i, t), price in prices.items()
    ]
    given = {**values, "beta": run[1], "pf": file.hosting.pf}
    gradients = [
        margin_gradient(mode, paths, one.exposure, one.target, Criteria(**asked), given) for one in watched
    ]
    buses = [bus for *_, bus in at]
    return _Case(
        setting, run, H, values, asked, list(at.values()), buses, watched, list(prices), gradients, tangents
    )


def _near(H: Sequence[float], tangents: Sequence[Exact]) -> list[Key]:
    """The least margin of every open site and target, where it is near to binding."""
    found: list[Key] = []
    for site, target in itertools.product(np.flatnonzero(H).tolist(), range(len(TARGETS))):
        least = min(tangents, key=lambda one: float(np.nan_to_num(one.value[site, target], nan=np.inf)))
        if least.value[site, target] < NEAR:
            found.append((*least.place, site, target))
    return found


def _row(case: _Case, assumption: Assumption) -> dict[str, Any]:
    sides = {
        side: _end(case, assumption, value)
        for side, value in zip(SIDES, (assumption.low, assumption.high), strict=True)
    }
    return {
        "path": assumption.path,
        "unit": assumption.unit,
        "doc": assumption.doc,
        "source": assumption.source,
        "value": assumption.value,
        "by_unit": case.first_order(assumption.path),
        "sides": sides,
        "stake_mw": max(end["stake_mw"] for end in sides.values()),
    }


def _end(case: _Case, assumption: Assumption, value: float) -> dict[str, Any]:
    """One end of a range: what gradients say, and what runs on the plan's voltages say beside them.

    At stake is what gradients say, or the capacity of the sites that fail in a way that they do not see,
    whichever is more.
    """
    change = value - assumption.value
    by_unit = case.first_order(assumption.path)
    linear = None if by_unit is None else by_unit * change
    bounded = case.by_gradient(assumption.path, change)
    end: dict[str, Any] = {
        "value": value,
        "linear_mw": linear,
        "gradient_mw": bounded,
        "refused": "",
        "unseen": {},
        "stake_mw": abs(bounded or 0.0),
        "rerun_mw": None,
        "rerun_by_site": {},
        "rerun_settled": None,
    }
    if change == 0.0:
        return end
    try:
        trial = case.trial(*case.varied(assumption, value))
    except InputError as error:
        return end | {"refused": first_sentence(str(error)), "stake_mw": 0.0}
    if not any(trial.sequence):
        return end | {"refused": f"no run has a result: {first_sentence(trial.status[0])}", "stake_mw": 0.0}
    unseen = _unseen(case, trial, assumption.path)
    end["unseen"] = {str(bus): why for bus, why in unseen.items()}
    end["stake_mw"] = max(end["stake_mw"], sum(map(case.by_site, unseen)))
    return end


def _unseen(case: _Case, trial: Trial, path: str) -> dict[int, str]:
    """Sites that fail in a way that gradients do not tell: by other events, or at a margin whose gradient was
    not asked for."""
    held = {(id(one.exposure), one.target) for one in case.watched}
    if path in LEVELS and case.watched:
        held |= {(id(exposure), LEVELS[path][0]) for exposure in case.exposures}
    found: dict[int, str] = {}
    for k, (exposure, bus) in enumerate(zip(case.exposures, case.buses, strict=True)):
        if trial.met[k] or bus in found:
            continue
        short = [name for t, name in enumerate(TARGETS) if not trial.margin[k, t] >= 0]
        same_events = trial.sequence[k] == case.base.sequence[k]
        if not (same_events and all((id(exposure), name) in held for name in short)):
            found[bus] = f"fault {exposure.fault}, {exposure.period}: {_why(case.base, trial, k)}"
    return found


def _why(base: Trial, trial: Trial, k: int) -> str:
    if not trial.sequence[k]:
        return first_sentence(trial.status[k])
    t = int(np.nanargmin(trial.margin[k]))
    said = f"{TARGETS[t]} margin {trial.margin[k, t]:+.3f}"
    if trial.sequence[k] == base.sequence[k]:
        return f"{said}, which was not near"
    before, after = (">".join(replay.modes_passed(one.sequence[k])) for one in (base, trial))
    return f"{said}, by other events: {before} becomes {after}"
