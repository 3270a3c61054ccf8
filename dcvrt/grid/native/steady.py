r"""Power flow of one operating point, with the units sharing what the load asks for, and its derivatives.

.. math::
    V_k \Big(\sum_m Y_{km} V_m\Big)^* = S^{gen}_k - S^{load}_k, \qquad
    P^{gen}_u = P_u(\kappa), \qquad \sum_u P_u(\kappa) = \kappa

with the total :math:`\kappa` as one more unknown: the unit at the slack bus generates its own share, losses
included. One Newton iteration for voltages and total together; its last Jacobian gives every derivative.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from dcvrt.errors import InputError, SimulationError
from dcvrt.grid import redispatch
from dcvrt.grid.network import Network
from dcvrt.grid.switching import LOOKS, Limited, reactive_limits_at, switched

Floats = npt.NDArray[np.float64]
Phasors = npt.NDArray[np.complex128]

TOLERANCE = 1e-11
"""Largest mismatch of a solution, pu."""
ACCEPTED = 1e-9
STEPS = 30


@dataclass(frozen=True, eq=False)
class Steady:
    """A solved operating point.

    Parameters
    ----------
    v : complex array (buses,)
        Voltages, pu.
    generation : complex array (buses,)
        What the units feed in, pu.
    load : complex array (buses,)
        Network load, hosted load and wind (negative), pu.
    p : array (generators,)
        Active power of each unit, pu.
    at_limit : tuple of int
        Buses whose voltage a reactive limit has let go.
    iterations : int
    """

    v: Phasors
    generation: Phasors
    load: Phasors
    p: Floats
    at_limit: tuple[int, ...]
    iterations: int
    _equations: Equations
    _share: Floats

    @cached_property
    def _factors(self) -> spla.SuperLU:
        current = np.asarray(self._equations.y @ self.v, dtype=np.complex128)
        return spla.splu(self._equations.jacobian(self.v, current, self._share))

    def derivatives(self, load: Phasors) -> tuple[Phasors, Phasors]:
        """Derivatives of voltages and generation by parameters that change the load.

        Parameters
        ----------
        load : complex array (buses, parameters)
            Derivative of the load, pu per unit of each parameter.

        Returns
        -------
        dv, dgeneration : complex arrays (buses, parameters)
        """
        equations = self._equations
        n, m = len(equations.free), len(equations.pq)
        right = np.vstack([load[equations.free].real, load[equations.pq].imag, load[[equations.slack]].real])
        move = -self._factors.solve(right)
        d_angle, d_size = np.zeros(load.shape), np.zeros(load.shape)
        d_angle[equations.free], d_size[equations.pq] = move[:n], move[n : n + m]
        v = self.v[:, None]
        dv = 1j * v * d_angle + v / abs(v) * d_size
        current, d_current = (equations.y @ self.v)[:, None], equations.y @ dv
        return dv, dv * current.conj() + v * d_current.conj() + load


class Equations:
    """Mismatch and Jacobian of one network with given held voltages; the pattern is laid out once.

    Unknowns are the angles of `free`, the magnitudes of `pq` and the total; rows are P of `free`, Q of `pq`
    and P of the slack bus. The slack bus keeps its angle; its voltage may be let go like any other.
    """

    def __init__(self, network: Network, held: npt.NDArray[np.bool_]) -> None:
        self.slack = network.slack
        self.pq = np.flatnonzero(~held)
        self.free = np.flatnonzero(np.arange(len(held)) != self.slack)
        self.y = network.admittance()
        y = (self.y + sp.eye(len(held)) * 0.0).tocoo()  # with every diagonal entry
        self._i, self._j, self._values = y.row, y.col, y.data
        self._diagonal = np.flatnonzero(y.row == y.col)
        n, m, size = len(self.free), len(self.pq), len(held)
        p_row, q_row = np.full(size, -1), np.full(size, -1)
        angle, magnitude = np.full(size, -1), np.full(size, -1)
        p_row[np.r_[self.free, self.slack]] = np.r_[np.arange(n), n + m]
        q_row[self.pq] = n + np.arange(m)
        angle[self.free], magnitude[self.pq] = np.arange(n), n + np.arange(m)
        rows, columns, sources = [], [], []
        for k, (row, column) in enumerate(
            ((p_row, angle), (q_row, angle), (p_row, magnitude), (q_row, magnitude))
        ):
            at = np.flatnonzero((row[self._i] >= 0) & (column[self._j] >= 0))
            rows.append(row[self._i[at]])
            columns.append(column[self._j[at]])
            sources.append(k * len(self._values) + at)
        self.p_buses = np.r_[self.free, self.slack]
        rows.append(np.r_[np.arange(n), n + m])
        columns.append(np.full(n + 1, n + m))
        sources.append(4 * len(self._values) + np.arange(n + 1))
        order = sp.csc_matrix(
            (np.arange(1, sum(map(len, rows)) + 1), (np.concatenate(rows), np.concatenate(columns))),
            shape=(n + m + 1, n + m + 1),
        )
        self._indices, self._indptr, self._shape = order.indices, order.indptr, order.shape
        self._source = np.concatenate(sources)[order.data - 1]

    def bus_of(self, row: int) -> int:
        """Position of the bus that a row belongs to."""
        return int(np.r_[self.free, self.pq, self.slack][row])

    def mismatch(self, v: Phasors, current: Phasors, scheduled: Phasors) -> Floats:
        """What the buses feed in less what is scheduled, pu."""
        power = v * current.conj() - scheduled
        return np.concatenate([power[self.free].real, power[self.pq].imag, power[[self.slack]].real])

    def jacobian(self, v: Phasors, current: Phasors, share: Floats) -> sp.csc_matrix:
        """Derivative of the mismatch by the unknowns; `share` of the total is generated at each bus."""
        moved = v[self._i] * (self._values * v[self._j]).conj()
        by_angle, by_size = -1j * moved, moved / abs(v)[self._j]
        by_angle[self._diagonal] += (1j * v * current.conj())[self._i[self._diagonal]]
        by_size[self._diagonal] += (v / abs(v) * current.conj())[self._i[self._diagonal]]
        entries = (by_angle.real, by_angle.imag, by_size.real, by_size.imag, -share[self.p_buses])
        return sp.csc_matrix(
            (np.concatenate(entries)[self._source], self._indices, self._indptr), shape=self._shape
        )


class Flow:
    """Power flow of one network, for any load.

    Parameters
    ----------
    network : Network

    Raises
    ------
    InputError
        When a bus has several units.
    """

    def __init__(self, network: Network) -> None:
        self.network = network
        units = network.generators
        if len(np.unique(units.bus)) < len(units):
            twice = sorted({int(b) for b in units.bus if (units.bus == b).sum() > 1})
            raise InputError(
                f"{network.name}: bus {', '.join(map(str, twice))} has several units; the native "
                "engine takes one "
                "a bus. Way out: join them into one unit, or engine='andes'."
            )
        self._equations: dict[bytes, Equations] = {}
        self.holding = np.flatnonzero(np.array(network.kind) != "pq")
        """Buses whose units hold the voltage, the slack bus among them."""
        self.q_low, self.q_high = reactive_limits_at(network, self.holding)

    def equations(self, held: npt.NDArray[np.bool_]) -> Equations:
        """Equations with these held voltages."""
        key = held.tobytes()
        if key not in self._equations:
            self._equations[key] = Equations(self.network, held)
        return self._equations[key]

    def solve(
        self,
        load: Phasors,
        rule: str = "proportional",
        reactive_limits: bool = False,
        where: str = "",
        near: Steady | None = None,
    ) -> Steady:
        """Solve for one load.

        Parameters
        ----------
        load : complex array (buses,)
            All that the buses take, pu: network load, hosted load, less wind.
        rule : str
            Who supplies a change of load, one of `redispatch.RULES`.
        reactive_limits : bool
            Whether a unit whose reactive power would leave its limits holds the limit instead of the voltage,
            that of the slack bus too.
        where : str
            What messages call the operating point.
        near : Steady, optional
            Where the search begins; at the held voltages when not given.

        Raises
        ------
        SimulationError
            When there is no solution, with the bus of the largest mismatch; when the unit at the slack bus
            would leave its limits.
        InfeasibleError
            When the units cannot supply the load.
        """
        network, where = self.network, where or self.network.name
        limited, v_set = np.zeros(len(self.holding), dtype=np.int8), network.v_set[self.holding]
        v = network.v_set * np.exp(1j * network.slack_angle) if near is None else near.v
        for look in range(LOOKS):
            keep = self.holding[limited == 0]
            v = v.copy()
            v[keep] *= network.v_set[keep] / abs(v[keep])
            found = self._newton(load, limited, rule, v, where)
            if not reactive_limits:
                break
            v = found.v
            q, size = found.generation[self.holding].imag, np.abs(v[self.holding])
            now = switched(limited, q, size, v_set, self.q_low, self.q_high, back=look < LOOKS // 2)
            if (now == limited).all():
                break
            limited = now
        else:
            raise SimulationError(
                f"{where}: units exchanged voltage and reactive limits {LOOKS} times without settling. Way "
                "out: reactive_limits=False, or check q_min and q_max."
            )
        self._check_slack(found, where)
        return found

    def _check_slack(self, found: Steady, where: str) -> None:
        network = self.network
        p = float(found.generation[network.slack].real) * network.base_mva
        highest = float(network.generators.p_max[network.generator_index == network.slack].sum())
        if not -1e-6 <= p <= highest + 1e-6:
            raise SimulationError(
                f"{where}: the unit at slack bus {network.bus[network.slack]} would generate {p:.0f} "
                "MW, outside "
                f"0 to {highest:.0f} MW. Way out: redispatch='proportional', or host less."
            )

    def _newton(
        self,
        load: Phasors,
        limited: Limited,
        rule: str,
        start: Phasors,
        where: str,
    ) -> Steady:
        network = self.network
        held, q_fixed = np.zeros(len(load), dtype=bool), np.zeros(len(load))
        held[self.holding] = limited == 0
        q_fixed[self.holding] = np.select([limited > 0, limited < 0], [self.q_high, self.q_low], 0.0)
        equations = self.equations(held)
        at, slack, y = network.generator_index, network.slack, equations.y
        base = network.base_mva
        p_set, p_max = network.generators.p_set / base, network.generators.p_max / base
        first = total = float(p_set.sum() + load.real.sum() - network.p_load.sum() / base)
        angle, size = np.angle(start), abs(start)
        n, m = len(equations.free), len(equations.pq)
        nearest, worst = np.inf, 0
        for step in range(STEPS + 1):
            p, weight = _dispatch(p_set, p_max, at == slack, total, rule)
            scheduled, share = 1j * q_fixed - load, np.zeros(len(load))
            np.add.at(scheduled, at, p)
            np.add.at(share, at, weight)
            v = size * np.exp(1j * angle)
            current = y @ v
            rest = equations.mismatch(v, current, scheduled)
            level = abs(rest).max()
            if step and level < nearest:
                nearest, worst = level, int(abs(rest).argmax())
            if step and (level < TOLERANCE or not np.isfinite(level) or step == STEPS):
                break
            try:
                factors = spla.splu(equations.jacobian(v, current, share))
            except RuntimeError:  # singular: the nose of the curve
                break
            move = factors.solve(rest)
            angle[equations.free] -= move[:n]
            size[equations.pq] -= move[n : n + m]
            total -= float(move[-1])
        if rule != "slack":  # raises where the units cannot supply it; a step of the search may go beyond
            redispatch.share(p_set, p_max, total if level < ACCEPTED else first, base, where)
        if not level < ACCEPTED:
            raise SimulationError(
                f"{where}: power flow has no solution; where Newton's method came nearest to one, the "
                f"largest mismatch, {nearest * base:.3g} MVA, is at bus "
                f"{network.bus[equations.bus_of(worst)]}. Way out: host less there, or check load_scale and "
                "the voltage set points."
            )
        let_go = self.holding[limited != 0]
        return Steady(
            v,
            v * current.conj() + load,
            load,
            p,
            tuple(int(b) for b in network.bus[let_go]),
            step,
            equations,
            share,
        )


def _dispatch(
    p_set: Floats, p_max: Floats, is_slack: npt.NDArray[np.bool_], total: float, rule: str
) -> tuple[Floats, Floats]:
    """Output of every unit at a total, and its derivative; continued beyond what the units can supply."""
    if rule == "slack":
        p = np.where(is_slack, total - p_set[~is_slack].sum(), p_set)
        return p, is_slack.astype(float)
    fixed, ceiling = np.where(p_set > 0, 0.0, p_set), np.where(p_set > 0, p_max, 0.0)
    beyond = total - fixed.sum() - ceiling.sum()
    if beyond > 0:
        weight = ceiling / ceiling.sum()
        return fixed + ceiling + beyond * weight, weight
    if total < fixed.sum():
        weight = np.where(p_set > 0, p_set, 0.0) / p_set[p_set > 0].sum()
        return fixed + (total - fixed.sum()) * weight, weight
    p = redispatch.share(p_set, p_max, total)
    weight = np.where((p_set > 0) & (p < p_max), p_set, 0.0)
    return p, weight / weight.sum() if weight.any() else weight


def loads(
    network: Network,
    hosted: Mapping[int, complex],
    wind: Mapping[int, float],
    load_scale: float,
) -> Phasors:
    """What the buses take, pu: network load times `load_scale`, hosted load (MVA), less wind (MW)."""
    taken = np.asarray(load_scale * (network.p_load + 1j * network.q_load), dtype=np.complex128)
    for bus, mva in hosted.items():
        taken[network.index(bus)] += mva
    for bus, mw in wind.items():
        taken[network.index(bus)] -= mw
    return np.asarray(taken / network.base_mva, dtype=complex)


def directions(
    network: Network, wrt: Sequence[tuple[str, int | None]], per_hosted: complex, load: Phasors
) -> Phasors:
    """Derivatives of the load, pu, one column a parameter.

    Parameters
    ----------
    wrt : pairs of kind and bus
        `H` (MW hosted at a bus), `wind` (MW fed in at a bus), `load` (factor on all network loads), `clear`
        (s; changes no load).
    per_hosted : complex
        MVA that a hosted MW takes.
    load : complex array (buses,)
        Network load at factor 1, pu.
    """
    change = np.zeros((len(network.bus), len(wrt)), dtype=complex)
    for k, (kind, bus) in enumerate(wrt):
        if kind == "load":
            change[:, k] = load
        elif bus is not None:
            change[network.index(bus), k] = (per_hosted if kind == "H" else -1.0) / network.base_mva
    return change
