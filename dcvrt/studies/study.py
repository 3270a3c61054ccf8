"""A study: one file in, one folder out. Running it again resumes."""

from __future__ import annotations

import json
import platform
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import dcvrt
from dcvrt.errors import InputError
from dcvrt.studies import (
    checks,
    config,
    coupling,
    fits,
    frontier,
    outputs,
    plans,
    sensitivity,
    simulations,
    system_limit,
)
from dcvrt.studies.campaign import LOST, Campaign, crew_of
from dcvrt.studies.config import StudyFile
from dcvrt.studies.progress import Silent
from dcvrt.studies.setting import NO_VRT, Setting, criteria, setting_of
from dcvrt.studies.store import Store, records

if TYPE_CHECKING:
    import pandas as pd

    from dcvrt.dae import ParameterTable

PACKAGES = ("numpy", "scipy", "casadi", "andes", "highspy", "distributed", "pandas", "pydantic")
DECIDING = ("dcvrt", "numpy", "scipy", "casadi", "andes", "highspy")
"""Packages whose version may change a number: one folder is never made with two versions of them."""


@dataclass(frozen=True)
class Study:
    """A checked study file.

    Attributes
    ----------
    file : the study.
    text : the file as it was read; copied into the folder.
    folder : what relative paths in it start from.
    name : stem of the file, which names the default output folder.
    """

    file: StudyFile
    text: str
    folder: Path
    name: str

    @classmethod
    def load(cls, path: str | Path | None = None) -> Study:
        """Read and check a study file; without a path, the IEEE-118 study.

        Raises
        ------
        InputError
            With every mistake in the file.
        """
        if path is None:
            return cls(
                checks.check(config.template(), "the IEEE-118 study", Path.cwd()),
                config.template(),
                Path.cwd(),
                "ieee118",
            )
        path = Path(path)
        text = config.read_text(path)
        return cls(checks.check(text, str(path), path.parent), text, path.resolve().parent, path.stem)

    def run(
        self,
        out: str | Path | None = None,
        workers: int = 1,
        scheduler: str | None = None,
        quick: bool = False,
        retry: bool = False,
        reporter: Silent | None = None,
    ) -> Result:
        """Do what the folder does not have yet, and write the results.

        Parameters
        ----------
        out : folder; default "NAME-results" or "NAME-quick" here. A folder of the same study is resumed.
        workers : processes on this machine.
        scheduler : address of a dask scheduler to use instead.
        quick : fewer samples, periods, ratings and reruns, for a look at the whole chain.
        retry : do once more what was set aside.
        reporter : shows progress.

        Returns
        -------
        Result

        Raises
        ------
        InputError
            When the folder cannot be written, holds another study, or was made with other versions; when
            the compiler fails or no scheduler answers, and then no folder is made.
        InfeasibleError
            When the network cannot serve its own load; nothing is written then.
        """
        begin = time.monotonic()
        file = self.file.quick() if quick else self.file
        folder = Path(out) if out is not None else Path(f"{self.name}-{'quick' if quick else 'results'}")
        reporter = reporter or Silent()
        crew = crew_of(workers, scheduler)  # before any work: a wrong number of workers is bad input
        outputs.refuse_unusable(folder)
        reporter.say(f"{file.study.name}{' (quick)' if quick else ''}: into {folder}")
        if (folder / outputs.STORE).is_file():
            with Store(folder / outputs.STORE) as store:
                refuse_another_study(store, file, folder)
        setting = self.setting(file)
        reporter.say(f"without ride-through: {setting.no_vrt.total_mw:.2f} MW")
        backends = prepare(file, setting)
        for mode, backend in backends.items():
            reporter.say(f"{mode}: {backend}")
        with crew as hands:  # all that may be refused has been: from here on the folder belongs to this study
            folder.mkdir(parents=True, exist_ok=True)
            with Store(folder / outputs.STORE, write=True) as store, reporter:
                refuse_another_study(store, file, folder)
                self._note(store, file, setting, quick)
                store.note(backends=backends)
                outputs.write_atomically(folder / outputs.STUDY, self.text)
                if retry and store.reopen(*LOST):
                    (folder / outputs.SUMMARY).unlink(missing_ok=True)
                campaign = Campaign(store, hands, file.run.task_timeout_s, file.run.tries, reporter)
                try:
                    # First, so that its hosting programme has no past: cuts kept from other solves move its
                    # optimum by 1e-4 MW, and a run that is gone on with would ask for other simulations.
                    simulations.samples_ahead(campaign, setting)
                    lost = frontier.run_frontier(campaign, setting, reporter)
                    frontier.run_mechanisms(store, setting)
                    sensitivity.sensitivity_ahead(campaign, setting)
                    lost += simulations.run_samples(campaign, setting)
                    surrogates = fits.run_fits(store, setting)
                    plans.run_plans(store, setting, surrogates, reporter)
                    lost += simulations.run_replays(campaign, setting)
                    system_limit.write_front(store, setting)
                    lost += coupling.run_coupling(campaign, setting)
                    lost += sensitivity.run_sensitivity(campaign, setting, reporter)
                finally:
                    store.note(wall_s=store.provenance().get("wall_s", 0.0) + time.monotonic() - begin)
        result = Result(folder, lost)
        result.report()
        return result

    def setting(self, file: StudyFile | None = None) -> Setting:
        """Hosting programme and periods of the study, or of a variation of its file."""
        return setting_of(self.file if file is None else file, self.folder)

    def _note(self, store: Store, file: StudyFile, setting: Setting, quick: bool) -> None:
        """Write down what the study is and what it is made with."""
        parameters = {
            mode: file.facility.parameters | file.facility.parameters_by_mode.get(mode, {})
            for mode in file.facility.modes
        }
        with store.transaction():
            store.note(
                study=file.canonical(),
                study_name=file.study.name,
                study_text=self.text,
                quick=quick,
                versions=versions(),
                platform=platform.platform(),
                engine=file.replay.engine,
                sampling_engine=file.grid.engine,
                seed=file.study.seed,
                periods=setting.periods,
                criteria=criteria(file),
                sites=list(setting.sites),
                sources=dict(setting.problem.year.sources),
                network=setting.problem.network.name,
                faults=[fault.model_dump() for fault in file.fault],
                facilities={
                    mode: [
                        {
                            "path": row.path,
                            "value": row.value,
                            "unit": row.unit,
                            "doc": row.doc,
                            "source": row.source,
                        }
                        for row in _facility(mode, parameters[mode])
                        if row.path not in checks.SHARED  # each run has those of its place in the study
                    ]
                    for mode in file.facility.modes
                },
                parameters=parameters,
            )


