"""The hosting problem written out whole, with bus angles and every row, for any solver to check."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from dcvrt.errors import InputError
from dcvrt.planning.master import Master, highs, model
from dcvrt.planning.plan import Row

if TYPE_CHECKING:
    import highspy

    from dcvrt.planning.hosting import HostingProblem

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Monolith:
    """Columns, rows and names of the whole programme; the first columns are the capacities.

    Columns: `H_<site>` MW, `open_<site>` where closing a site can help, then for each hour
    `theta_<bus>_h<hour>` rad and `P_<unit>_h<hour>` MW. Rows of an hour: `balance_<bus>`, `flow_<branch>`
    in MW, `V_<bus>` in pu.
    """

    cost: Floats
    lower: Floats
    upper: Floats
    matrix: sp.csr_matrix
    row_lower: Floats
    row_upper: Floats
    whole: npt.NDArray[np.bool_]
    columns: list[str]
    rows: list[str]

    def highs_model(self) -> highspy.HighsLp:
        """The programme as a HiGHS model."""
        lp = model(self.cost, self.lower, self.upper, self.matrix, self.row_lower, self.row_upper, self.whole)
        lp.col_names_, lp.row_names_ = self.columns, self.rows
        return lp

    def write(self, path: str | Path) -> None:
        """Write an MPS file."""
        import highspy

        path = Path(path)
        if path.suffix != ".mps":
            raise InputError(f"{path}: the file must be called .mps.")
        if not path.parent.is_dir():
            raise InputError(f"{path}: there is no folder {path.parent}.")
        solver = highs()
        solver.passModel(self.highs_model())
        if solver.writeModel(str(path)) == highspy.HighsStatus.kError:
            raise InputError(f"{path}: cannot be written.")


def build(problem: HostingProblem, hours: Integers, requirements: tuple[Row, ...], point: Floats) -> Monolith:
    """Write out the problem for some hours (positions), its voltage rows linearised at `point`."""
    network, year, sites = problem.network, problem.year, problem.sites
    n_bus, n_line, n_unit, n_hour = (
        len(network.bus),
        len(network.branches),
        len(network.generators),
        len(hours),
    )
    master = Master(sites, problem.lower, problem.upper, requirements)
    head, names = _head(master)
    n_head = len(names)

    # One hour: [balance; flow] in the unknowns [theta; P].
    flow = sp.diags(network.susceptance) @ network.incidence
    at_bus = sp.csr_matrix(
        (np.ones(n_unit), (network.generator_index, np.arange(n_unit))), shape=(n_bus, n_unit)
    )
    hour = sp.bmat([[network.incidence.T @ flow, -at_bus], [flow, None]], format="csr")
    site = sp.csr_matrix(
        (np.ones(len(sites)), (network.indices(sites), np.arange(len(sites)))), shape=(n_bus + n_line, n_head)
    )
    own = network.susceptance * network.branches.shift
    fixed = problem.certifier.fixed[:, hours] + (network.incidence.T @ own)[:, None]
    rating = np.repeat(network.branches.rating[:, None], n_hour, axis=1)
    blocks = [
        sp.hstack([head.matrix, sp.csr_matrix((len(head.low), n_hour * (n_bus + n_unit)))]),
        sp.hstack([sp.kron(year.dc[hours][:, None], site), sp.kron(sp.identity(n_hour), hour)]),
    ]
    low = [head.low, np.vstack([fixed, own[:, None] - rating]).T.ravel()]
    high = [head.high, np.vstack([fixed, own[:, None] + rating]).T.ravel()]
    lines = _unique([network.branches.label(b) for b in range(n_line)])
    row_names = head.rows + [
        f"{name}_h{t}"
        for t in year.hours[hours]
        for name in [*(f"balance_{b}" for b in network.bus), *(f"flow_{line}" for line in lines)]
    ]
    if problem.screen is not None:
        at_point = _linearised(problem, hours, point)
        blocks.append(
            sp.hstack(
                [
                    sp.csr_matrix(at_point.slope),
                    sp.csr_matrix((len(at_point.low), blocks[0].shape[1] - len(sites))),
                ]
            )
        )
        low.append(at_point.low)
        high.append(at_point.high)
        row_names += [f"V_{bus}_h{t}" for t in year.hours[hours] for bus in network.bus[problem.screen.pq]]
    free = np.full(n_bus, np.inf)
    free[network.slack] = 0.0
    units = network.generators
    width = np.zeros(n_hour * (n_bus + n_unit))
    columns = names + [
        name
        for t in year.hours[hours]
        for name in [*(f"theta_{b}_h{t}" for b in network.bus), *(f"P_{unit}_h{t}" for unit in units.name)]
    ]
    return Monolith(
        cost=np.r_[head.cost, width],
        lower=np.r_[head.lower, np.tile(np.r_[-free, units.p_min], n_hour)],
        upper=np.r_[head.upper, np.tile(np.r_[free, units.p_max], n_hour)],
        matrix=sp.vstack(blocks, format="csr"),
        row_lower=np.concatenate(low),
        row_upper=np.concatenate(high),
        whole=np.r_[head.whole, np.zeros(len(width), dtype=bool)],
        columns=columns,
        rows=row_names,
    )


@dataclass(frozen=True, eq=False)
class _Head:
    """Columns and rows that belong to no hour: capacities, open sites, requirements."""

    cost: Floats
    lower: Floats
    upper: Floats
    whole: npt.NDArray[np.bool_]
    matrix: sp.csr_matrix
    low: Floats
    high: Floats
    rows: list[str]


@dataclass(frozen=True, eq=False)
class _VoltageRows:
    slope: Floats
    low: Floats
    high: Floats


def _head(master: Master) -> tuple[_Head, list[str]]:
    n = len(master.sites)
    names = [f"H_{bus}" for bus in master.sites]
    requirement = [f"row{r}" for r in range(len(master.rows))]
    if not master.may_close:
        return _Head(
            np.ones(n),
            master.lower,
            master.upper,
            np.zeros(n, bool),
            sp.csr_matrix(master.coefficients),
            master.required,
            np.full(len(requirement), np.inf),
            requirement,
        ), names
    matrix, low, high = master.with_choice()
    choice = [f"{what}_{bus}" for what in ("largest", "smallest") for bus in master.sites]
    return _Head(
        np.r_[np.ones(n), np.zeros(n)],
        np.zeros(2 * n),
        np.r_[master.upper, np.ones(n)],
        np.r_[np.zeros(n, bool), np.ones(n, bool)],
        sp.csr_matrix(matrix),
        low,
        high,
        requirement + choice,
    ), names + [f"open_{bus}" for bus in master.sites]


def _linearised(problem: HostingProblem, hours: Integers, point: Floats) -> _VoltageRows:
    """Voltage rows of the hours as `slope @ H` between bounds, hour by hour."""
    screen, ac = problem.screen, problem.ac
    assert screen is not None
    v = ac.base[:, hours] if not point.any() else ac.solve(point, hours).require().v
    slope = ac.flow.sensitivities(v, ac.change, problem.year.dc[hours])
    constant = abs(v[screen.pq]) - slope @ point
    return _VoltageRows(
        slope.transpose(1, 0, 2).reshape(-1, len(point)),
        (screen.lower[:, hours] - constant).T.ravel(),
        (screen.upper[:, hours] - constant).T.ravel(),
    )


def _unique(names: list[str]) -> list[str]:
    """Number the parallel ones."""
    seen: dict[str, int] = {}
    result = []
    for name in names:
        seen[name] = seen.get(name, 0) + 1
        result.append(name if seen[name] == 1 else f"{name}_{seen[name]}")
    return result
