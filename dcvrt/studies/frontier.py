"""The frontier of a study: searched with the engine of the samples, replayed with that of the plans."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dcvrt.planning import replay
from dcvrt.planning.exact import Exact, Run, exact_of
from dcvrt.planning.frontier import Known, frontiers
from dcvrt.planning.mechanism import mechanism
from dcvrt.planning.requirement import EverySite, Requirement
from dcvrt.planning.sampling import sample_hosting
from dcvrt.planning.search import Ask, Found, Options
from dcvrt.studies import plans, simulations, system_limit
from dcvrt.studies.campaign import Campaign
from dcvrt.studies.setting import Setting
from dcvrt.studies.simulations import CANDIDATES, FRONTIER, Job
from dcvrt.studies.store import DETAILS, Store, records

METHOD = "frontier"
"""Method of the plans that the frontier finds."""


def run_frontier(campaign: Campaign, setting: Setting, progress: Any) -> list[str]:
    """Search the frontier of every mode and rating, then under every system limit, and write the plans;
    messages of what was set aside.

    The search is made again when anything that it was made from has changed since; what it has simulated
    before is read from the store. System limits come last: they change nothing of the other plans.
    """
    if not setting.file.frontier.search:
        return []
    store = campaign.store
    if store.provenance().get("frontier_from") == _state(store, setting):
        return []
    asked, known = _Campaign(campaign, setting), Known()
    f = setting.file.frontier

    def search(wanted: Sequence[tuple[Run, Requirement]], title: str) -> list[Found]:
        return frontiers(
            setting.problem,
            wanted,
            setting.problem.upper,
            coarse_samples(setting),
            [(period, label) for period in setting.periods for label in asked.labels],
            asked.simulate,
            asked.replay,
            Options(gain=f.gain, trust=f.trust, candidates=f.candidates),
            lambda ended, total: progress(title, ended, total, 0),
            known,
        )

    found = search([(run, EverySite(setting.sites)) for run in setting.runs], "searches")
    limits = system_limit.wanted(setting)
    asked.roles = system_limit.ROLES
    within = search(limits, "system limits") if limits else []
    rows = [_plan_row(setting, one) for one in found]
    limited = [
        system_limit.plan_row(setting, limit, one) for (_, limit), one in zip(limits, within, strict=True)
    ]
    checked: dict[str, dict[str, Any]] = {}
    for row, one in zip([*rows, *limited], [*found, *within], strict=True):
        if row["hosting"] not in checked:
            checked[row["hosting"]] = plans.power_flow(setting.problem, one.plan)
        row |= checked[row["hosting"]]
    with store.transaction():
        store.put("hostings", [plans.plan_hosting(row) for row in rows])
        store.put("plans", rows)
        store.clear("system_plans")
        store.put("system_plans", limited)
        store.note(frontier_from=_state(store, setting))
    # All of them were replayed in the search; sensitivities may begin while other methods make their plans.
    found_plans = [plan for plan in records(store.plans()) if plan["method"] == METHOD]
    simulations.write_verdicts(store, setting, found_plans)
    return asked.lost


def coarse_samples(setting: Setting) -> Any:
    """The plan without ride-through first, next to nothing second, then a space-filling sequence between
    them."""
    corner = [setting.no_vrt.by_site[bus] for bus in setting.sites]
    n = setting.file.frontier.samples
    return sample_hosting(corner, max(n, 4), setting.file.study.seed, high_share=0.0).hosting[:n]


def run_mechanisms(store: Store, setting: Setting) -> None:
    """Find out what is active at the margins that bind the plans of the frontier, from their replayed
    voltages."""
    for plan in records(store.plans()):
        margins = plan["search"].get("margins", [])
        if plan["method"] != METHOD or not margins:
            continue
        told = [item | {"mechanism": _mechanism(store, setting, plan, item)} for item in margins]
        with store.transaction():
            store.put("plans", [plan | {"search": plan["search"] | {"margins": told}}])


def _mechanism(store: Store, setting: Setting, plan: Mapping[str, Any], item: Mapping[str, Any]) -> str:
    place = {name: item[name] for name in ("period", "fault", "site")}
    waveform = store.voltage(plan["hosting"], **place)
    if waveform is None:
        return "not known: the replay has no waveform"
    file, mode, target = setting.file, plan["mode"], item["target"]
    simulator = replay.simulator_of(
        mode, file.facility.parameters | file.facility.parameters_by_mode.get(mode, {})
    )
    run = simulator.attempt(
        waveform, H=1.0, beta=plan["beta"], d=setting.d[item["period"]], pf=file.hosting.pf
    )
    margins = store.margins(hosting=plan["hosting"])
    here = margins[
        (margins["mode"] == mode)
        & (margins.beta == plan["beta"])
        & np.logical_and.reduce([margins[name] == value for name, value in place.items()])
    ]
    if not run.completed or here.empty or not here.ok.iloc[0]:
        return "not known: the run has no result"
    window = 1e-3 * (file.criteria.loss_window_ms if target == "loss" else file.criteria.window_ms)
    modes = next((a.modes for a in simulator.dae.automata if a.path in replay.MAIN), ())
    return mechanism(run, modes, target, here.diagnostics.iloc[0][f"{target}_time"], window)


def _state(store: Store, setting: Setting) -> str:
    """Digest of what the frontiers are made from: tasks with their states, and limits; and of their plans."""
    tasks = [(t["hash"], t["status"]) for t in records(store.tasks()) if t["phase"] in (FRONTIER, CANDIDATES)]
    found = [p["hosting"] for p in records(store.plans()) if p["method"] == METHOD]
    limits = setting.file.system_limit.model_dump()
    limited = [p["hosting"] for p in records(store.system_plans())]
    return hashlib.sha256(json.dumps([sorted(tasks), found, limits, limited]).encode()).hexdigest()


def _plan_row(setting: Setting, found: Found) -> dict[str, Any]:
    row = plans.plan_row(setting, METHOD, found.mode, found.beta, found.plan, found.closed, None)
    return row | {"search": system_limit.told(found)}


class _Campaign:
    """Answers the questions of the searches by tasks of a campaign.

    Attributes
    ----------
    roles : of the hosting vectors that are searched, and of those that are replayed.
    """

    def __init__(self, campaign: Campaign, setting: Setting) -> None:
        self.campaign, self.setting = campaign, setting
        self.labels = [replay.fault_label(fault.model_dump()) for fault in setting.file.fault]
        self.lost: list[str] = []
        self.roles = ("search", "candidate")

    def simulate(self, questions: Sequence[tuple[Ask, Sequence[Run]]]) -> list[Mapping[Run, Sequence[Exact]]]:
        setting, store = self.setting, self.campaign.store
        engine = setting.file.grid.engine
        jobs = []
        for ask, runs in questions:
            self._enter(ask, "f", self.roles[0])
            for period in setting.periods:
                faults = [fault for p, fault in ask.places or () if p == period]
                if faults:
                    request = setting.request(
                        ask.H,
                        period,
                        runs,
                        engine=engine,
                        gradients=True,
                        faults=faults,
                        closed=setting.closed,
                    )
                    jobs.append(Job(self._name(ask, "f"), request))
        self.lost += simulations.simulate(self.campaign, FRONTIER, jobs)
        answers: list[Mapping[Run, Sequence[Exact]]] = []
        for ask, runs in questions:
            rows = records(store.margins(hosting=self._name(ask, "f")))
            wanted = {(*run, *place) for run in runs for place in ask.places or ()}
            here = [r for r in rows if (r["mode"], r["beta"], r["period"], r["fault"]) in wanted]
            answers.append(exact_of(here, setting.sites, ask.H))
        return answers

    def replay(self, questions: Sequence[tuple[Ask, Sequence[Run]]]) -> list[Mapping[Run, Sequence[Exact]]]:
        store = self.campaign.store
        for ask, _ in questions:
            self._enter(ask, "p", self.roles[1])
        plans = [(self._name(ask, "p"), ask.H, list(runs)) for ask, runs in questions]
        self.lost += simulations.simulate(
            self.campaign, CANDIDATES, simulations.replay_jobs(self.setting, plans)
        )
        return [
            exact_of(
                [row for row in records(replayed) if (row["mode"], row["beta"]) in runs],
                self.setting.sites,
                H,
            )
            for name, H, runs in plans
            for replayed in [store.margins(hosting=name, leave=DETAILS)]
        ]

    def _by_site(self, ask: Ask) -> dict[str, float]:
        return dict(zip(map(str, self.setting.sites), ask.H, strict=True))

    def _name(self, ask: Ask, kind: str) -> str:
        return kind + plans.plan_name(self._by_site(ask))[1:]

    def _enter(self, ask: Ask, kind: str, role: str) -> None:
        """Enter a hosting vector, unless a plan has entered it."""
        store, name = self.campaign.store, self._name(ask, kind)
        if name not in set(store.hostings().name):
            by_site = {int(bus): mw for bus, mw in self._by_site(ask).items()}
            store.put("hostings", [simulations.hosting_row(name, role, "", by_site)])
