"""Dispatch of one hour as a phase-1 linear programme, whose dual gives a cut for every hour."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dcvrt.grid.network import Network
from dcvrt.planning.master import highs

Floats = npt.NDArray[np.float64]

LINES_A_ROUND = 10


@dataclass(frozen=True, eq=False)
class FlowCut:
    r"""Dual of a dispatch programme: no dispatch exists for bus injections n with :math:`\pi\cdot n + c > 0`.

    Only the right-hand side of the programme changes from hour to hour, so its dual speaks about every hour.

    Parameters
    ----------
    pi : array (buses,)
        Shortfall per MW injected.
    constant : float
        c, MW.
    lines : tuple of (branch, weight)
        d c / d rating, negated: what one more MVA of that branch is worth.
    units : tuple of (generator, weight, at_maximum)
        The same for the limit of a unit that the dual leans on.
    """

    pi: Floats
    constant: float
    lines: tuple[tuple[int, float], ...]
    units: tuple[tuple[int, float, bool], ...]


@dataclass(frozen=True, eq=False)
class Dispatched:
    """Result of one hour: the least shortfall in MW (0 if all is served), unit outputs, and the dual."""

    shortfall: float
    units: Floats
    cut: FlowCut


class HourDispatch:
    r"""Least shortfall of one hour in PTDF form, with line rows added as they are violated.

    .. math::
        \min\; s + u + v \quad \text{s.t.} \quad
        \mathbf 1 \cdot g + u - v = -\mathbf 1\cdot n, \qquad
        \pm f_l(n + C_g g) - s \le \overline f_l, \qquad \underline g \le g \le \overline g

    Parameters
    ----------
    network : Network
        Its ratings are the limits.
    """

    def __init__(self, network: Network) -> None:
        import highspy

        self.network = network
        self.units_ptdf = np.ascontiguousarray(network.ptdf()[:, network.generator_index])
        self.p_min, self.p_max = network.generators.p_min, network.generators.p_max
        self._inf = highspy.kHighsInf
        solver = highs()
        solver.setOptionValue("presolve", "off")  # a basis is always at hand
        solver.setOptionValue("solver", "simplex")
        n = len(self.p_min)
        solver.addVars(n + 3, np.r_[self.p_min, 0.0, 0.0, 0.0], np.r_[self.p_max, np.full(3, self._inf)])
        for slack in range(n, n + 3):
            solver.changeColCost(slack, 1.0)
        balance = np.r_[np.arange(n), n + 1, n + 2].astype(np.int32)
        solver.addRow(0.0, 0.0, n + 2, balance, np.r_[np.ones(n), 1.0, -1.0])
        self._solver = solver
        self._rows: list[tuple[int, float]] = []  # branch and sign of each line row
        self._known: set[tuple[int, float]] = set()
        self.solved = 0

    def solve(self, injection: Floats, tolerance: float = 1e-7) -> Dispatched:
        """Dispatch the units for the bus injections of an hour (MW, without the units)."""
        import highspy

        network, n = self.network, len(self.p_min)
        fixed = network.flows(injection)
        demand = -injection.sum()
        while True:
            branch, sign = self._row_arrays()
            high = network.branches.rating[branch] - sign * fixed[branch]
            count = len(branch) + 1
            self._solver.changeRowsBounds(
                count,
                np.arange(count, dtype=np.int32),
                np.r_[demand, np.full(len(branch), -self._inf)],
                np.r_[demand, high],
            )
            self._solver.run()
            self.solved += 1
            if self._solver.getModelStatus() != highspy.HighsModelStatus.kOptimal:
                status = self._solver.modelStatusToString(self._solver.getModelStatus())
                raise RuntimeError(f"HiGHS ended the dispatch of an hour with {status}.")
            solution = self._solver.getSolution()
            x = np.asarray(solution.col_value)
            if not self._add_violated(fixed + self.units_ptdf @ x[:n], x[n], tolerance):
                break
        return Dispatched(float(x[n:].sum()), x[:n], self._dual(np.asarray(solution.row_dual)))

    def _row_arrays(self) -> tuple[npt.NDArray[np.int64], Floats]:
        branch = np.array([b for b, _ in self._rows], dtype=np.int64)
        return branch, np.array([s for _, s in self._rows], dtype=float)

    def _add_violated(self, flow: Floats, slack: float, tolerance: float) -> bool:
        """Add the rows of the worst violated lines; False when there is none."""
        over = abs(flow) - self.network.branches.rating - slack
        worst = np.argsort(-over)[:LINES_A_ROUND]
        added = False
        for b in worst[over[worst] > tolerance].tolist():
            key = (b, 1.0 if flow[b] > 0 else -1.0)
            if key in self._known:
                continue  # within the solver's tolerance of its row
            weights = key[1] * self.units_ptdf[b]
            used = np.flatnonzero(abs(weights) > 1e-12)
            self._solver.addRow(
                -self._inf,
                0.0,
                len(used) + 1,
                np.r_[used, len(self.p_min)].astype(np.int32),
                np.r_[weights[used], -1.0],
            )
            self._known.add(key)
            self._rows.append(key)
            added = True
        return added

    def _dual(self, row_dual: Floats) -> FlowCut:
        """Turn row duals into a cut that holds whatever their rounding: clipped, its constant recomputed."""
        network = self.network
        branch, sign = self._row_arrays()
        y = np.minimum(row_dual[1:], 0.0)
        y = y / max(1.0, -y.sum())
        y0 = float(np.clip(row_dual[0], -1.0, 1.0))
        by_branch = np.bincount(branch, y * sign, len(network.branches))
        pi = -(y0 + by_branch @ network.ptdf())
        reduced = -(y0 + by_branch @ self.units_ptdf)
        constant = (
            y @ network.branches.rating[branch]
            - by_branch @ network.shift_flow
            + np.where(reduced > 0, reduced * self.p_min, reduced * self.p_max).sum()
        )
        weight = np.bincount(branch, -y, len(network.branches))
        lines = tuple((int(b), float(weight[b])) for b in np.flatnonzero(weight > 1e-9))
        units = tuple(
            (int(g), float(abs(reduced[g])), bool(reduced[g] < 0))
            for g in np.flatnonzero(abs(reduced) > 1e-9)
        )
        return FlowCut(pi, float(constant), lines, units)
