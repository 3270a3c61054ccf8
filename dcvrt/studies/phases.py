"""The phases of a study (paper: Algorithm 1): samples, fits, plans, replays. Each reads and writes the store
only."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from dcvrt.errors import DcvrtError, InputError
from dcvrt.planning import coupling, replay
from dcvrt.planning.exact import exact_of
from dcvrt.planning.hosting import HostingProblem
from dcvrt.planning.kept import one_sided, side_by_side
from dcvrt.planning.plan import Plan
from dcvrt.planning.requirement import SystemLimit
from dcvrt.planning.sampling import Samples, sample_hosting
from dcvrt.planning.surrogate import TARGETS, MarginData, Surrogate, fit_surrogates
from dcvrt.planning.sweep import sweep
from dcvrt.studies import checks
from dcvrt.studies.campaign import Campaign, Task
from dcvrt.studies.config import StudyFile
from dcvrt.studies.store import Store, records

Floats = npt.NDArray[np.float64]

SAMPLES, FRONTIER, CANDIDATES, REPLAYS = "samples", "frontier", "candidates", "replays"
"""What is simulated: samples of the fits; points of the frontier's search; its candidates, by the engine of
the replay; plans of the other methods."""
NO_VRT = "none"
"""Method of the plan without ride-through."""
REACTIVE = "reactive"
"""Entry of a plan's `worst` that the power flow writes: units beyond their reactive limits."""


@dataclass(frozen=True, eq=False)
class Setting:
    """What all phases share: the study, the hosting programme, the periods and the plan without ride-through.

    Attributes
    ----------
    file : the study file.
    folder : what relative paths in it start from.
    problem : hosting programme; its cuts are kept from one solve to the next.
    periods : {name: {name, hour, load_scale, wind, dc_factor}}.
    """

    file: StudyFile
    folder: Path
    problem: HostingProblem
    periods: dict[str, dict[str, Any]]

    @cached_property
    def no_vrt(self) -> Plan:
        """The plan without ride-through."""
        return self.problem.solve()

    @property
    def sites(self) -> tuple[int, ...]:
        """Candidate buses."""
        return self.problem.sites

    @property
    def d(self) -> dict[str, float]:
        """Data-centre factor by period."""
        return {name: period["dc_factor"] for name, period in self.periods.items()}

    def samples(self) -> Samples:
        """The sampled hosting vectors."""
        s = self.file.sampling
        corner = s.h_max_mw or [self.no_vrt.by_site[bus] for bus in self.sites]
        return sample_hosting(
            corner,
            s.n,
            self.file.study.seed,
            high_share=s.high_share,
            high_from=s.high_from,
            validation_share=s.validation_share,
        )

    def request(
        self,
        hosting: Sequence[float],
        period: str,
        runs: Sequence[tuple[str, float]],
        *,
        engine: str,
        gradients: bool = False,
        keep: bool = False,
        faults: Collection[str] | None = None,
        closed: bool = False,
    ) -> dict[str, Any]:
        """The request of `dcvrt.planning.replay.check_hosting` for one hosting vector and period; of some
        faults only, when their labels are given; `closed` puts the facilities into the network."""
        grid, f = self.file.grid, self.file.facility
        path = grid.case if grid.case == "ieee118" else str((self.folder / grid.case).resolve())
        dynamics = None if grid.dynamics is None else str((self.folder / grid.dynamics).resolve())
        return {
            "case": path,
            "dynamics": dynamics,
            "sites": list(self.sites),
            "pf": self.file.hosting.pf,
            "redispatch": grid.redispatch,
            "reactive_limits": self.file.hosting.reactive_limits,
            "step_s": grid.step_s,
            "t_end_s": grid.t_end_s,
            "hosting": [float(mw) for mw in hosting],
            "period": self.periods[period],
            "faults": [
                entry
                for fault in self.file.fault
                for entry in [fault.model_dump()]
                if faults is None or replay.fault_label(entry) in faults
            ],
            "runs": [list(run) for run in runs],
            "parameters": {mode: f.parameters | f.parameters_by_mode.get(mode, {}) for mode, _ in runs},
            "criteria": criteria(self.file),
            "engine": engine,
            "gradients": gradients,
            "keep": keep,
            "coupling": "closed" if closed else "open",
        }

    @property
    def closed(self) -> bool:
        """Whether samples and searches simulate the facilities in the network."""
        return self.file.grid.coupling == "closed"

    @property
    def runs(self) -> list[tuple[str, float]]:
        """Every mode at every rating."""
        return [(mode, beta) for mode in self.file.facility.modes for beta in self.file.facility.beta]


