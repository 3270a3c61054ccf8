"""Margins and a hosting programme known in closed form, in place of the simulated grid and its network."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dcvrt.planning.exact import Exact, Run
from dcvrt.planning.frontier import frontiers
from dcvrt.planning.master import Cut, Master
from dcvrt.planning.plan import Binding
from dcvrt.planning.requirement import Requirement
from dcvrt.planning.search import Ask, Found, Options

LOSS_SHARE = 0.25
"""Loss criterion of one site, which loss margins are measured from."""
Margins = Callable[[np.ndarray, str, float], tuple[np.ndarray, np.ndarray, list[str]]]
"""H, fault, beta -> values (sites, 2), slopes (sites, 2, sites), sequences."""
PERIOD = "peak"


class Programme:
    """A hosting programme of one linear limit: sum_i w_i H_i <= budget."""

    def __init__(self, n: int, budget: float, weights: Sequence[float] | None = None) -> None:
        self.sites = tuple(range(1, n + 1))
        self.weights = np.ones(n) if weights is None else np.asarray(weights)
        self.budget = budget

    def allows(self, hosting) -> bool:
        return self.weights @ [hosting[bus] for bus in self.sites] <= self.budget + 1e-9

    def solve(self, rows=(), bounds=None, thorough=True) -> Answer:
        low = np.array([bounds[bus][0] for bus in self.sites])
        high = np.array([bounds[bus][1] for bus in self.sites])
        master = Master(self.sites, low, high, tuple(rows))
        master.cuts = [Cut(self.weights, self.budget, None)]
        chosen = master.choose()
        found = master.solve(chosen.open)
        return Answer(
            float(found.H.sum()),
            dict(zip(self.sites, found.H.tolist(), strict=True)),
            tuple(
                Binding("row", row.label, float(-dual), "MW", row.lower, bus=row.site)
                for row, dual in zip(master.rows, found.row_dual, strict=True)
                if dual < -1e-7  # the lower limit binds
            ),
            {
                bus: row.label
                for row in master.rows
                for bus in [row.site]
                if bus is not None and found.H[self.sites.index(bus)] == 0
            },
        )


@dataclass(frozen=True)
class Answer:
    total_mw: float
    by_site: dict
    binding: tuple
    closed: dict


class Oracle:
    """Answers both engines from a closed form, and counts.

    The replay finds `less` of every margin; a run that fails has lost `failed` of its import.
    """

    def __init__(
        self,
        programme: Programme,
        margins: Margins,
        faults: Sequence[str],
        less: float = 0.0,
        failed: float = np.nan,
    ) -> None:
        self.sites, self.margins, self.less, self.failed = programme.sites, margins, less, failed
        self.places = [(PERIOD, fault) for fault in faults]
        self.simulated: list[tuple] = []
        self.replayed: list[tuple] = []

    def simulate(self, questions: Sequence[tuple[Ask, Sequence[Run]]]) -> list[dict[Run, list[Exact]]]:
        answers = []
        for ask, runs in questions:
            H = np.array(ask.H)
            self.simulated += [(ask.H, place) for place in ask.places]
            answers.append({run: [self._exact(H, place, run) for place in ask.places] for run in runs})
        return answers

    def _exact(self, H: np.ndarray, place: tuple[str, str], run: Run) -> Exact:
        value, slope, sequence = self.margins(H, place[1], run[1])
        n = len(H)
        return Exact(
            H,
            place,
            value,
            slope,
            np.ones((n, 2)),
            np.where(np.isnan(value[:, 1]), self.failed, LOSS_SHARE - value[:, 1]),
            -0.01 * np.eye(n),
            tuple(sequence),
            ("completed",) * n,
        )

    def replay(self, questions: Sequence[tuple[Ask, Sequence[Run]]]) -> list[dict[Run, list[Exact]]]:
        answers = []
        for ask, runs in questions:
            self.replayed.append(ask.H)
            here = {run: [self._exact(np.array(ask.H), place, run) for place in self.places] for run in runs}
            answers.append({run: [self._weaker(one) for one in exact] for run, exact in here.items()})
        return answers

    def _weaker(self, one: Exact) -> Exact:
        """As the replay finds it: without gradients, and `less` of every margin."""
        nothing = np.full_like(one.slope, np.nan)
        return replace(one, value=one.value - self.less, loss=one.loss + self.less, slope=nothing)


def search(
    programme: Programme,
    oracle: Oracle,
    box: Sequence[float],
    wanted: Sequence[tuple[Run, Requirement]],
    samples: np.ndarray | None = None,
    **options: float,
) -> list[Found]:
    """The frontiers, from a point in the middle of the box and one of next to nothing."""
    corner = np.asarray(box, dtype=float)
    points = np.vstack([0.5 * corner, 0.01 * corner]) if samples is None else samples
    return frontiers(
        programme, wanted, corner, points, oracle.places, oracle.simulate, oracle.replay, Options(**options)
    )


def passes(found: Found) -> bool:
    """Whether a plan of something has a replay in which everything that counts is met."""
    return bool(found.certificate) and not any(one.missed() for one in found.certificate)
