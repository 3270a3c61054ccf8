"""The master programme: capacities and open sites under cuts, solved by HiGHS."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from dcvrt.planning.plan import Row

if TYPE_CHECKING:
    import highspy

Floats = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

TOLERANCE = 1e-9


def highs() -> highspy.Highs:
    """A silent, single-threaded, exact HiGHS."""
    import highspy

    solver = highspy.Highs()
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
    """Optimum of the master: capacities, open sites, total, and marginal values where no site was chosen."""

    H: Floats
    open: Flags
    total: float
    cut_price: Floats
    row_price: Floats
    bound_price: Floats


class Master:
    r"""Maximise :math:`\sum_i H_i` over cuts, requirement rows and open sites.

    .. math::
        \underline H_i z_i \le H_i \le \overline H_i z_i, \quad z_i \in \{0, 1\}, \qquad
        \sum_j a_j H_j \ge c - M (1 - z_i)

    The relaxed right-hand side of a site's row, c - M, is the least value that its left-hand side can take
    while the site is closed, so the row says nothing then and M is no larger than it has to be.
    """

    def __init__(self, sites: Sequence[int], lower: Floats, upper: Floats, rows: Sequence[Row]) -> None:
        self.sites, self.lower, self.upper, self.rows = tuple(sites), lower, upper, tuple(rows)
        self.cuts: list[Cut] = []
        place = {bus: i for i, bus in enumerate(sites)}
        self.coefficients = np.zeros((len(rows), len(sites)))
        for r, row in enumerate(rows):
            for bus, a in row.coefficients.items():
                self.coefficients[r, place[bus]] = a
        self.required = np.array([row.lower for row in rows], dtype=float)
        self._site = np.array([-1 if row.site is None else place[row.site] for row in rows], dtype=np.int64)
        least = np.minimum(self.coefficients * upper, 0.0)  # every site may be closed, so H_j ranges from 0
        own = least[np.arange(len(rows)), self._site] if len(rows) else np.zeros(0)
        self._relief = np.maximum(self.required - (least.sum(axis=1) - own), 0.0)
        self._relief[self._site < 0] = 0.0
        self.may_close = bool((self._relief > 0).any() or (lower > 0).any())
        """Whether closing a site can help; if not, the programme is linear."""

    def choose(self) -> Solution | None:
        """Best choice of open sites under the cuts so far, or None when there is none."""
        if not self.may_close:
            return self.solve(np.ones(len(self.sites), dtype=bool))
        n = len(self.sites)
        cut_a, cut_b = self._cut_arrays()
        choice, low, high = self.with_choice()
        found = self._run(
            np.r_[np.ones(n), np.zeros(n)],
            np.zeros(2 * n),
            np.r_[self.upper, np.ones(n)],
            np.vstack([np.hstack([cut_a, np.zeros((len(cut_b), n))]), choice]),
            np.r_[np.full(len(cut_b), -np.inf), low],
            np.r_[cut_b, high],
            np.r_[np.zeros(n, bool), np.ones(n, bool)],
        )
        if found is None:
            return None
        values, total, _, _ = found
        nothing = np.zeros(0)
        return Solution(values[:n], values[n:] > 0.5, total, nothing, nothing, nothing)

    def with_choice(self) -> tuple[Floats, Floats, Floats]:
        """Requirement rows and size limits over [H, z]: matrix, lower and upper right-hand sides."""
        n = len(self.sites)
        relief = np.zeros((len(self.rows), n))
        on_site = self._site >= 0
        relief[np.flatnonzero(on_site), self._site[on_site]] = -self._relief[on_site]
        matrix = np.block(
            [
                [self.coefficients, relief],
                [np.eye(n), -np.diag(self.upper)],
                [np.eye(n), -np.diag(self.lower)],
            ]
        )
        return (
            matrix,
            np.r_[self.required - self._relief, np.full(n, -np.inf), np.zeros(n)],
            np.r_[np.full(len(self.rows), np.inf), np.zeros(n), np.full(n, np.inf)],
        )

    def solve(self, is_open: Flags) -> Solution | None:
        """Optimum for given open sites, with prices, or None when they cannot all be open."""
        n = len(self.sites)
        cut_a, cut_b = self._cut_arrays()
        holds = np.array([s < 0 or bool(is_open[s]) for s in self._site], dtype=bool)
        matrix = np.vstack([cut_a, self.coefficients[holds]])
        low = np.r_[np.full(len(cut_b), -np.inf), self.required[holds]]
        high = np.r_[cut_b, np.full(int(holds.sum()), np.inf)]
        found = self._run(
            np.ones(n),
            np.where(is_open, self.lower, 0.0),
            np.where(is_open, self.upper, 0.0),
            matrix,
            low,
            high,
            None,
        )
        if found is None:
            return None
        values, total, row_dual, reduced = found
        row_price = np.zeros(len(self.rows))
        row_price[holds] = -row_dual[len(cut_b) :]
        bound_price = np.where(is_open & (values >= self.upper), reduced, 0.0)
        return Solution(values, is_open, total, row_dual[: len(cut_b)], row_price, bound_price)

    def _cut_arrays(self) -> tuple[Floats, Floats]:
        a = np.array([cut.a for cut in self.cuts]).reshape(-1, len(self.sites))
        return a, np.array([cut.b for cut in self.cuts], dtype=float)

    @staticmethod
    def _run(
        cost: Floats,
        lower: Floats,
        upper: Floats,
        matrix: Floats,
        low: Floats,
        high: Floats,
        whole: Flags | None,
    ) -> tuple[Floats, float, Floats, Floats] | None:
        import highspy
        import scipy.sparse as sp

        # Rows are scaled to a largest coefficient of 1, so that the solver's tolerance is one in MW.
        size = np.maximum(abs(matrix).max(axis=1, initial=0.0), 1e-300) if len(matrix) else np.zeros(0)
        scaled = sp.csr_matrix(matrix / size[:, None]) if len(matrix) else sp.csr_matrix((0, len(cost)))
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
