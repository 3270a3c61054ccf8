"""Frontier against the paper's sampling, in one run: what each hosts, what each spends.

Both answer the IEEE-118 study: every mode and rating, every fault and period. The paper's method samples
hosting vectors, fits, tightens, and solves the hosting programme; the frontier searches with exact margins
and their total gradients. The native engine simulates for both, and replays the plans of both under every
fault in every period; in a study that is left to another engine. Compilation is done before the clock starts.

Further rows judge the forms of the margins on held-out vectors of the same samples: how much of what is
feasible each keeps, with its false passes as the row's error.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from benchmarks.harness import Result, result
from dcvrt.planning import replay
from dcvrt.planning.exact import Exact, Run, exact_of
from dcvrt.planning.frontier import frontiers
from dcvrt.planning.kept import side_by_side
from dcvrt.planning.requirement import EverySite
from dcvrt.planning.search import Ask
from dcvrt.planning.surrogate import MarginData, fit_surrogates
from dcvrt.planning.sweep import sweep
from dcvrt.planning.verdict import verdict
from dcvrt.studies import Study
from dcvrt.studies.frontier import coarse_samples
from dcvrt.studies.setting import Setting

PAPER = "paper's method"


def run(smoke: bool = False) -> list[Result]:
    """Rows of the benchmark; `smoke` takes one period, three faults, three ratings and eight samples."""
    setting = _setting(smoke)
    for mode in setting.file.facility.modes:
        for gradients in (False, True):
            request = _request(setting, [0.0] * 4, "peak", [(mode, 1.2)], gradients)
            replay.prepare_facility(request)
            replay.prepare_grid(request)
    spent = Counter(setting)

    start = time.perf_counter()
    data = _sampled(spent, gradients=False)
    fits = fit_surrogates(data, "paper")
    upper = setting.samples().upper
    f = setting.file.facility
    paper = {(p.mode, p.beta): p for p in sweep(setting.problem, fits, f.modes, f.beta, setting.d, upper)}
    paper_s, paper_grid = time.perf_counter() - start, spent.grid
    spent.grid = 0

    start = time.perf_counter()
    places = [(period, label) for period in setting.periods for label in spent.labels]
    found = frontiers(
        setting.problem, [(run, EverySite(setting.sites)) for run in setting.runs], setting.problem.upper,
        coarse_samples(setting), places, spent.simulate, spent.replay,
    )  # fmt: skip
    frontier_s, search_grid = time.perf_counter() - start, spent.grid

    rows = [
        result("all modes and ratings", "fault simulations", search_grid, "1", PAPER, paper_grid),
        result("all modes and ratings", "wall time, replays of the frontier included", frontier_s, "s", PAPER,
               paper_s),
    ]  # fmt: skip
    for one in found:
        theirs = paper[one.mode, one.beta].plan
        H = [round(theirs.by_site[bus], 6) for bus in setting.sites]
        passed = not theirs.total_mw > 0 or spent.passes(H, (one.mode, one.beta))
        case = f"{one.mode}, beta {one.beta:g}" + ("" if passed else " (false pass of the paper's fits)")
        rows.append(result(case, "hosted", one.plan.total_mw, "MW", PAPER, theirs.total_mw, one.gap))
    return rows + _forms(spent)


def _setting(smoke: bool) -> Setting:
    study = Study.load()
    file = study.file
    if smoke:
        change = {
            "sampling": file.sampling.model_copy(update={"n": 8}),
            "facility": file.facility.model_copy(update={"beta": [1.0, 1.2, 1.4]}),
            "period": [p for p in file.period if p.name == "peak"],
            "fault": file.fault[::3],
            "hosting": file.hosting.model_copy(update={"hours": [8400, 8568]}),
        }
        file = file.model_copy(update=change)
    return study.setting(file)


def _request(
    setting: Setting, H: Sequence[float], period: str, runs: Sequence[Run], gradients: bool, **more: Any
) -> dict[str, Any]:
    return setting.request(H, period, runs, engine="native", gradients=gradients, **more)


class Counter:
    """Simulates natively, and counts fault simulations."""

    def __init__(self, setting: Setting) -> None:
        self.setting, self.grid = setting, 0
        self.labels = [replay.fault_label(fault.model_dump()) for fault in setting.file.fault]

    def rows(
        self, H: Sequence[float], runs: Sequence[Run], gradients: bool, places: Any = None, count: bool = True
    ) -> list[dict[str, Any]]:
        rows: list[dict[str, Any]] = []
        for period in self.setting.periods:
            faults = self.labels if places is None else [fault for p, fault in places if p == period]
            if not faults:
                continue
            answer = replay.check_hosting(_request(self.setting, H, period, runs, gradients, faults=faults))
            self.grid += answer["grid"] * count
            rows += answer["rows"]
        return rows

    def simulate(self, questions: Sequence[tuple[Ask, Sequence[Run]]]) -> list[Mapping[Run, Sequence[Exact]]]:
        """Answer a search."""
        return [
            exact_of(self.rows(ask.H, runs, True, ask.places), self.setting.sites, ask.H)
            for ask, runs in questions
        ]

    def replay(self, questions: Sequence[tuple[Ask, Sequence[Run]]]) -> list[Mapping[Run, Sequence[Exact]]]:
        """Replay plans; not counted, as both methods' plans are replayed alike."""
        return [
            exact_of(self.rows(ask.H, runs, False, count=False), self.setting.sites, ask.H)
            for ask, runs in questions
        ]

    def passes(self, H: Sequence[float], run: Run) -> bool:
        """Whether a plan passes the replay."""
        rows = self.rows(H, [run], False, count=False)
        hosting = dict(zip(self.setting.sites, H, strict=True))
        n_open = sum(mw > 0 for mw in H)
        expected = n_open * len(self.setting.periods) * len(self.labels)
        return bool(verdict(rows, hosting, expected)["passed"])


