"""Dispatch of one hour as a phase-1 linear programme, whose dual gives a cut for every hour."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dcvrt.grid.network import DENSE, Network
from dcvrt.planning.master import TOLERANCE, highs
from dcvrt.planning.security import Outages

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

LINES_A_ROUND = 10
ROOM = 5.0
"""Room that a dispatch keeps below every limit of a branch, as far as it can, MVA."""
STALLED = 1e-7
"""Tolerance of the simplex method where it does not reach that of the master programme, MW."""
INTACT = -1
"""In place of an outage: the network as it is."""


@dataclass(frozen=True)
class LineWeight:
    """How much the dual of a dispatch programme leans on the limit of a branch.

    Parameters
    ----------
    branch : int
        Position of the branch.
    outage : int
        Position of the branch that has failed, or `INTACT`.
    weight : float
        MW of shortfall that one more MVA of the limit takes away.
    """

    branch: int
    outage: int
    weight: float


@dataclass(frozen=True, eq=False)
class FlowCut:
    r"""Dual of a dispatch programme: no dispatch exists for bus injections n with
    :math:`\pi\cdot n + c + \rho^+\cdot\underline g - \rho^-\cdot\overline g > 0`.

    Only the right-hand side of the programme changes from hour to hour, so its dual speaks about every hour,
    with the unit limits of that hour. :math:`\rho` is :math:`\pi` at the buses of the units.

    Parameters
    ----------
    pi : array (buses,)
        Shortfall per MW injected.
    constant : float
        c, from ratings and phase shifters, MW.
    lines : tuple of LineWeight
    """

    pi: Floats
    constant: float
    lines: tuple[LineWeight, ...]


@dataclass(frozen=True, eq=False)
class Dispatched:
    """Result of one hour: the least shortfall in MW, unit outputs, and the dual where anything is short."""

    shortfall: float
    units: Floats
    cut: FlowCut | None


class HourDispatch:
    r"""Least shortfall of one hour, with the rows of lines and outages added as they are violated.

    .. math::
        \min\; s + u + v \quad \text{s.t.} \quad
        \mathbf 1 \cdot g + u - v = -\mathbf 1\cdot n, \qquad
        \pm (f_l + L_{lk} f_k)(n + C_g g) - s \le \overline f_{lk}, \qquad \underline g \le g \le \overline g

    Where nothing is short, s may fall to `-ROOM` in a second run: a dispatch with room serves other hours,
    where one at the limits, as the simplex method leaves it, serves few.

    Flows come from sparse solves and the coefficients of a row from one adjoint solve, so that large networks
    need no matrix of transfer factors.

    Parameters
    ----------
    network : Network
        Its ratings are the limits.
    outages : Outages
    """

    def __init__(self, network: Network, outages: Outages) -> None:
        import highspy

        self.network, self.outages = network, outages
        self._place = {int(branch): k for k, branch in enumerate(outages.branch)}
        self._inf = highspy.kHighsInf
        solver = highs()
        solver.setOptionValue("presolve", "off")  # a basis is always at hand
        solver.setOptionValue("solver", "simplex")
        n = self._count = len(network.generators)
        solver.addVars(n + 3, np.zeros(n + 3), np.r_[np.zeros(n), np.full(3, self._inf)])
        solver.changeColsCost(3, np.arange(n, n + 3, dtype=np.int32), np.ones(3))
        balance = np.r_[np.arange(n), n + 1, n + 2].astype(np.int32)
        solver.addRow(0.0, 0.0, n + 2, balance, np.r_[np.ones(n), 1.0, -1.0])
        self._solver = solver
        self._branch, self._outage = np.zeros(0, np.int64), np.zeros(0, np.int64)
        self._sign, self._high = np.zeros(0), np.zeros(0)
        self._known: set[tuple[int, int, float]] = set()
        self.solved = 0

    @property
    def pairs(self) -> int:
        """Pairs of branch and outage among the rows."""
        return len({(b, k) for b, k, _ in self._known if k != INTACT})

    def flows_of(self, units: Floats) -> Floats:
        """Branch flows that unit outputs drive, MW: (units,) or (units, hours)."""
        injection = np.zeros((len(self.network.bus), *units.shape[1:]))
        np.add.at(injection, self.network.generator_index, units)
        return self.network.transfer(injection)

    def solve(self, injection: Floats, low: Floats, high: Floats, tolerance: float = 1e-7) -> Dispatched:
        """Dispatch the units for the bus injections of an hour.

        Parameters
        ----------
        injection : array (buses,)
            MW, without the units.
        low, high : arrays (units,)
            Unit limits of the hour, MW.
        """
        n = self._count
        fixed = self.network.flows(injection)
        demand = -injection.sum()
        self._solver.changeColsBounds(n, np.arange(n, dtype=np.int32), low, high)
        x, row_dual = self._least(fixed, demand, tolerance)
        shortfall = float(x[n : n + 3].sum())
        if shortfall > 0:
            return Dispatched(shortfall, x[:n], self._dual(row_dual))
        if len(self.network.bus) > DENSE:  # the second run takes longer than it saves
            return Dispatched(0.0, x[:n], None)
        self._room(-ROOM, 0.0)
        x, _ = self._least(fixed, demand, tolerance)
        self._room(0.0, self._inf)
        return Dispatched(0.0, x[:n], None)

    def _room(self, low: float, high: float) -> None:
        """Bounds of s, and of u and v above."""
        at = np.arange(self._count, self._count + 3, dtype=np.int32)
        self._solver.changeColsBounds(3, at, np.r_[low, 0.0, 0.0], np.full(3, high))

    def _least(self, fixed: Floats, demand: float, tolerance: float) -> tuple[Floats, Floats]:
        """Columns and row duals of the optimum, with all rows that it violates added."""
        while True:
            count = len(self._branch) + 1
            self._solver.changeRowsBounds(
                count,
                np.arange(count, dtype=np.int32),
                np.r_[demand, np.full(count - 1, -self._inf)],
                np.r_[demand, self._high - self._sign * self._after(fixed)],
            )
            self._run()
            solution = self._solver.getSolution()
            x = np.asarray(solution.col_value)
            if not self._add_violated(fixed + self.flows_of(x[: self._count]), x[self._count], tolerance):
                return x, np.asarray(solution.row_dual)

    def _run(self) -> None:
        """Run the simplex method; where it stalls short of its tolerances, again without the old basis, and
        then to 1e-7 MW, still well within what a certificate lets pass. Cuts are made valid in any case."""
        import highspy

        for tolerance in (TOLERANCE, TOLERANCE, STALLED):
            for kind in ("primal", "dual"):
                self._solver.setOptionValue(f"{kind}_feasibility_tolerance", tolerance)
            self._solver.run()
            self.solved += 1
            status = self._solver.getModelStatus()
            if status == highspy.HighsModelStatus.kOptimal:
                return
            self._solver.clearSolver()
        raise RuntimeError(
            f"HiGHS ended the dispatch of an hour with {self._solver.modelStatusToString(status)}."
        )

    def _after(self, flow: Floats) -> Floats:
        """Flow that each row looks at, for the branch flows before any outage."""
        looked = flow[self._branch]
        failed = self._outage != INTACT
        if failed.any():
            column = [self._place[k] for k in self._outage[failed].tolist()]
            factor = self.outages.factors[self._branch[failed], column]
            looked[failed] += factor * flow[self._outage[failed]]
        return looked

    def _add_violated(self, flow: Floats, slack: float, tolerance: float) -> bool:
        """Add the rows of the worst violated limits; False when there is none."""
        rating = self.network.branches.rating
        fresh = [(b, INTACT, flow[b]) for b in _worst(abs(flow) - rating, slack + tolerance)]
        if len(self.outages):
            over = self.outages.over(flow)
            for at in _worst(over.ravel(), slack + tolerance):
                b, k = divmod(at, over.shape[1])
                after = flow[b] + self.outages.factors[b, k] * flow[self.outages.branch[k]]
                fresh.append((b, int(self.outages.branch[k]), after))
        keys = [(b, k, 1.0 if f > 0 else -1.0) for b, k, f in fresh]
        keys = [key for key in keys if key not in self._known]  # known: within the solver's tolerance
        if not keys:
            return False
        branch, outage, sign = (np.array(column) for column in zip(*keys, strict=True))
        weights = np.zeros((len(rating), len(keys)))
        for j, (b, k, s) in enumerate(keys):
            weights[b, j] += s
            if k != INTACT:
                weights[k, j] += s * self.outages.factors[b, self._place[k]]
        factors = self.network.adjoint(weights)[self.network.generator_index]
        for column in factors.T:
            used = np.flatnonzero(abs(column) > 1e-12)
            self._solver.addRow(
                -self._inf,
                0.0,
                len(used) + 1,
                np.r_[used, self._count].astype(np.int32),
                np.r_[column[used], -1.0],
            )
        self._known.update(keys)
        self._branch, self._outage = np.r_[self._branch, branch], np.r_[self._outage, outage]
        self._sign = np.r_[self._sign, sign]
        limit = np.where(outage == INTACT, rating[branch], self.outages.rating[branch])
        self._high = np.r_[self._high, limit]
        return True

    def _dual(self, row_dual: Floats) -> FlowCut:
        """Turn row duals into a cut that holds whatever their rounding: clipped, its constant recomputed."""
        network = self.network
        y = np.minimum(row_dual[1:], 0.0)
        y = y / max(1.0, -y.sum())
        y0 = float(np.clip(row_dual[0], -1.0, 1.0))
        weights = np.zeros(len(network.branches))
        np.add.at(weights, self._branch, y * self._sign)
        lines = []
        for r in np.flatnonzero(y).tolist():
            b, k = int(self._branch[r]), int(self._outage[r])
            if k != INTACT:
                weights[k] += y[r] * self._sign[r] * self.outages.factors[b, self._place[k]]
            if y[r] < -1e-9:
                lines.append(LineWeight(b, k, float(-y[r])))
        pi = -(y0 + network.adjoint(weights))
        return FlowCut(pi, float(y @ self._high - weights @ network.shift_flow), tuple(lines))


def _worst(over: Floats, least: float) -> list[int]:
    """Places of the largest entries above `least`, a round's worth of them."""
    if len(over) > LINES_A_ROUND:
        places = np.argpartition(-over, LINES_A_ROUND)[:LINES_A_ROUND]
    else:
        places = np.arange(len(over))
    places = places[over[places] > least]
    return [int(at) for at in places[np.argsort(-over[places], kind="stable")]]
