"""The simulations of a study (paper: Algorithm 1): samples and replays, as tasks of a campaign; verdicts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from dcvrt.planning import coupling, replay
from dcvrt.planning.exact import exact_of
from dcvrt.planning.requirement import SystemLimit
from dcvrt.planning.verdict import limit_verdict, verdict
from dcvrt.studies.campaign import Campaign, Task
from dcvrt.studies.setting import NO_VRT, REACTIVE, Setting
from dcvrt.studies.store import DETAILS, Store, records

SAMPLES, FRONTIER, CANDIDATES, REPLAYS = "samples", "frontier", "candidates", "replays"
"""What is simulated: samples of the fits; points of the frontier's search; its candidates, by the engine of
the replay; plans of the other methods."""
PLAN = ["hosting", "mode", "beta"]
"""Columns that name a plan whose runs are judged together."""


def run_samples(campaign: Campaign, setting: Setting) -> list[str]:
    """Simulate every sample in every period, for all modes and ratings; messages of what was set aside."""
    samples, store = setting.samples(), campaign.store
    with store.transaction():
        store.put(
            "hostings",
            [
                hosting_row(
                    f"s{k:04}",
                    "sample",
                    "fit" if samples.fit[k] else "validation",
                    dict(zip(setting.sites, H, strict=True)),
                )
                for k, H in enumerate(samples.hosting.tolist())
            ],
        )
        store.note(sampled_box_mw=dict(zip(map(str, setting.sites), samples.upper.tolist(), strict=True)))
    return simulate(campaign, SAMPLES, sample_jobs(setting))


def sample_jobs(setting: Setting) -> list[Job]:
    """What is simulated of the samples."""
    engine, gradients = setting.file.grid.engine, setting.file.sampling.gradients
    return [
        Job(
            f"s{k:04}",
            setting.request(
                H, period, setting.runs, engine=engine, gradients=gradients, closed=setting.closed
            ),
        )
        for period in setting.periods
        for k, H in enumerate(setting.samples().hosting.tolist())
    ]


def samples_ahead(campaign: Campaign, setting: Setting) -> None:
    """Let idle workers simulate samples before their phase."""
    tasks = [Task(SAMPLES, job.request) for job in sample_jobs(setting)]
    campaign.ahead(SAMPLES, tasks, coupling.check_hosting)


def run_replays(campaign: Campaign, setting: Setting) -> list[str]:
    """Simulate every plan that hosts anything, each hosting vector once; then write the verdicts."""
    store = campaign.store
    plans = [p for p in records(store.plans()) if p["method"] != NO_VRT]
    limited = records(store.system_plans())
    wanted = {plan["hosting"]: _hosted(plan, setting) for plan in [*plans, *limited] if plan["total_mw"] > 0}
    jobs = replay_jobs(setting, [(name, H, setting.runs) for name, H in wanted.items()])
    of_search = store.task_states(CANDIDATES)  # candidates are replayed for every mode and rating, too
    lost = simulate(campaign, REPLAYS, [j for j in jobs if Task(CANDIDATES, j.request).key not in of_search])
    write_verdicts(store, setting, plans, limited)
    return lost


def write_verdicts(
    store: Store,
    setting: Setting,
    plans: Sequence[Mapping[str, Any]],
    limited: Sequence[Mapping[str, Any]] = (),
) -> None:
    """Judge plans, and such under system limits, by their replays."""
    names = list({plan["hosting"] for plan in [*plans, *limited]})
    replayed = store.margins(hosting=names, leave=DETAILS)
    runs_of = {key: records(rows) for key, rows in replayed.groupby(PLAN)}
    places = len(setting.periods) * len(setting.file.fault)
    with store.transaction():
        for plan in plans:
            rows = runs_of.get((plan["hosting"], plan["mode"], plan["beta"]), [])
            by_site = {int(bus): mw for bus, mw in plan["by_site"].items()}
            found = verdict(rows, by_site, sum(mw > 0 for mw in by_site.values()) * places)
            of_power_flow = {key: value for key, value in plan["worst"].items() if key == REACTIVE}
            found["worst"] = found["worst"] | of_power_flow
            store.put("plans", [{**plan, **found, "replayed": 1}])
        for plan in limited:
            rows = runs_of.get((plan["hosting"], plan["mode"], plan["beta"]), [])
            limit = SystemLimit(setting.sites, setting.d, plan["limit_mw"], plan["limit_share"])
            exact = exact_of(rows, setting.sites, _hosted(plan, setting))
            ran = exact.get((plan["mode"], plan["beta"]), [])
            found = limit_verdict(ran, limit, places if plan["total_mw"] > 0 else 0)
            store.put("system_plans", [{**plan, **found, "replayed": 1}])


def _hosted(plan: Mapping[str, Any], setting: Setting) -> list[float]:
    """Capacities of a plan in the order of the sites."""
    return [plan["by_site"][str(bus)] for bus in setting.sites]


@dataclass(frozen=True)
class Job:
    """One hosting vector in one period: the name under which its results are stored, and the request."""

    name: str
    request: dict[str, Any]


def replay_jobs(
    setting: Setting, plans: Sequence[tuple[str, Sequence[float], Sequence[tuple[str, float]]]]
) -> list[Job]:
    """What is simulated for the replay of hosting vectors."""
    engine = setting.file.replay.engine
    return [
        Job(name, setting.request(H, period, runs, engine=engine, keep=True))
        for period in setting.periods
        for name, H, runs in plans
    ]


def simulate(campaign: Campaign, phase: str, jobs: Sequence[Job]) -> list[str]:
    """One task for each job; what has been done before is not done again."""
    store = campaign.store
    names: dict[str, str] = {}
    tasks = []
    for job in jobs:
        task = Task(phase, job.request)
        names[task.key] = job.name
        tasks.append(task)

    def record(task: Task, answer: Mapping[str, Any]) -> None:
        hosting = names[task.key]
        store.put("margins", [{"hosting": hosting, **row} for row in answer["rows"]])
        for waveform in answer["waveforms"]:
            store.put_waveform(hosting=hosting, **waveform)

    def record_lost(task: Task, reason: str) -> None:
        rows = replay.lost_rows(task.payload, reason, "task")
        store.put("margins", [{"hosting": names[task.key], **row} for row in rows])

    return campaign.run(phase, tasks, coupling.check_hosting, record, record_lost)


def hosting_row(name: str, role: str, subset: str, by_site: Mapping[int, float]) -> dict[str, Any]:
    """A row of `hostings`."""
    return {
        "name": name,
        "role": role,
        "subset": subset,
        "total_mw": float(sum(by_site.values())),
        "by_site": {str(bus): float(mw) for bus, mw in by_site.items()},
    }
