"""The frontier once more, from a plan that is known, with other values of the facility or the criteria.

Simulated in this process by the engine of the samples, which also takes the place of the replay. In the open
loop the grid does not know the facility: what was simulated of it at a hosting vector is kept and serves
every variation.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from dcvrt.planning import replay
from dcvrt.planning.exact import Exact, Place, Run, exact_of
from dcvrt.planning.frontier import frontiers
from dcvrt.planning.requirement import EverySite
from dcvrt.planning.search import Ask, Found, Options
from dcvrt.studies.setting import Setting
from dcvrt.waveform import Waveform

GAIN = 1e-3
"""Share of the total that is not worth another candidate: differences between variations are looked for."""
NEXT_TO_NOTHING = 0.01
"""Second vector that a search starts from, as a share of the box: it shows sites that the plan closes."""

Vector = tuple[float, ...]
Faults = dict[str, Mapping[int, Waveform] | None]


@dataclass
class Reruns:
    """Searches of one study with varied values; they share what was simulated of the grid.

    Attributes
    ----------
    setting : hosting programme, periods and study file.
    grid, facility : simulations made.
    """

    setting: Setting
    grid: int = 0
    facility: int = 0
    _kept: dict[tuple[Vector, str, bool], Faults] = field(default_factory=dict)

    def search(
        self, run: Run, start: Sequence[float], parameters: Mapping[str, float], criteria: Mapping[str, Any]
    ) -> Found:
        """The frontier of a mode and rating.

        Parameters
        ----------
        run : mode and rating ratio.
        start : capacities of the known plan in the order of the sites, MW.
        parameters : all values of the facility that differ from the variant's own.
        criteria : keywords of `Criteria`.
        """
        setting, f = self.setting, self.setting.file.frontier
        varied = {"parameters": {run[0]: dict(parameters)}, "criteria": dict(criteria)}

        def answers(
            questions: Sequence[tuple[Ask, Sequence[Run]]], gradients: bool
        ) -> list[Mapping[Run, Sequence[Exact]]]:
            return [
                exact_of(
                    self._rows(ask.H, ask.places or self.places, run, varied, gradients), setting.sites, ask.H
                )
                for ask, _ in questions
            ]

        corner = np.array([setting.no_vrt.by_site[bus] for bus in setting.sites])
        (found,) = frontiers(
            setting.problem,
            [(run, EverySite(setting.sites))],
            setting.problem.upper,
            np.array([start, NEXT_TO_NOTHING * corner]),
            self.places,
            lambda questions: answers(questions, True),
            lambda questions: answers(questions, False),
            Options(gain=min(GAIN, f.gain), trust=f.trust, candidates=f.candidates),
        )
        return found

    def exact(
        self, run: Run, H: Vector, parameters: Mapping[str, float], criteria: Mapping[str, Any]
    ) -> list[Exact]:
        """Margins with total gradients at a hosting vector, in every period under every fault."""
        varied = {"parameters": {run[0]: dict(parameters)}, "criteria": dict(criteria)}
        rows = self._rows(H, self.places, run, varied, True)
        return exact_of(rows, self.setting.sites, H).get(run, [])

    @property
    def places(self) -> list[Place]:
        """Every period with every fault."""
        labels = [replay.fault_label(fault.model_dump()) for fault in self.setting.file.fault]
        return [(period, label) for period in self.setting.periods for label in labels]

    def waveforms(self, H: Vector, period: str, faults: Sequence[str], tangents: bool) -> Faults:
        """POI voltages by fault and site, None for a fault without a result; simulated once."""
        known = self._kept.setdefault((H, period, tangents), {})
        with_tangents = self._kept.get((H, period, True), {})
        missing = [fault for fault in faults if fault not in known and fault not in with_tangents]
        if missing:
            engine = self.setting.file.grid.engine
            request = self.setting.request(H, period, [], engine=engine, gradients=tangents, faults=missing)
            for fault, waveforms, _ in replay.fault_runs(request):
                known[fault] = waveforms
                self.grid += 1
        return {fault: (with_tangents | known)[fault] for fault in faults}

    def _rows(
        self, H: Vector, places: Sequence[Place], run: Run, varied: Mapping[str, Any], gradients: bool
    ) -> list[dict[str, Any]]:
        rows: list[dict[str, Any]] = []
        engine = self.setting.file.grid.engine
        for period in self.setting.periods:
            faults = [fault for p, fault in places if p == period]
            if not faults:
                continue
            request = self.setting.request(H, period, [run], engine=engine, gradients=gradients)
            request |= varied
            found = self.waveforms(H, period, faults, gradients)
            here = {fault: waveforms for fault, waveforms in found.items() if waveforms is not None}
            lost = [fault for fault in faults if fault not in here]
            rows += replay.lost_rows(request, "the fault has no simulation", "grid", faults=lost)
            if here:
                ran = replay.facility_rows(request, run[0], [run[1]], here)
                self.facility += len(ran)
                rows += ran
        return rows