@dataclass(frozen=True)
class Result:
    """A study folder.

    Attributes
    ----------
    folder : where everything is.
    lost : the tasks that were set aside, one line each.
    """

    folder: Path
    lost: list[str] = field(default_factory=list)

    @classmethod
    def of(cls, folder: str | Path) -> Result:
        """The result in a study folder.

        Raises
        ------
        InputError
            When the folder holds no finished study.
        """
        folder = Path(folder)
        with Store(folder / outputs.STORE) as store:
            plans, tasks = records(store.plans()), records(store.tasks())
        unfinished = not plans or any(not p["replayed"] for p in plans if p["method"] != NO_VRT)
        if unfinished:
            raise InputError(
                f"{folder}: the study is not finished. Way out: the same 'dcvrt study run' resumes it."
            )
        away = [task for task in tasks if task["status"] in LOST]
        return cls(
            folder, [f"{t['phase']} task {t['hash'][:12]}: {t['status']}: {t['message']}" for t in away]
        )

    @property
    def complete(self) -> bool:
        """Whether no task was set aside."""
        return not self.lost

    @property
    def summary(self) -> dict[str, Any]:
        """What `summary.json` says."""
        found: dict[str, Any] = json.loads((self.folder / outputs.SUMMARY).read_text(encoding="utf-8"))
        return found

    def closed(self) -> list[str]:
        """Why sites are closed at the highest rating of each mode, by the last method of the study."""
        rows = self.summary["rows"]
        last: dict[str, dict[str, Any]] = {}
        for row in sorted(rows, key=lambda row: (row["beta"], row["method"] == frontier.METHOD)):
            last[row["mode"]] = row
        return [
            f"{mode}, beta {row['beta']:g}, bus {entry['bus']}: {entry['label']}"
            for mode, row in last.items()
            for entry in row["binding"]
            if entry["kind"] == "closed"
        ]

    def table(self) -> pd.DataFrame:
        """One row per plan: capacities, replay and power-flow verdicts."""
        with Store(self.folder / outputs.STORE) as store:
            return outputs.plan_table(store)

    def report(self) -> list[Path]:
        """Write tables, figures and report again from the store; the files written."""
        from dcvrt.studies.figures import draw_all
        from dcvrt.studies.findings import Findings
        from dcvrt.studies.report import write_report

        with Store(self.folder / outputs.STORE) as store:
            files = outputs.write_results(self.folder, store)
        findings = Findings(self.folder)
        return [*files, *draw_all(findings), write_report(findings)]