def _sampled(spent: Counter, gradients: bool) -> MarginData:
    return _data(spent, gradients)[0]


def _data(spent: Counter, gradients: bool) -> tuple[MarginData, Any]:
    setting = spent.setting
    samples = setting.samples()
    rows, names, H, fit = [], [], [], []
    for k, vector in enumerate(samples.hosting.tolist()):
        own = spent.rows(vector, setting.runs, gradients)
        rows += own
        names += [f"s{k:04}"] * len(own)
        H += [vector] * len(own)
        fit += [bool(samples.fit[k])] * len(own)

    def column(name: str, kind: Any = float) -> Any:
        return np.array([row[name] for row in rows], dtype=kind)

    data = MarginData(
        setting.sites, np.array(H), np.array([setting.d[row["period"]] for row in rows]),
        column("period", str), column("fault", str), column("mode", str), column("site", np.int64),
        column("beta"),
        column("v_margin_pu"), column("loss_margin_share"), column("loss_margin_mw"), column("ok", bool),
        column("status", str), column("sequence", str), np.array(fit), np.array(names),
    )  # fmt: skip
    if not gradients:
        return data, None
    sites = setting.sites
    nothing = {f"H_{bus}": np.nan for bus in sites}
    slopes = [
        [
            [row["gradients"].get(target, nothing)[f"H_{bus}"] for bus in sites]
            for target in ("voltage", "loss")
        ]
        for row in rows
    ]
    return data, np.array(slopes)


def _forms(spent: Counter) -> list[Result]:
    found = side_by_side(*_data(spent, gradients=True))
    paper = next(one for one in found if one.method == "paper")
    return [
        result(
            f"form '{one.method}', {one.feasible} feasible pairs of site and held-out vector",
            "share kept",
            one.share,
            "1",
            "form 'paper'",
            paper.share,
            one.false_passes / max(one.feasible, 1),
        )
        for one in found
    ]
