"""What a finished study folder holds, read once, and the statements that follow from it.

Figures and report read a study through :class:`Findings` alone. Every sentence made here is computed from the
rows of the summary and the store; none is written for a particular result.
"""

from __future__ import annotations

import itertools
import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dcvrt.errors import DcvrtError, InputError
from dcvrt.studies.config import FaultEntry, StudyFile
from dcvrt.studies.rows import Row, ac_verdict, binding, binding_text, closed, verdict
from dcvrt.studies.store import Store
from dcvrt.studies.style import mode_name

if TYPE_CHECKING:
    import pandas as pd

    from dcvrt.dae import Dae
    from dcvrt.grid.network import Network
    from dcvrt.integrators import Simulator
    from dcvrt.trajectory import Trajectory

SAVE_AT = 2e-3
"""Distance of the samples of runs that are drawn, s."""
SAME_SHARE = 1e-3
"""Capacities that differ by less than this share of the plan without ride-through count as equal."""

FILES = ("summary.json", "study.sqlite")


@dataclass(frozen=True, eq=False)
class Findings:
    """Results of one study folder.

    Parameters
    ----------
    folder : the folder of a study that has ended.

    Raises
    ------
    InputError
        When the study has not ended: summary, study file or store are missing.
    """

    folder: Path

    def __post_init__(self) -> None:
        missing = [name for name in FILES if not (self.folder / name).is_file()]
        if missing:
            raise InputError(
                f"{self.folder}: {' and '.join(missing)} not found, so this is not the folder of a study "
                "that has ended. Way out: run 'dcvrt study run' with this folder as --out; it resumes."
            )

    # -- what the folder holds -----------------------------------------------------------------------------

    @cached_property
    def summary(self) -> dict[str, Any]:
        """`summary.json`."""
        return dict(json.loads((self.folder / "summary.json").read_text(encoding="utf-8")))

    @cached_property
    def study(self) -> StudyFile:
        """The study as it was run: of a quick run the reduced one, which is not what `study.toml` says."""
        known = self.provenance
        return StudyFile.model_validate(
            known["study"] | {"study": known["study"]["study"] | {"name": known["study_name"]}}
        )

    @cached_property
    def provenance(self) -> dict[str, Any]:
        """What the store says about how it was made."""
        with self._store() as store:
            return store.provenance()

    @cached_property
    def margins(self) -> pd.DataFrame:
        """Every checked facility run, of samples and plans, without its gradients."""
        with self._store() as store:
            return store.margins(leave=["gradients"])

    @cached_property
    def hostings(self) -> pd.DataFrame:
        """Every hosting vector."""
        with self._store() as store:
            return store.hostings()

    @cached_property
    def predictions(self) -> pd.DataFrame:
        """Validation points with what the surrogates predict."""
        with self._store() as store:
            return store.predictions()

    @cached_property
    def surrogates(self) -> pd.DataFrame:
        """Fitted margins."""
        with self._store() as store:
            return store.surrogates()

    @cached_property
    def plans(self) -> pd.DataFrame:
        """Plans with their verdicts."""
        with self._store() as store:
            return store.plans()

    @cached_property
    def comparison(self) -> dict[str, Any]:
        """The paper's method and the frontier side by side."""
        from dcvrt.studies.comparison import comparison

        with self._store() as store:
            return comparison(store)

    @cached_property
    def system_limits(self) -> dict[str, Any]:
        """Plans under system limits, beside those whose every site rides through."""
        from dcvrt.studies.system_limit import system_limits

        with self._store() as store:
            return system_limits(store)

    @cached_property
    def sensitivities(self) -> pd.DataFrame:
        """Sensitivities of one plan of each mode to the assumptions, those with most at stake first."""
        with self._store() as store:
            return store.sensitivities()

    @cached_property
    def sensitivity_plans(self) -> dict[str, dict[str, Any]]:
        """The plans that the sensitivities belong to, by mode."""
        return dict(self.provenance.get("sensitivity_plans", {}))

    @cached_property
    def coupling(self) -> pd.DataFrame:
        """Margins of plans with the facilities in the network beside those without."""
        with self._store() as store:
            return store.coupling()

    @cached_property
    def tasks(self) -> pd.DataFrame:
        """Tasks with their states."""
        with self._store() as store:
            return store.tasks()

    def waveforms(self, **where: Any) -> list[tuple[dict[str, Any], dict[str, Any]]]:
        """Stored waveforms, see :meth:`Store.waveforms`."""
        with self._store() as store:
            return list(store.waveforms(**where))

    @cached_property
    def _whole(self) -> Path:
        """The store, once it is known to be whole."""
        with Store(self.folder / "study.sqlite") as store:
            return store.path

    def _store(self) -> Store:
        return Store(self._whole, check=False)

    # -- its dimensions ------------------------------------------------------------------------------------

    @property
    def sites(self) -> list[int]:
        """Candidate buses in the order of the study file."""
        return list(self.study.grid.sites)

    @property
    def modes(self) -> list[str]:
        """Facility variants in the order of the study file."""
        return list(self.study.facility.modes)

    @property
    def methods(self) -> list[str]:
        """Surrogate methods in the order of the study file, then the frontier where it was searched."""
        searched = any(row["method"] == "frontier" for row in self.summary["rows"])
        return [*self.study.surrogate.methods, *(["frontier"] if searched else [])]

    @property
    def faults(self) -> list[FaultEntry]:
        """Faults of the study file."""
        return list(self.study.fault)

    @property
    def no_vrt_mw(self) -> float:
        """Total of the plan without ride-through."""
        return float(self.summary["no_vrt"]["total_mw"])

    @property
    def no_vrt_by_site(self) -> dict[int, float]:
        """Capacities of the plan without ride-through."""
        return {int(bus): float(mw) for bus, mw in self.summary["no_vrt"]["by_site"].items()}

    @cached_property
    def network(self) -> Network:
        """The network of the case, from where the run has found it.

        Raises
        ------
        InputError
            When the file of the case is no longer there.
        """
        from dcvrt.studies.checks import read_network

        grid = self.study.grid
        if len(self.tasks):  # relative paths of the study file were resolved when the tasks were written
            request = json.loads(self.tasks.text.iloc[0])
            grid = grid.model_copy(update={"case": request["case"], "dynamics": request["dynamics"]})
        network, problems = read_network(grid, self.folder)
        if network is None:
            raise InputError("; ".join(problems))
        return network

    @cached_property
    def map_problem(self) -> str | None:
        """Why the network cannot be drawn, or None."""
        try:
            _ = self.network
        except DcvrtError as error:
            return str(error)
        return None

    @property
    def periods(self) -> dict[str, dict[str, Any]]:
        """Operating hours that faults are simulated in: {name: {hour, load_scale, wind, dc_factor}}."""
        return dict(self.provenance["periods"])

    @property
    def wind_buses(self) -> list[int]:
        """Buses with wind power."""
        return sorted({int(bus) for period in self.periods.values() for bus in period["wind"]})

    @property
    def anything_simulated(self) -> bool:
        """Whether at least one facility run has a result."""
        return bool((self.margins.ok == 1).any())

    def rows(self, mode: str | None = None, method: str | None = None) -> list[Row]:
        """Rows of the summary of a mode and a method, by rising beta."""
        chosen = [
            row
            for row in self.summary["rows"]
            if mode in (None, row["mode"]) and method in (None, row["method"])
        ]
        return sorted(chosen, key=lambda row: (row["mode"], row["method"], row["beta"]))

    def facility(self, mode: str) -> Dae:
        """The compiled facility of a mode, with the parameters that the study sets."""
        from dcvrt import facility

        if mode not in self._facilities:
            diagram = facility.get(mode)
            for path, value in self.parameters(mode).items():
                diagram.set(path, value, "study file")
            self._facilities[mode] = diagram.compile()
        return self._facilities[mode]

    @cached_property
    def _facilities(self) -> dict[str, Dae]:
        return {}

    def simulator(self, mode: str) -> Simulator:
        """Runs the facility of a mode."""
        from dcvrt.integrators import Simulator

        if mode not in self._simulators:
            self._simulators[mode] = Simulator(self.facility(mode), save_at=SAVE_AT)
        return self._simulators[mode]

    @cached_property
    def _simulators(self) -> dict[str, Simulator]:
        return {}

    def parameters(self, mode: str) -> dict[str, float]:
        """Parameters that the study sets for a mode, by path."""
        return {**self.study.facility.parameters, **self.study.facility.parameters_by_mode.get(mode, {})}

    # -- statements ----------------------------------------------------------------------------------------

    @property
    def tolerance_mw(self) -> float:
        """Difference below which two capacities count as equal."""
        return SAME_SHARE * max(self.no_vrt_mw, 1.0)

    @cached_property
    def closed_loop(self) -> dict[tuple[str, str, float], bool]:
        """Whether plans ride through in closed loop, by hosting vector, mode and rating."""
        from dcvrt.studies.coupling import rides_of
        from dcvrt.studies.store import records

        return rides_of(records(self.coupling))

    def rides_in_closed_loop(self, row: Row) -> bool | None:
        """Whether the plan of a row rides through in closed loop; None where that was not simulated."""
        return self.closed_loop.get((self.plan(row)["hosting"], row["mode"], row["beta"]))

    def best(self, mode: str | None = None, closed_loop: bool = False) -> Row | None:
        """The row with the largest total that passed every check; the smaller beta where totals are equal.

        With `closed_loop` among those that ride through there as well.
        """
        passed = [
            row
            for row in self.rows(mode)
            if verdict(row) == "passed"
            and ac_verdict(row) == "passed"
            and (not closed_loop or self.rides_in_closed_loop(row))
        ]
        if not passed:
            return None
        most = max(float(row["total_mw"]) for row in passed)
        return min(
            (row for row in passed if row["total_mw"] >= most - self.tolerance_mw),
            key=lambda row: row["beta"],
        )

    def falls(self) -> list[str]:
        """A sentence for each step of beta at which the capacity falls."""
        said = []
        for mode in self.modes:
            for method in self.methods:
                rows = self.rows(mode, method)
                for low, high in itertools.pairwise(rows):
                    if high["total_mw"] < low["total_mw"] - self.tolerance_mw:
                        said.append(
                            f"{mode_name(mode)}, method {method}: capacity falls from "
                            f"{low['total_mw']:.1f} MW at β = {low['beta']:g} to {high['total_mw']:.1f} MW "
                            f"at β = {high['beta']:g}. What holds it back there: {self.limits_of(high)}"
                        )
        return said

    def shortfalls(self) -> list[str]:
        """A sentence for each mode and method whose highest beta stays below the no-ride-through plan."""
        said = []
        for mode in self.modes:
            for method in self.methods:
                rows = self.rows(mode, method)
                if rows and rows[-1]["total_mw"] < self.no_vrt_mw - self.tolerance_mw:
                    top = rows[-1]
                    said.append(
                        f"{mode_name(mode)}, method {method}: at the highest β studied ({top['beta']:g}) "
                        f"{top['total_mw']:.1f} MW can be hosted, {self.no_vrt_mw - top['total_mw']:.1f} "
                        f"MW less than without ride-through ({self.no_vrt_mw:.1f} MW). What prevents more: "
                        f"{self.limits_of(top)}"
                    )
        return said

    def limits_of(self, row: Row) -> str:
        """What keeps a row from hosting more: its closed sites and its highest-priced limits."""
        parts = [f"bus {bus} is closed: {reason.rstrip('.')}" for bus, reason in closed(row).items()]
        highest = [binding_text(entry) for entry in binding(row)][:3]
        if highest:
            parts.append("highest-priced limits: " + "; ".join(highest))
        text = ". ".join(part[0].upper() + part[1:] for part in parts)
        return f"{text or 'No limit is recorded for this row'}."

    def plan(self, row: Row) -> Row:
        """The row of `plans` that belongs to a row of the summary."""
        plans = self.plans
        found = plans[
            (plans.method == row["method"]) & (plans["mode"] == row["mode"]) & (plans.beta == row["beta"])
        ]
        return dict(found.iloc[0])

    def worst_case(self, mode: str | None = None) -> Case | None:
        """The replayed run of a plan with the least margin, pu volts or share of import, whatever is less."""
        replayed = self.margins[(self.margins.ok == 1) & (self.margins.h_mw > 0)]
        # A vector is replayed for several modes and ratings, and is the plan of some of them.
        replayed = replayed.merge(self.plans[["hosting", "mode", "beta"]].drop_duplicates())
        if mode is not None:
            replayed = replayed[replayed["mode"] == mode]
        if replayed.empty:
            return None
        least = replayed[["v_margin_pu", "loss_margin_share"]].min(axis=1)
        row = replayed.iloc[int(least.to_numpy().argmin())]
        return Case(
            str(row.hosting),
            str(row.period),
            str(row.fault),
            int(row.site),
            str(row["mode"]),
            float(row.beta),
            float(row.h_mw),
            float(row.v_margin_pu),
            float(row.loss_margin_share),
            str(row.sequence),
        )

    def run(self, case: Case) -> Trajectory | None:
        """The facility of a case on its POI voltage; None where the store has no voltage of it."""
        with self._store() as store:
            voltage = store.voltage(case.hosting, case.period, case.fault, case.site)
        if voltage is None:
            return None
        d = float(self.provenance["periods"][case.period]["dc_factor"])
        return self.simulator(case.mode).attempt(
            voltage, H=1.0, beta=case.beta, d=d, pf=self.study.hosting.pf
        )


@dataclass(frozen=True)
class Case:
    """One checked facility run: where it was and what came out."""

    hosting: str
    period: str
    fault: str
    site: int
    mode: str
    beta: float
    h_mw: float
    v_margin_pu: float
    loss_margin_share: float
    sequence: str