def _facility(mode: str, parameters: Mapping[str, float]) -> ParameterTable:
    """Parameters of a variant with the values that the study gives some of them."""
    from dcvrt import facility

    diagram = facility.get(mode)
    for path, value in parameters.items():
        diagram.set(path, value, "study file")
    return diagram.compile().parameters


def versions() -> dict[str, str]:
    """Versions of everything that a number may depend on."""
    found = {"dcvrt": dcvrt.__version__, "python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "not installed"
    return found


def prepare(file: StudyFile, setting: Setting) -> dict[str, str]:
    """Let what is generated once per machine be generated here, before workers would do it at the same time.

    ANDES generates its code meanwhile, which takes one processor for as long as all facilities do.

    Returns
    -------
    dict
        How the facility of each mode is evaluated: the compiler, or the interpreter.
    """
    from concurrent.futures import ThreadPoolExecutor

    from dcvrt.grid import andes
    from dcvrt.planning import replay

    zero, backends = [0.0] * len(setting.sites), {}
    engines = {file.grid.engine, file.replay.engine}
    with ThreadPoolExecutor(1) as beside:
        code = beside.submit(andes.prepare)
        for mode in file.facility.modes:
            runs = [(mode, beta) for beta in file.facility.beta]
            for period in setting.periods:
                for gradients in {file.frontier.search or file.sampling.gradients, False}:
                    request = setting.request(
                        zero, period, runs, engine=file.grid.engine, gradients=gradients
                    )
                    backends[mode] = replay.prepare_facility(request)
        code.result()
    for engine in sorted(engines):
        replay.prepare_grid(setting.request(zero, next(iter(setting.periods)), [], engine=engine))
    return backends


def refuse_another_study(store: Store, file: StudyFile, folder: Path) -> None:
    """Refuse a folder that was made from another study, or with versions that may give other numbers.

    Raises
    ------
    InputError
        Naming what differs.
    """
    known = store.provenance()
    if "study" not in known:
        return
    before, now = flat(known["study"]), flat(file.canonical())
    changed = [
        f"{key}: was {before.get(key, 'not there')}, is {now.get(key, 'not there')}"
        for key in sorted(before.keys() | now.keys())
        if before.get(key) != now.get(key)
    ]
    way_out = "Way out: take another folder with --out, or undo the change"
    if changed:
        shown = "\n".join(f"  {line}" for line in changed[:8]) + (
            f"\n  ... {len(changed) - 8} more" if len(changed) > 8 else ""
        )
        raise InputError(f"{folder} holds the results of another study:\n{shown}\n{way_out}.")
    here = versions()
    other = [
        f"  {name}: was {known['versions'].get(name)}, is {here[name]}"
        for name in DECIDING
        if known["versions"].get(name) != here[name]
    ]
    if other:
        raise InputError(f"{folder} was made with other versions:\n" + "\n".join(other) + f"\n{way_out}.")


def flat(data: Any, path: str = "") -> dict[str, str]:
    """Nested plain data as one line per value.

    >>> flat({"grid": {"sites": [1, 2]}, "fault": [{"bus": 3}]})
    {'grid.sites': '[1, 2]', 'fault[1].bus': '3'}
    """
    if isinstance(data, dict) and data:
        return {
            k: v
            for key, item in data.items()
            for k, v in flat(item, f"{path}.{key}" if path else str(key)).items()
        }
    if isinstance(data, list) and data and isinstance(data[0], dict):
        return {k: v for n, item in enumerate(data, 1) for k, v in flat(item, f"{path}[{n}]").items()}
    return {path: json.dumps(data)}
