"""A transmission network as arrays in bus order, with its admittance matrix and its DC flow factors."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from scipy.sparse.csgraph import connected_components

from dcvrt.errors import InputError, did_you_mean, raise_all

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

KINDS = ("pq", "pv", "slack")
"""What power flow holds at a bus: P and Q, P and voltage, or voltage and angle."""
DENSE = 1000
"""Buses up to which dense matrices are quicker than sparse solves."""


@dataclass(frozen=True, eq=False)
class Branches:
    """Lines and transformers in service, as pi sections with an ideal transformer at the `from` side.

    Parameters
    ----------
    from_bus, to_bus : int arrays
        Bus numbers of the two ends.
    r, x, b : float arrays
        Series resistance, series reactance and total charging susceptance, pu on the system base.
    tap : float array
        Off-nominal turns ratio of the `from` side, 1 for a line.
    shift : float array
        Phase shift of the `from` side, rad.
    rating : float array
        Thermal rating, MVA; infinite where the case has none.
    """

    from_bus: Integers
    to_bus: Integers
    r: Floats
    x: Floats
    b: Floats
    tap: Floats
    shift: Floats
    rating: Floats

    def __post_init__(self) -> None:
        _freeze(self)

    def __len__(self) -> int:
        return len(self.from_bus)

    def label(self, k: int) -> str:
        """Name branch `k` by its ends."""
        return f"{self.from_bus[k]}-{self.to_bus[k]}"


@dataclass(frozen=True, eq=False)
class Generators:
    """Dispatchable units in service.

    Parameters
    ----------
    bus : int array
        Bus number of each unit.
    p_set, p_min, p_max : float arrays
        Scheduled output and its limits, MW.
    q_min, q_max : float arrays
        Reactive limits, MVAr.
    name : tuple of str
        `G10` for the unit at bus 10, `G10_2` for the second one there.
    """

    bus: Integers
    p_set: Floats
    p_min: Floats
    p_max: Floats
    q_min: Floats
    q_max: Floats
    name: tuple[str, ...]

    def __post_init__(self) -> None:
        _freeze(self)

    def __len__(self) -> int:
        return len(self.bus)


@dataclass(frozen=True, eq=False)
class Network:
    """Buses, branches and generators of one case; every bus array is in the order of `bus`.

    Parameters
    ----------
    name : str
        What messages call it.
    base_mva : float
        System base, MVA.
    bus : int array
        Bus numbers.
    kind : tuple of str
        `pq`, `pv` or `slack` for each bus.
    base_kv : float array
        Nominal voltage, kV.
    p_load, q_load : float arrays
        Demand at the reference load level, MW and MVAr.
    g_shunt, b_shunt : float arrays
        Shunt demand (MW) and shunt generation (MVAr) at 1 pu voltage.
    v_set : float array
        Voltage that `pv` and `slack` buses hold, pu; the start value elsewhere.
    branches : Branches
    generators : Generators
    slack_angle : float
        Angle of the voltage at the slack bus, rad.

    Raises
    ------
    InputError
        With every fault of the case at once: unknown buses, no slack bus, zero reactance, islands, NaN.
    """

    name: str
    base_mva: float
    bus: Integers
    kind: tuple[str, ...]
    base_kv: Floats
    p_load: Floats
    q_load: Floats
    g_shunt: Floats
    b_shunt: Floats
    v_set: Floats
    branches: Branches
    generators: Generators
    slack_angle: float = 0.0

    def __post_init__(self) -> None:
        _freeze(self)
        raise_all(_faults(self), self.name)

    # -- names ---------------------------------------------------------------------------------------------

    @cached_property
    def _position(self) -> dict[int, int]:
        return {int(number): k for k, number in enumerate(self.bus)}

    def index(self, bus: int) -> int:
        """Position of bus number `bus` in every bus array.

        Raises
        ------
        InputError
            When the network has no such bus.
        """
        try:
            return self._position[int(bus)]
        except (KeyError, TypeError, ValueError):
            raise InputError(f"{self.name} has no bus {bus!r}.{did_you_mean(bus, self.bus)}") from None

    def indices(self, buses: Sequence[int] | Integers) -> Integers:
        """Positions of several bus numbers, in the order given; all unknown ones are named at once."""
        unknown = [bus for bus in buses if bus not in self._position]
        if unknown:
            raise_all([f"no bus {bus!r}.{did_you_mean(bus, self.bus)}" for bus in unknown], self.name)
        return np.array([self._position[int(bus)] for bus in buses], dtype=np.int64)

    @cached_property
    def slack(self) -> int:
        """Position of the slack bus."""
        return self.kind.index("slack")

    @cached_property
    def from_index(self) -> Integers:
        """Bus position of the `from` end of each branch."""
        return self.indices(self.branches.from_bus)

    @cached_property
    def to_index(self) -> Integers:
        """Bus position of the `to` end of each branch."""
        return self.indices(self.branches.to_bus)

    @cached_property
    def generator_index(self) -> Integers:
        """Bus position of each generator."""
        return self.indices(self.generators.bus)

    # -- matrices ------------------------------------------------------------------------------------------

    def admittance(self) -> sp.csr_matrix:
        r"""Bus admittance matrix Y, pu on the system base: I = Y V.

        A branch with series admittance y, charging b and complex ratio a = tap e^{j shift} adds
        (y + jb/2)/|a|^2 and y + jb/2 to the two diagonals, -y/a^* and -y/a off them.
        """
        return self._admittance

    def admittance_without(self, out: Collection[int]) -> sp.csr_matrix:
        """Y with the branches at these positions open."""
        return self._admittance_of(
            np.setdiff1d(np.arange(len(self.branches)), np.array(list(out), dtype=int))
        )

    @cached_property
    def _admittance(self) -> sp.csr_matrix:
        return self._admittance_of(np.arange(len(self.branches)))

    def _admittance_of(self, closed: Integers) -> sp.csr_matrix:
        lines, n = self.branches, len(self.bus)
        series = 1.0 / (lines.r + 1j * lines.x)[closed]
        ratio = (lines.tap * np.exp(1j * lines.shift))[closed]
        at_to = series + 0.5j * lines.b[closed]
        at_from = at_to / (ratio * ratio.conj())
        shunt = (self.g_shunt + 1j * self.b_shunt) / self.base_mva
        f, t, every = self.from_index[closed], self.to_index[closed], np.arange(n)
        rows, columns = np.r_[f, f, t, t, every], np.r_[f, t, f, t, every]
        values = np.r_[at_from, -series / ratio.conj(), -series / ratio, at_to, shunt]
        return sp.csr_matrix((values, (rows, columns)), shape=(n, n))

    @cached_property
    def susceptance(self) -> Floats:
        """DC flow of each branch in MW per radian across it: base_mva / (x tap)."""
        return self.base_mva / (self.branches.x * self.branches.tap)

    @cached_property
    def incidence(self) -> sp.csr_matrix:
        """Branch-bus incidence: +1 at the `from` bus, -1 at the `to` bus."""
        m = len(self.branches)
        each = np.arange(m)
        values = np.r_[np.ones(m), -np.ones(m)]
        at = np.r_[each, each], np.r_[self.from_index, self.to_index]
        return sp.csr_matrix((values, at), shape=(m, len(self.bus)))

    @cached_property
    def _reduced_laplacian(self) -> tuple[Integers, Any]:
        """Buses but the slack, and the LU factors of the DC nodal matrix over them (it is symmetric)."""
        keep = np.delete(np.arange(len(self.bus)), self.slack)
        incidence = self.incidence[:, keep]
        return keep, spla.splu((incidence.T @ sp.diags(self.susceptance) @ incidence).tocsc())

    def _angles(self, injection: Floats) -> Floats:
        """DC bus angles in rad, 0 at the slack, which takes what the injections do not balance."""
        keep, factors = self._reduced_laplacian
        angles = np.zeros(injection.shape)
        angles[keep] = factors.solve(np.ascontiguousarray(injection[keep]))
        return angles

    def ptdf(self) -> Floats:
        """Power transfer distribution factors: DC branch flow per MW injected at a bus, taken at the slack.

        Returns
        -------
        array (branches, buses)
            Dense, and so meant for small networks: in larger ones `transfer` and `adjoint` give what is
            needed of it by sparse solves. The column of the slack bus is zero. See `flows` for the constant
            part that phase shifters add.
        """
        return self._ptdf

    @cached_property
    def _ptdf(self) -> Floats:
        factors = np.ascontiguousarray(self._flow_of_angle @ self._angles(np.eye(len(self.bus))))
        factors.flags.writeable = False
        return factors

    def transfer(self, injection: Floats) -> Floats:
        """DC branch flows in MW that injections drive, without those of phase shifters: PTDF @ injection.

        Parameters
        ----------
        injection : array (buses,) or (buses, count)
            MW; what they do not balance is taken at the slack bus.

        Returns
        -------
        array (branches,) or (branches, count)
        """
        if len(self.bus) <= DENSE:
            return self._ptdf @ injection
        return self._flow_of_angle @ self._angles(injection)

    @cached_property
    def _flow_of_angle(self) -> sp.csr_matrix:
        return (sp.diags(self.susceptance) @ self.incidence).tocsr()

    def adjoint(self, weights: Floats) -> Floats:
        r"""Weighted sum of rows of the transfer factors, :math:`\mathrm{PTDF}^T w`.

        Parameters
        ----------
        weights : array (branches,) or (branches, count)

        Returns
        -------
        array (buses,) or (buses, count)
            Change of the weighted flow per MW injected at each bus.
        """
        if len(self.bus) <= DENSE:
            return self._ptdf.T @ weights
        return self._angles(self._flow_of_angle.T @ weights)

    @cached_property
    def shift_flow(self) -> Floats:
        """Flow that the phase shifters drive with no injection at all, MW per branch."""
        own = -self.susceptance * self.branches.shift
        return own - self.transfer(self.incidence.T @ own)

    def flows(self, injection: Floats) -> Floats:
        """DC branch flows in MW for bus injections in MW: (buses,) or (buses, hours).

        What the injections do not balance is taken at the slack bus.
        """
        offset = self.shift_flow if injection.ndim == 1 else self.shift_flow[:, None]
        return self.transfer(injection) + offset

    def with_ratings(self, rating: Floats) -> Network:
        """The same network with other branch ratings, MVA; what was computed of it goes along."""
        fresh = replace(self, branches=replace(self.branches, rating=rating))
        for name in ("incidence", "_reduced_laplacian", "_flow_of_angle"):
            fresh.__dict__[name] = getattr(self, name)
        if len(self.bus) <= DENSE:
            fresh.__dict__["_ptdf"] = self._ptdf
        return fresh

    # -- where networks come from --------------------------------------------------------------------------

    @classmethod
    def from_matpower(cls, path: str | Path) -> Network:
        """Read a MATPOWER case file (version 2).

        Units, branches and buses that are out of service are left out; a rating of 0 means unlimited.

        Raises
        ------
        InputError
            When the file is missing or a table of it cannot be read, with the table and the line.
        """
        from dcvrt.grid import cases

        return cases.from_matpower(Path(path))

    @classmethod
    def ieee118(cls) -> Network:
        """IEEE 118-bus system: 118 buses, 54 units, 186 branches.

        Topology, loads, units and P_max are those of `case118.m` in the installed ANDES package; P_min is 0.
        The ratings are those of `case118_ieee` of PGLib-OPF v23.07 (`dcvrt/data/pglib`, CC BY 4.0), since
        the former has none.

        >>> network = Network.ieee118()
        >>> len(network.bus), len(network.generators), len(network.branches)
        (118, 54, 186)
        >>> network.branches.label(0), float(network.branches.rating[0])
        ('1-2', 151.0)
        """
        from dcvrt.grid import cases

        return cases.ieee118()


def _freeze(record: Any) -> None:
    """Give a frozen dataclass read-only copies of its arrays: what is derived from them stays true."""
    for field in fields(record):
        value = getattr(record, field.name)
        if isinstance(value, np.ndarray):
            own = value.copy()
            own.flags.writeable = False
            object.__setattr__(record, field.name, own)


def _faults(network: Network) -> list[str]:
    """Everything that makes the case unusable, as sentences."""
    problems: list[str] = []
    known = {int(number) for number in network.bus}
    lines, units = network.branches, network.generators
    if len(known) < len(network.bus):
        twice = sorted({int(b) for b in network.bus if (network.bus == b).sum() > 1})
        problems.append(f"bus {', '.join(map(str, twice))} is listed more than once.")
    slacks = [int(b) for b, kind in zip(network.bus, network.kind, strict=True) if kind == "slack"]
    if len(slacks) != 1:
        found = f"{len(slacks)} ({', '.join(map(str, slacks))})" if slacks else "none"
        problems.append(f"needs exactly one slack bus (type 3), found {found}.")
    for what, table in (("bus", network), ("branch", lines), ("generator", units)):
        for field in fields(table):
            value = getattr(table, field.name)
            if isinstance(value, np.ndarray) and value.dtype.kind == "f" and np.isnan(value).any():
                problems.append(
                    f"{what} column {field.name!r} has NaN in row {int(np.flatnonzero(np.isnan(value))[0])}."
                )
    for k in range(len(lines)):
        strange = [int(b) for b in (lines.from_bus[k], lines.to_bus[k]) if int(b) not in known]
        problems += [
            f"branch {lines.label(k)} ends at bus {b}, which is not in the bus table." for b in strange
        ]
        if lines.x[k] == 0:
            problems.append(
                f"branch {lines.label(k)} has zero reactance. Way out: merge its buses or give it 1e-4 pu."
            )
        if lines.rating[k] < 0:
            problems.append(f"branch {lines.label(k)} has the negative rating {lines.rating[k]:g} MVA.")
    for name, bus in zip(units.name, units.bus, strict=True):
        if int(bus) not in known:
            problems.append(f"generator {name} is at bus {bus}, which is not in the bus table.")
    for k in np.flatnonzero(units.p_min > units.p_max).tolist():
        problems.append(
            f"generator {units.name[k]} has p_min {units.p_min[k]:g} MW above p_max {units.p_max[k]:g} MW."
        )
    if not problems:
        groups, island = connected_components(
            abs(network.incidence.T) @ abs(network.incidence), directed=False
        )
        if groups > 1:
            cut_off = network.bus[island != island[network.slack]]
            shown = ", ".join(map(str, cut_off[:8])) + (", ..." if len(cut_off) > 8 else "")
            problems.append(
                f"{len(cut_off)} bus(es) have no path to the slack bus: {shown}. "
                "Way out: close a branch to them or leave them out."
            )
    return problems
