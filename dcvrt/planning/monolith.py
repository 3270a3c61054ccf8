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


def build(problem: HostingProblem, hours: Integers, master: Master, point: Floats) -> Monolith:
    """Write out the problem for some hours (positions), its voltage rows linearised at `point`.

    `master` gives the columns and rows that belong to no hour; its cuts are left out.
    """
    network, year, sites = problem.network, problem.year, problem.sites
    n_bus, n_line, n_unit, n_hour = (
        len(network.bus),
        len(network.branches),
        len(network.generators),
        len(hours),
    )
    n_choice = len(sites) if master.may_close else 0
    head = master.with_choice() if n_choice else master.without_choice(np.ones(len(sites), dtype=bool))[0]
    names = master.names + [f"open_{bus}" for bus in sites[:n_choice]]
    n_head = len(names)
    smallest = np.zeros(len(sites)) if n_choice else master.lower
    rest = len(master.names) - len(sites)

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
        sp.hstack([sp.csr_matrix(head.matrix), sp.csr_matrix((len(head.low), n_hour * (n_bus + n_unit)))]),
        sp.hstack([sp.kron(year.dc[hours][:, None], site), sp.kron(sp.identity(n_hour), hour)]),
    ]
    low = [head.low, np.vstack([fixed, own[:, None] - rating]).T.ravel()]
    high = [head.high, np.vstack([fixed, own[:, None] + rating]).T.ravel()]
    lines = _unique([network.branches.label(b) for b in range(n_line)])
    row_names = head.names + [
        f"{name}_h{t}"
        for t in year.hours[hours]
        for name in [*(f"balance_{b}" for b in network.bus), *(f"flow_{line}" for line in lines)]
    ]
    outages = problem.certifier.outages
    if len(outages):
        blocks.append(
            sp.hstack(
                [sp.csr_matrix((n_hour * len(outages) * n_line, n_head)), _after_outages(problem, n_hour)]
            )
        )
        drift = own[:, None] + outages.factors * own[outages.branch]
        limit = np.repeat(outages.rating[:, None], len(outages), axis=1)
        low.append(np.tile((drift - limit).ravel(), n_hour))
        high.append(np.tile((drift + limit).ravel(), n_hour))
        row_names += [
            f"flow_{line}_without_{lines[k]}_h{t}"
            for t in year.hours[hours]
            for line in lines
            for k in outages.branch
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
        row_names += [
            f"V_{bus}_h{t}" for t in year.hours[hours] for bus in network.bus[problem.screen.moving]
        ]
    free = np.full(n_bus, np.inf)
    free[network.slack] = 0.0
    units = network.generators
    width = np.zeros(n_hour * (n_bus + n_unit))
    columns = names + [
        name
        for t in year.hours[hours]
        for name in [*(f"theta_{b}_h{t}" for b in network.bus), *(f"P_{unit}_h{t}" for unit in units.name)]
    ]
    unit_low, unit_high = problem.certifier.unit_ranges.limits(hours)
    return Monolith(
        cost=np.r_[master.cost, np.zeros(n_choice), width],
        lower=np.r_[
            smallest,
            np.zeros(rest),
            master.must_open[:n_choice],
            np.vstack([np.repeat(-free[:, None], n_hour, axis=1), unit_low]).T.ravel(),
        ],
        upper=np.r_[
            master.upper,
            np.full(rest, np.inf),
            np.ones(n_choice),
            np.vstack([np.repeat(free[:, None], n_hour, axis=1), unit_high]).T.ravel(),
        ],
        matrix=sp.vstack(blocks, format="csr"),
        row_lower=np.concatenate(low),
        row_upper=np.concatenate(high),
        whole=np.r_[np.zeros(len(master.names), bool), np.ones(n_choice, bool), np.zeros(len(width), bool)],
        columns=columns,
        rows=row_names,
    )


@dataclass(frozen=True, eq=False)
class _VoltageRows:
    slope: Floats
    low: Floats
    high: Floats


def _after_outages(problem: HostingProblem, n_hour: int) -> sp.csr_matrix:
    """Flows after each outage in the unknowns [theta; P] of the hours, branch by branch."""
    network, outages = problem.network, problem.certifier.outages
    flow = (sp.diags(network.susceptance) @ network.incidence).tocsr()
    n_line, count = outages.factors.shape
    before = flow[np.repeat(np.arange(n_line), count)]
    failed = flow[np.tile(outages.branch, n_line)]
    after = before + sp.diags(outages.factors.ravel()) @ failed
    units = sp.csr_matrix((after.shape[0], len(network.generators)))
    return sp.kron(sp.identity(n_hour), sp.hstack([after, units]), format="csr")


def _linearised(problem: HostingProblem, hours: Integers, point: Floats) -> _VoltageRows:
    """Voltage rows of the hours as `slope @ H` between bounds, hour by hour."""
    screen, ac = problem.screen, problem.ac
    assert screen is not None
    solved = ac.solve(point, hours).require() if point.any() else ac.unhosted.take(hours)
    slope = ac.slopes(solved, hours)
    constant = abs(solved.v[screen.moving]) - slope @ point
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