def setting_of(file: StudyFile, folder: Path) -> Setting:
    """Hosting programme and periods of a study whose relative paths start from a folder."""
    network, problems = checks.read_network(file.grid, folder)
    if network is None:
        raise InputError("; ".join(problems))
    h = file.hosting
    year = checks.profiles_of(h, folder)
    problem = HostingProblem(
        network,
        tuple(file.grid.sites),
        year,
        rating_scale=h.rating_scale,
        voltage=(h.v_min_pu, h.v_max_pu),
        pf=h.pf,
        reactive_limits=h.reactive_limits,
    )
    chosen = year.representative(network)
    periods = {}
    for entry in file.period:
        hour = year.at(chosen[entry.hour] if isinstance(entry.hour, str) else entry.hour)
        periods[entry.name] = {
            "name": entry.name,
            "hour": hour.hour,
            "load_scale": hour.load,
            "dc_factor": hour.dc,
            "wind": {str(bus): mw for bus, mw in hour.wind.items()},
        }
    return Setting(file, folder, problem, periods)


def criteria(file: StudyFile) -> dict[str, Any]:
    """Keywords of `Criteria`."""
    c = file.criteria
    return {
        "v_it_min": c.v_it_min_pu,
        "window": 1e-3 * c.window_ms,
        "loss_share": c.loss_share,
        "loss_window": 1e-3 * c.loss_window_ms,
        "criterion": c.voltage_criterion,
    }


# -- simulation campaigns ------------------------------------------------------------------------------------


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
    engine, gradients = setting.file.grid.engine, setting.file.sampling.gradients
    jobs = [
        Job(
            f"s{k:04}",
            setting.request(
                H, period, setting.runs, engine=engine, gradients=gradients, closed=setting.closed
            ),
        )
        for period in setting.periods
        for k, H in enumerate(samples.hosting.tolist())
    ]
    return simulate(campaign, SAMPLES, jobs)


def run_replays(campaign: Campaign, setting: Setting) -> list[str]:
    """Simulate every plan that hosts anything, each hosting vector once; then write the verdicts."""
    store = campaign.store
    plans = [p for p in records(store.plans()) if p["method"] != NO_VRT]
    limited = records(store.system_plans())
    wanted: dict[str, tuple[list[float], set[tuple[str, float]]]] = {}
    for plan in [*plans, *limited]:
        if plan["total_mw"] > 0:
            wanted.setdefault(plan["hosting"], (_hosted(plan, setting), set()))[1].add(
                (plan["mode"], plan["beta"])
            )
    keys = ["hosting", "mode", "beta"]
    made = {tuple(key) for key in store.margins(hosting=list(wanted))[keys].itertuples(index=False)}
    lost = replay_plans(
        campaign,
        setting,
        REPLAYS,
        [
            (name, H, missing)
            for name, (H, runs) in wanted.items()
            if (missing := sorted(run for run in runs if (name, *run) not in made))
        ],
    )
    runs_of = {key: records(rows) for key, rows in store.margins(hosting=list(wanted)).groupby(keys)}
    places = len(setting.periods) * len(setting.file.fault)
    with store.transaction():
        for plan in plans:
            rows = runs_of.get((plan["hosting"], plan["mode"], plan["beta"]), [])
            by_site = {int(bus): mw for bus, mw in plan["by_site"].items()}
            found = replay.verdict(rows, by_site, sum(mw > 0 for mw in by_site.values()) * places)
            of_power_flow = {key: value for key, value in plan["worst"].items() if key == REACTIVE}
            found["worst"] = found["worst"] | of_power_flow
            store.put("plans", [plan | found | {"replayed": 1}])
        for plan in limited:
            rows = runs_of.get((plan["hosting"], plan["mode"], plan["beta"]), [])
            limit = SystemLimit(setting.sites, setting.d, plan["limit_mw"], plan["limit_share"])
            exact = exact_of(rows, setting.sites, _hosted(plan, setting))
            replayed = exact.get((plan["mode"], plan["beta"]), [])
            found = replay.limit_verdict(replayed, limit, places if plan["total_mw"] > 0 else 0)
            store.put("system_plans", [plan | found | {"replayed": 1}])
    return lost


def _hosted(plan: Mapping[str, Any], setting: Setting) -> list[float]:
    """Capacities of a plan in the order of the sites."""
    return [plan["by_site"][str(bus)] for bus in setting.sites]


@dataclass(frozen=True)
class Job:
    """One hosting vector in one period: the name under which its results are stored, and the request."""

    name: str
    request: dict[str, Any]


def replay_plans(
    campaign: Campaign,
    setting: Setting,
    phase: str,
    plans: Sequence[tuple[str, Sequence[float], Sequence[tuple[str, float]]]],
) -> list[str]:
    """Replay hosting vectors, (name, capacities, modes and ratings), in every period under every fault."""
    engine = setting.file.replay.engine
    jobs = [
        Job(name, setting.request(H, period, runs, engine=engine, keep=True))
        for period in setting.periods
        for name, H, runs in plans
    ]
    return simulate(campaign, phase, jobs)


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


