"""What all phases of a study share: the study, the hosting programme, the periods, the plan without
ride-through."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from dcvrt.errors import InputError
from dcvrt.planning import replay
from dcvrt.planning.hosting import HostingProblem
from dcvrt.planning.plan import Plan
from dcvrt.planning.sampling import Samples, sample_hosting
from dcvrt.planning.security import N1
from dcvrt.studies import checks
from dcvrt.studies.config import StudyFile

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


def _by_site(sizes: float | list[float], sites: list[int]) -> float | dict[int, float]:
    return dict(zip(sites, sizes, strict=True)) if isinstance(sizes, list) else sizes


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
        h_max=_by_site(h.h_max_mw, file.grid.sites),
        min_size=_by_site(h.min_size_mw, file.grid.sites),
        security=None if h.n1_rating_factor is None else N1(h.n1_rating_factor),
        reactive_limits=h.reactive_limits,
        base_violations=h.base_violations,
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
