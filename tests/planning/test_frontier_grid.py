"""The frontier on the simulated grid with twenty sites."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from dcvrt.planning import replay
from dcvrt.planning.exact import Exact, Run, exact_of
from dcvrt.planning.frontier import frontiers
from dcvrt.planning.requirement import EverySite, SystemLimit
from dcvrt.planning.search import Ask
from dcvrt.studies import Study

SITES = (2, 7, 13, 16, 20, 21, 28, 39, 43, 48, 51, 57, 67, 75, 84, 93, 98, 106, 108, 114)


@pytest.mark.slow
def test_twenty_sites_are_searched_and_pass() -> None:
    study = Study.load()
    file = study.file.model_copy(
        update={
            "grid": study.file.grid.model_copy(update={"sites": list(SITES)}),
            "hosting": study.file.hosting.model_copy(update={"hours": [8400, 8568]}),
            "period": study.file.period[:1],
            "fault": [fault for fault in study.file.fault if fault.bus in (25, 80, 107)],
        }
    )
    setting = study.setting(file)
    (period,) = setting.periods
    labels = [replay.fault_label(fault.model_dump()) for fault in file.fault]

    def rows(ask: Ask, runs: Sequence[Run], gradients: bool) -> list[dict]:
        faults = labels if ask.places is None else [fault for _, fault in ask.places]
        request = setting.request(ask.H, period, runs, engine="native", gradients=gradients, faults=faults)
        return replay.check_hosting(request)["rows"]

    def simulate(questions: Sequence[tuple[Ask, Sequence[Run]]]) -> list[dict[Run, list[Exact]]]:
        return [exact_of(rows(ask, runs, True), SITES, ask.H) for ask, runs in questions]

    def replayed(questions: Sequence[tuple[Ask, Sequence[Run]]]) -> list[dict[Run, list[Exact]]]:
        return [exact_of(rows(ask, runs, False), SITES, ask.H) for ask, runs in questions]

    corner = np.maximum([setting.no_vrt.by_site[bus] for bus in SITES], 1.0)
    found = frontiers(
        setting.problem,
        [
            (("gfl", 1.15), EverySite(SITES)),
            (("gfl", 1.3), EverySite(SITES)),
            (("gfl", 1.15), SystemLimit(SITES, setting.d, mw=20.0)),
        ],
        setting.problem.upper,
        [corner, np.ones(len(SITES))],
        [(period, label) for label in labels],
        simulate,
        replayed,
    )
    for one in found:
        assert one.settled
        assert len(one.certificate) == len(labels)
        assert not any(margins.missed() for margins in one.certificate)
        assert 0 < one.plan.total_mw <= setting.no_vrt.total_mw + 1e-3
        assert set(one.closed) == {bus for bus, mw in one.plan.by_site.items() if mw == 0}
    each, larger_rating, together = found
    assert each.plan.total_mw < larger_rating.plan.total_mw
    # Every site may lose a quarter of its load; 20 MW of all the load are less, and sites share them.
    for margins in together.certificate:
        share = margins.at.loss @ margins.H / margins.H.sum()
        assert share * margins.size[0] <= 20.0