# -- fits ----------------------------------------------------------------------------------------------------


def margin_data(store: Store, sites: Sequence[int], d: Mapping[str, float]) -> tuple[MarginData, Floats]:
    """The checked runs of the samples as arrays, and the derivatives of voltage margin and loss share by
    every site's capacity, (runs, 2, sites), NaN where they were not asked for."""
    frame = store.margins("sample")
    if frame.empty:
        raise InputError(f"{store.path}: holds no sampled runs. Way out: run the study first.")
    slopes = np.full((len(frame), 2, len(sites)), np.nan)
    for k, gradients in enumerate(frame.gradients):
        if gradients:
            slopes[k] = [[gradients[target][f"H_{bus}"] for bus in sites] for target in TARGETS]
    samples = store.hostings().set_index("name")
    vectors = {name: [by_site[str(bus)] for bus in sites] for name, by_site in samples.by_site.items()}
    return MarginData(
        sites=tuple(sites),
        hosting=np.array([vectors[name] for name in frame.hosting]),
        d=np.array([d[name] for name in frame.period]),
        period=frame.period.to_numpy(dtype=str),
        fault=frame.fault.to_numpy(dtype=str),
        mode=frame["mode"].to_numpy(dtype=str),
        site=frame.site.to_numpy(dtype=np.int64),
        beta=frame.beta.to_numpy(dtype=float),
        voltage=frame.v_margin_pu.to_numpy(dtype=float),
        loss_share=frame.loss_margin_share.to_numpy(dtype=float),
        loss_mw=frame.loss_margin_mw.to_numpy(dtype=float),
        ok=frame.ok.to_numpy(dtype=bool),
        status=frame.status.to_numpy(dtype=str),
        sequence=frame.sequence.to_numpy(dtype=str),
        fit=(samples.subset[frame.hosting] == "fit").to_numpy(dtype=bool),
        name=frame.hosting.to_numpy(dtype=str),
    ), slopes


def run_fits(store: Store, setting: Setting) -> list[Surrogate]:
    """Fit every method to the samples and write surrogates and validation points."""
    data, slopes = margin_data(store, setting.sites, setting.d)
    fits = [fit for method in setting.file.surrogate.methods for fit in fit_surrogates(data, method)]
    with store.transaction():
        store.clear("surrogates", "predictions")
        store.note(one_sided=one_sided(data))
        judge_forms(store, data, slopes if setting.file.sampling.gradients else None)
        for fit in fits:
            key = {
                name: getattr(fit, name)
                for name in ("method", "mode", "site", "fault", "target", "period", "beta")
            }
            scores = {k: value for k, value in asdict(fit.scores).items() if k not in ("n", "n_failed")}
            store.put(
                "surrogates",
                [
                    key
                    | scores
                    | {
                        "intercept": fit.intercept,
                        "slopes": dict(zip(map(str, setting.sites), fit.slopes.tolist(), strict=True)),
                        "rating_slope": fit.rating_slope,
                        "tightening": fit.tightening,
                        "unknown": [[*place, why] for place, why in fit.unknown.items()],
                        "n_fit": fit.n_fit,
                        "n_validation": fit.scores.n,
                        "n_validation_failed": fit.scores.n_failed,
                        "n_excluded": fit.n_excluded,
                        "n_mixed": fit.n_mixed,
                        "n_sequences": fit.n_sequences,
                    }
                ],
            )
            names, margins, predicted = fit.validation
            # Pooled fits hold a hosting vector several times: number the points within each.
            store.put(
                "predictions",
                [
                    key | {"hosting": str(name), "point": k, "margin": float(m), "predicted": float(p)}
                    for k, (name, m, p) in enumerate(zip(names, margins, predicted, strict=True))
                ],
            )
    return fits


def judge_forms(store: Store, data: MarginData, slopes: Floats | None) -> None:
    """Note how much of what is feasible each form of the margins keeps, unless it stands there already."""
    made_from = hashlib.sha256(data.voltage.tobytes() + data.loss_share.tobytes()).hexdigest()
    if store.provenance().get("forms_from") != made_from and not data.fit.all():
        store.note(forms_from=made_from, forms=[asdict(found) for found in side_by_side(data, slopes)])


# -- plans ---------------------------------------------------------------------------------------------------


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
    binding = [
        asdict(b)
        | ({"label": f"sampled box at site {b.bus}"} if b.kind == "bound" and method != NO_VRT else {})
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


def hosting_row(name: str, role: str, subset: str, by_site: Mapping[int, float]) -> dict[str, Any]:
    """A row of `hostings`."""
    return {
        "name": name,
        "role": role,
        "subset": subset,
        "total_mw": float(sum(by_site.values())),
        "by_site": {str(bus): float(mw) for bus, mw in by_site.items()},
    }
