"""The master programme: capacities and open sites under cuts, solved by HiGHS."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from dcvrt.planning.objective import MaxMin, MaxTotal, Objective, Rating
from dcvrt.planning.plan import Row

if TYPE_CHECKING:
    import highspy

Floats = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

TOLERANCE = 1e-9


def highs() -> highspy.Highs:
    """A silent, single-threaded, exact HiGHS."""
    import highspy

    class Silent(highspy.Highs):
        """Version 1.16 prints its banner while it is made, before a caller can set an option."""

        def enableCallbacks(self) -> None:
            self.setOptionValue("output_flag", False)
            super().enableCallbacks()

    solver = Silent()
    for option, value in (
        ("output_flag", False),
        ("threads", 1),
        ("mip_rel_gap", 0.0),
        ("mip_abs_gap", 1e-9),
        ("primal_feasibility_tolerance", TOLERANCE),
        ("dual_feasibility_tolerance", TOLERANCE),
        ("mip_feasibility_tolerance", TOLERANCE),
    ):
        solver.setOptionValue(option, value)
    return solver


def model(
    cost: Floats,
    lower: Floats,
    upper: Floats,
    matrix: Any,
    row_lower: Floats,
    row_upper: Floats,
    whole: Flags | None = None,
) -> highspy.HighsLp:
    """A HiGHS model that maximises `cost` over a scipy matrix of rows; `whole` columns are integer."""
    import highspy

    lp = highspy.HighsLp()
    lp.num_col_, lp.num_row_ = len(cost), len(row_lower)
    lp.sense_ = highspy.ObjSense.kMaximize
    lp.col_cost_, lp.col_lower_, lp.col_upper_ = cost, lower, upper
    lp.row_lower_, lp.row_upper_ = row_lower, row_upper
    matrix = matrix.tocsr()
    lp.a_matrix_.format_ = highspy.MatrixFormat.kRowwise
    lp.a_matrix_.start_, lp.a_matrix_.index_, lp.a_matrix_.value_ = matrix.indptr, matrix.indices, matrix.data
    if whole is not None and whole.any():
        kinds = (highspy.HighsVarType.kContinuous, highspy.HighsVarType.kInteger)
        lp.integrality_ = [kinds[bool(w)] for w in whole]
    return lp


@cache
def _shared() -> highspy.Highs:
    return highs()


@dataclass(frozen=True, eq=False)
class Cut:
    """A valid inequality `a @ H <= b` in MW, with the limit that it comes from.

    `origin` is a `FlowCut` or a `Tangent`; the caller reads prices from it.
    """

    a: Floats
    b: float
    origin: Any


@dataclass(frozen=True, eq=False)
class Solution:
    """Optimum of the master, with marginal values where no site was chosen.

    Attributes
    ----------
    H, S : arrays (sites,)
        Capacities in MW and converter ratings in MVA; S is empty where ratings are no unknowns.
    open : bool array (sites,)
    objective : float
    cuts : tuple of Cut
        Those that the optimum was found under.
    cut_price : array (cuts,)
    row_dual : array (rows,)
        Negative where the lower limit of a requirement row binds, positive where the upper one does.
    bound_price, floor_price : arrays (sites,)
        Of the largest and of the smallest size.
    """

    H: Floats
    S: Floats
    open: Flags
    objective: float
    cuts: tuple[Cut, ...]
    cut_price: Floats
    row_dual: Floats
    bound_price: Floats
    floor_price: Floats


@dataclass(frozen=True, eq=False)
class Block:
    """Rows of a programme: `low <= matrix @ columns <= high`, with their names."""

    matrix: Floats
    low: Floats
    high: Floats
    names: list[str]


class Master:
    r"""Maximise over cuts, requirement rows and open sites.

    .. math::
        \max \sum_i (w_i H_i - c S_i) \quad\text{or}\quad \max \mu, \quad H_i \ge w_i \mu, \qquad
        \underline H_i z_i \le H_i \le \overline H_i z_i, \quad z_i \in \{0, 1\}, \\
        \underline\beta H_i \le S_i \le \overline\beta H_i, \qquad
        \underline b - M (1 - z_i) \le \sum_j (a_j H_j + c_j S_j) \le \overline b + M' (1 - z_i)

    The relaxed limits of a site's row are the extremes that its left-hand side can take while the site is
    closed, so the row says nothing then, and M is no larger than it has to be.

    Parameters
    ----------
    sites : sequence of int
    lower, upper : arrays (sites,)
        Sizes between which an open site lies, MW.
    rows : sequence of Row
    objective : MaxTotal or MaxMin
    rating : Rating or None
    must_open : bool array (sites,), optional
        Sites that may not be closed.
    """

    def __init__(
        self,
        sites: Sequence[int],
        lower: Floats,
        upper: Floats,
        rows: Sequence[Row],
        objective: Objective | None = None,
        rating: Rating | None = None,
        must_open: Flags | None = None,
    ) -> None:
        objective = MaxTotal() if objective is None else objective
        n = self.count = len(sites)
        self.sites, self.lower, self.upper, self.rows = tuple(sites), lower, upper, tuple(rows)
        self.must_open = np.zeros(n, dtype=bool) if must_open is None else must_open
        self.cuts: list[Cut] = []
        self._forbidden: list[Flags] = []
        self._rated = 0 if rating is None else n
        least = isinstance(objective, MaxMin)
        weight = objective.vector(sites)
        self.names = [
            *(f"H_{bus}" for bus in sites),
            *(f"S_{bus}" for bus in sites if rating is not None),
            *(["least"] if least else []),
        ]
        self.cost = np.zeros(len(self.names))
        if least:
            self.cost[-1] = 1.0
        else:
            self.cost[:n] = weight
            self.cost[n:] = 0.0 if rating is None else -rating.cost
        self.linking = _linking(self.names, sites, weight if least else None, upper, rating)
        self.largest = np.r_[
            upper, np.zeros(0) if rating is None else rating.high * upper, np.zeros(int(least))
        ]
        """Largest value of each column; 0 for the least size, which rows do not contain."""
        place = {bus: i for i, bus in enumerate(sites)}
        self.coefficients = np.zeros((len(rows), len(self.names)))
        for r, row in enumerate(rows):
            for bus, a in row.coefficients.items():
                self.coefficients[r, place[bus]] = a
            for bus, c in row.rating.items():
                self.coefficients[r, n + place[bus]] = c
        self.required = np.array([row.lower for row in rows], dtype=float)
        self.allowed = np.array([row.upper for row in rows], dtype=float)
        self._site = np.array([-1 if row.site is None else place[row.site] for row in rows], dtype=np.int64)
        extreme = self.coefficients * self.largest  # every site may be closed, so columns range from 0
        for i in range(n):
            own = [i] if rating is None else [i, n + i]
            extreme[np.ix_(self._site == i, own)] = 0.0
        closable = (self._site >= 0) & ~self.must_open[self._site]
        below = np.maximum(self.required - np.minimum(extreme, 0.0).sum(axis=1), 0.0)
        above = np.maximum(np.maximum(extreme, 0.0).sum(axis=1) - self.allowed, 0.0)
        self._relief_low, self._relief_high = np.where(closable, below, 0.0), np.where(closable, above, 0.0)
        relief = bool((self._relief_low > 0).any() or (self._relief_high > 0).any())
        self.may_close = relief or bool(((lower > 0) & ~self.must_open).any())
        """Whether closing a site can help; if not, the programme is linear."""

    @property
    def always(self) -> Flags:
        """Requirement rows that hold for every plan: those of no site, or of one that must be open."""
        return np.asarray((self._site < 0) | self.must_open[self._site])

    def forbid(self, is_open: Flags) -> None:
        """Leave out a choice of open sites from now on."""
        self._forbidden.append(is_open.copy())

    def choose(self, beside: Flags | None = None) -> Solution | None:
        """Best choice of open sites under the cuts so far, or None when there is none.

        With `beside`, the best that opens all of these sites but one at most, and as many at least: further
        ones, or others in place of one.
        """
        if not self.may_close:
            return self.solve(np.ones(self.count, dtype=bool))
        n, width = self.count, len(self.names)
        cuts, choice = self._cut_block(), self.with_choice()
        kept = np.zeros(n, dtype=bool) if beside is None else beside
        same = int(kept.sum())
        other = np.array([np.where(no, -1.0, 1.0) for no in self._forbidden]).reshape(-1, n)
        found = _run(
            np.r_[self.cost, np.zeros(n)],
            np.r_[np.zeros(width), self.must_open.astype(float)],
            np.r_[self._column_upper(self.upper), np.ones(n)],
            np.vstack(
                [
                    np.hstack([cuts.matrix, np.zeros((len(cuts.low), n))]),
                    choice.matrix,
                    np.r_[np.zeros(width), np.ones(n)],
                    np.r_[np.zeros(width), kept.astype(float)],
                    np.hstack([np.zeros((len(other), width)), other]),
                ]
            ),
            np.r_[cuts.low, choice.low, same, same - 1, [1.0 - no.sum() for no in self._forbidden]],
            np.r_[cuts.high, choice.high, n, n, np.full(len(other), np.inf)],
            np.r_[np.zeros(width, bool), np.ones(n, bool)],
        )
        if found is None:
            return None
        values, objective, _, _ = found
        nothing = np.zeros(0)
        return Solution(
            values[:n],
            values[n : n + self._rated],
            values[width:] > 0.5,
            objective,
            (),
            nothing,
            nothing,
            nothing,
            nothing,
        )

    def smallest(self, is_open: Flags) -> Floats | None:
        """Sizes of the least total for given open sites, or None when they cannot all be open."""
        if not self.cuts and not len(self.without_choice(is_open)[0].low):
            return np.where(is_open, self.lower, 0.0)
        kept, self.cost = self.cost, np.r_[-np.ones(self.count), np.zeros(len(self.names) - self.count)]
        try:
            found = self.solve(is_open)
        finally:
            self.cost = kept
        return None if found is None else found.H

    def with_choice(self) -> Block:
        """All rows but the cuts over [columns, z]."""
        n, width = self.count, len(self.names)
        relief = np.zeros((2, len(self.rows), n))
        own = np.flatnonzero(self._site >= 0)
        relief[0, own, self._site[own]] = -self._relief_low[own]
        relief[1, own, self._site[own]] = self._relief_high[own]
        low, high = np.isfinite(self.required), np.isfinite(self.allowed)
        size = np.eye(n, width)
        matrix = np.block(
            [
                [self.coefficients[low], relief[0, low]],
                [self.coefficients[high], relief[1, high]],
                [size, -np.diag(self.upper)],
                [size, -np.diag(self.lower)],
                [self.linking.matrix, np.zeros((len(self.linking.low), n))],
            ]
        )
        return Block(
            matrix,
            np.r_[
                (self.required - self._relief_low)[low],
                np.full(int(high.sum()), -np.inf),
                np.full(n, -np.inf),
                np.zeros(n),
                self.linking.low,
            ],
            np.r_[
                np.full(int(low.sum()), np.inf),
                (self.allowed + self._relief_high)[high],
                np.zeros(n),
                np.full(n, np.inf),
                self.linking.high,
            ],
            [
                *(f"row{r}" for r in np.flatnonzero(low)),
                *(f"row{r}_upper" for r in np.flatnonzero(high)),
                *(f"{what}_{bus}" for what in ("largest", "smallest") for bus in self.sites),
                *self.linking.names,
            ],
        )

    def without_choice(self, is_open: Flags) -> tuple[Block, Flags]:
        """All rows but the cuts for given open sites, and which of the requirement rows are among them."""
        holds = (self._site < 0) | is_open[self._site]
        return Block(
            np.vstack([self.coefficients[holds], self.linking.matrix]),
            np.r_[self.required[holds], self.linking.low],
            np.r_[self.allowed[holds], self.linking.high],
            [*(f"row{r}" for r in np.flatnonzero(holds)), *self.linking.names],
        ), holds

    def solve(self, is_open: Flags) -> Solution | None:
        """Optimum for given open sites, with prices, or None when they cannot all be open."""
        n = self.count
        cuts = self._cut_block()
        rest, holds = self.without_choice(is_open)
        low, high = np.where(is_open, self.lower, 0.0), np.where(is_open, self.upper, 0.0)
        found = _run(
            self.cost,
            np.r_[low, np.zeros(len(self.names) - n)],
            self._column_upper(high),
            np.vstack([cuts.matrix, rest.matrix]),
            np.r_[cuts.low, rest.low],
            np.r_[cuts.high, rest.high],
            None,
        )
        if found is None:
            return None
        values, objective, dual, reduced = found
        H, count = values[:n], len(cuts.low)
        row_dual = np.zeros(len(self.rows))
        row_dual[holds] = dual[count : count + int(holds.sum())]
        return Solution(
            H,
            values[n : n + self._rated],
            is_open,
            objective,
            tuple(self.cuts),
            dual[:count],
            row_dual,
            np.where(is_open & (high <= H), np.maximum(reduced[:n], 0.0), 0.0),
            np.where(is_open & (low > 0) & (low >= H), np.maximum(-reduced[:n], 0.0), 0.0),
        )

    def least_violations(self) -> Floats | None:
        """How far each requirement row that holds for every plan is missed when all are missed by the least
        sum; rows are weighed by their largest coefficient. None when the cuts alone exclude everything."""
        general = np.flatnonzero(self.always)
        cuts, count = self._cut_block(), len(general)
        size = abs(self.coefficients[general]).max(axis=1, initial=0.0)
        size[size == 0.0] = 1.0
        slack = np.hstack([np.diag(size), -np.diag(size)])
        matrix = np.block(
            [
                [cuts.matrix, np.zeros((len(cuts.low), 2 * count))],
                [self.coefficients[general], slack],
                [self.linking.matrix, np.zeros((len(self.linking.low), 2 * count))],
            ]
        )
        found = _run(
            np.r_[np.zeros(len(self.names)), -np.ones(2 * count)],
            np.r_[
                np.where(self.must_open, self.lower, 0.0), np.zeros(len(self.names) - self.count + 2 * count)
            ],
            np.r_[self._column_upper(self.upper), np.full(2 * count, np.inf)],
            matrix,
            np.r_[cuts.low, self.required[general], self.linking.low],
            np.r_[cuts.high, self.allowed[general], self.linking.high],
            None,
        )
        if found is None:
            return None
        missed = np.zeros(len(self.rows))
        missed[general] = found[0][len(self.names) :].reshape(2, count).sum(axis=0) * size
        return missed

    def _column_upper(self, sizes: Floats) -> Floats:
        return np.r_[sizes, np.full(len(self.names) - self.count, np.inf)]

    def _cut_block(self) -> Block:
        matrix = np.zeros((len(self.cuts), len(self.names)))
        for k, cut in enumerate(self.cuts):
            matrix[k, : self.count] = cut.a
        high = np.array([cut.b for cut in self.cuts], dtype=float)
        high[~matrix.any(axis=1)] = np.inf  # a voltage that no capacity moves, linearised where it was lower
        return Block(matrix, np.full(len(high), -np.inf), high, [])


def _linking(
    names: list[str], sites: Sequence[int], shares: Floats | None, upper: Floats, rating: Rating | None
) -> Block:
    """Rows between capacities, ratings and the least size."""
    n, width = len(sites), len(names)
    size = np.eye(n, width)
    blocks = [Block(np.zeros((0, width)), np.zeros(0), np.zeros(0), [])]
    if rating is not None:
        rated = np.eye(n, width, k=n)
        free, nothing = np.full(n, np.inf), np.zeros(n)
        blocks.append(Block(rated - rating.low * size, nothing, free, [f"rating_low_{bus}" for bus in sites]))
        blocks.append(
            Block(rated - rating.high * size, -free, nothing, [f"rating_high_{bus}" for bus in sites])
        )
    if shares is not None:
        counts = np.flatnonzero((shares > 0) & (upper > 0))
        matrix = size[counts]
        matrix[:, -1] = -shares[counts]
        bound = np.zeros(len(counts))
        blocks.append(Block(matrix, bound, bound + np.inf, [f"least_{sites[i]}" for i in counts.tolist()]))
    return Block(
        np.vstack([b.matrix for b in blocks]),
        np.concatenate([b.low for b in blocks]),
        np.concatenate([b.high for b in blocks]),
        [name for b in blocks for name in b.names],
    )


def _run(
    cost: Floats,
    lower: Floats,
    upper: Floats,
    matrix: Floats,
    low: Floats,
    high: Floats,
    whole: Flags | None,
) -> tuple[Floats, float, Floats, Floats] | None:
    """Columns, objective, row duals and reduced costs of a small dense programme; None when infeasible."""
    import highspy

    # Rows are scaled to a largest coefficient of 1, so that the solver's tolerance is one in MW.
    size = abs(matrix).max(axis=1, initial=0.0)
    empty = size == 0.0
    if (empty & ((low > TOLERANCE) | (high < -TOLERANCE))).any():
        return None
    size[empty] = 1.0
    scaled = sp.csr_matrix(matrix / size[:, None])
    solver = _shared()
    solver.clearModel()
    solver.passModel(model(cost, lower, upper, scaled, low / size, high / size, whole))
    solver.run()
    status = solver.getModelStatus()
    if status in (highspy.HighsModelStatus.kInfeasible, highspy.HighsModelStatus.kUnboundedOrInfeasible):
        return None
    if status != highspy.HighsModelStatus.kOptimal:
        raise RuntimeError(f"HiGHS ended the master programme with {solver.modelStatusToString(status)}.")
    solution = solver.getSolution()
    dual = np.array(solution.row_dual) / size if whole is None else np.zeros(0)
    return (
        np.array(solution.col_value),
        float(solver.getInfo().objective_function_value),
        dual,
        np.array(solution.col_dual),
    )
