"""An operating point of the native engine: power flow, equilibrium, fault after fault from there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from dcvrt.errors import SimulationError
from dcvrt.grid.faults import Stage
from dcvrt.grid.native import ports as network_ports
from dcvrt.grid.native.build import unit_objects
from dcvrt.grid.native.fleet import Equilibrium, Group
from dcvrt.grid.native.ports import Ports
from dcvrt.grid.native.run import Fleet, Layout, NetworkTable, Options, Simulated, simulate
from dcvrt.grid.native.steady import Flow, Steady
from dcvrt.grid.network import Network

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]
Phasors = npt.NDArray[np.complex128]

AGREED = 1e-11
"""Difference, pu, at which the power that facilities draw and that of the power flow agree."""
ROUNDS = 50


@dataclass(frozen=True, eq=False)
class System:
    """A grid with its units, compiled once for all operating points.

    Parameters
    ----------
    flow : Flow
        Power flow of its network.
    groups : sequence of Group
    points : int array
        Positions of the buses whose voltage is asked for.
    facilities : sequence of Group
        Dynamic loads, one unit a site.
    """

    flow: Flow
    groups: tuple[Group, ...]
    points: Integers
    facilities: tuple[Group, ...] = ()

    def joined_by(self, devices: tuple[Group, ...], facilities: tuple[Group, ...]) -> System:
        """The same grid with more units."""
        return replace(self, groups=(*self.groups, *devices), facilities=facilities)

    @property
    def network(self) -> Network:
        """Buses, branches and generators."""
        return self.flow.network

    @property
    def all_groups(self) -> tuple[Group, ...]:
        """Generating units, then facilities."""
        return (*self.groups, *self.facilities)

    @cached_property
    def layout(self) -> Layout:
        """Units in lanes, with their compiled equations."""
        groups = self.all_groups
        objects = unit_objects([g.structure for g in groups], [len(g.units) for g in groups])
        return Layout(groups, tuple(objects))

    @cached_property
    def unit_bus(self) -> Integers:
        """Bus position of every unit, counted through the groups."""
        return self.network.indices([u.bus for g in self.all_groups for u in g.units])

    @cached_property
    def buses(self) -> Integers:
        """Buses with a port or a point, each once."""
        return np.unique(np.r_[self.unit_bus, self.points])

    @cached_property
    def places(self) -> tuple[Integers, Integers]:
        """Among `buses`: places of all units, and of all points."""
        return np.searchsorted(self.buses, self.unit_bus), np.searchsorted(self.buses, self.points)


class NativePoint:
    """A solved and initialised operating point.

    Parameters
    ----------
    system : System
    load, dload : complex arrays (buses,) and (buses, parameters)
        What the buses take as impedances, pu, and its derivatives.
    fed : mapping of `Group.power` to pair of such arrays
        Power that other units than generators feed in, and its derivatives.
    dvaried : sequence of arrays (units, varied, parameters)
        Derivatives of what is varied of the facilities, of each of their groups.
    rule : str
        How the units share the change of load.
    reactive_limits : bool
    where : str
        What messages call it.

    Raises
    ------
    SimulationError, InfeasibleError
        When power flow or equilibrium has no solution.
    """

    def __init__(
        self,
        system: System,
        load: Phasors,
        dload: Phasors,
        fed: Mapping[str, tuple[Phasors, Phasors]],
        dvaried: Sequence[Floats],
        rule: str,
        reactive_limits: bool,
        where: str,
    ) -> None:
        self.system, self.where, self._load, self._dload = system, where, load, dload
        taken = load - sum((power for power, _ in fed.values()), np.zeros_like(load))
        coupled = self._power_flow(taken, rule, reactive_limits)
        self._derivatives(dload - sum((d for _, d in fed.values()), np.zeros_like(dload)), coupled, dvaried)
        powers = {**fed, "generation": (self.steady.generation, self._dgeneration)}
        first = 0
        self.rest: list[Equilibrium] = []
        self._dx: list[Floats] = []
        self._dset: list[Floats] = []
        for group in system.groups:
            own = system.unit_bus[first : first + len(group.units)]
            first += len(group.units)
            current, moved = self._currents(group, own, *powers[group.power])
            rest = group.equilibrium(self.v0[own], current, where)
            dx, dset = rest.derivatives(self._dv[own], moved)
            self.rest.append(rest)
            self._dx.append(dx)
            self._dset.append(dset)
        for rest, moves in zip(coupled, dvaried, strict=True):
            n = len(rest.group.units)
            own = system.unit_bus[first : first + n]
            first += n
            dx, _ = rest.derivatives(self._dv[own], np.zeros((n, dload.shape[1]), dtype=complex), moves)
            self.rest.append(rest)
            self._dx.append(dx)
            self._dset.append(moves)

    def _power_flow(self, load: Phasors, rule: str, reactive_limits: bool) -> list[Equilibrium]:
        """Solve it with the power that the facilities draw at rest at the voltages that it gives."""
        system = self.system
        at = system.unit_bus[sum(len(g.units) for g in system.groups) :]
        v = np.ones(len(load), dtype=complex)
        drawn = np.zeros(len(at), dtype=complex)
        steady: Steady | None = None
        for _ in range(ROUNDS):
            fed, first = [], 0
            for group in system.facilities:
                own = at[first : first + len(group.units)]
                first += len(group.units)
                fed.append(group.equilibrium(v[own], np.zeros(len(own), dtype=complex), self.where))
            before = drawn
            drawn = np.concatenate([*(-v[g] * f.current.conj() for g, f in self._at(fed, at)), np.zeros(0)])
            total = load.copy()
            np.add.at(total, at, drawn)
            if steady is not None and np.abs(drawn - before).max() < AGREED:
                return fed
            self.steady = steady = system.flow.solve(total, rule, reactive_limits, self.where, steady)
            v = steady.v
            if not len(at):
                return fed
        raise SimulationError(
            f"{self.where}: the power that the facilities draw and the voltages of the power flow did "
            "not agree in "
            f"{ROUNDS} rounds. Way out: host less."
        )

    @staticmethod
    def _at(fed: Sequence[Equilibrium], at: Integers) -> list[tuple[Integers, Equilibrium]]:
        ends = np.cumsum([0, *(len(rest.group.units) for rest in fed)])
        return [(at[a:b], rest) for a, b, rest in zip(ends, ends[1:], fed, strict=False)]

    def _derivatives(self, taken: Phasors, fed: Sequence[Equilibrium], dvaried: Sequence[Floats]) -> None:
        """Derivatives of voltages and generation; what facilities draw follows the voltage."""
        d = self._dload.shape[1]
        self._dv = self._dgeneration = np.zeros((len(self.v0), d), dtype=complex)
        if not d:
            return
        at = self.system.unit_bus[sum(len(g.units) for g in self.system.groups) :]
        for _ in range(ROUNDS):
            dload, before = taken.copy(), self._dv
            for (own, rest), moves in zip(self._at(fed, at), dvaried, strict=True):
                v, dv, i = self.v0[own, None], before[own], rest.current[:, None]
                di = rest.current_derivative(dv, moves)
                np.add.at(dload, own, -(dv * i.conj() + v * di.conj()))
            self._dv, self._dgeneration = self.steady.derivatives(dload)
            if np.abs(self._dv - before).max() <= 1e-12 * np.abs(self._dv).max():
                return
        raise SimulationError(
            f"{self.where}: derivatives of the power flow did not settle. Way out: host less."
        )

    def _currents(self, group: Group, at: Integers, fed: Phasors, dfed: Phasors) -> tuple[Phasors, Phasors]:
        """Current of each unit into the network, from its part of the power that is fed in at its bus."""
        v, dv = self.steady.v[at], self._dv[at]
        p, q = (np.array([getattr(u, f"share_{x}") for u in group.units]) for x in "pq")
        power, moved = fed[at], dfed[at]
        s = p * power.real + 1j * q * power.imag
        ds = p[:, None] * moved.real + 1j * q[:, None] * moved.imag
        current = (s / v).conj()
        return current, ((ds - current.conj()[:, None] * dv) / v[:, None]).conj()

    @property
    def v0(self) -> Phasors:
        """Bus voltages before the fault, pu."""
        return self.steady.v

    @cached_property
    def residual(self) -> float:
        """Largest residual of the equilibrium."""
        return max((rest.residual for rest in self.rest), default=0.0)

    @property
    def notes(self) -> tuple[str, ...]:
        """Units that start beyond a limit by so little that they count as on it."""
        return tuple(note for rest in self.rest for note in rest.notes)

    @cached_property
    def fleet(self) -> Fleet:
        """The units, ready to run."""
        return Fleet(self.system.layout, self.rest, self._dx, self._dset, len(self.system.points))

    # -- networks ------------------------------------------------------------------------------------------

    @cached_property
    def _diagonal(self) -> Phasors:
        """Loads at their voltage before the fault, and what the network holds for the units."""
        y = self._load.conj() / abs(self.v0) ** 2
        shunts = np.concatenate([*(g.shunts() for g in self.system.all_groups), np.zeros(0)])
        np.add.at(y, self.system.unit_bus, shunts)
        return y

    @cached_property
    def _ddiagonal(self) -> Phasors | None:
        """Derivatives of the loads' admittance."""
        if not self._dload.shape[1]:
            return None
        size = abs(self.v0)[:, None]
        d_size = (self.v0.conj()[:, None] * self._dv).real / size
        load = self._load[:, None]
        return self._dload.conj() / size**2 - 2.0 * load.conj() / size**3 * d_size

    def _ports(self, out: frozenset[int]) -> Ports:
        if out not in self._topologies:
            network = self.system.network
            y = network.admittance_without(out) if out else network.admittance()
            self._topologies[out] = Ports((y + sp.diags(self._diagonal)).tocsc(), self.system.buses)
        return self._topologies[out]

    @cached_property
    def _topologies(self) -> dict[frozenset[int], Ports]:
        return {}

    def _network(self, stage: Stage) -> NetworkTable:
        network = self.system.network
        out = frozenset(stage.out)
        shunts = {network.index(bus): y for bus, y in stage.shunts.items()}
        z, dz = self._ports(out).impedances(shunts, self._ddiagonal)
        return network_ports.table(z, dz, *self.system.places)

    @cached_property
    def _before(self) -> NetworkTable:
        return self._network(Stage(0.0))

    # -- faults --------------------------------------------------------------------------------------------

    def simulate(
        self,
        stages: Sequence[Stage],
        times: Sequence[Floats],
        options: Options,
        moves: Mapping[int, Floats] | None = None,
    ) -> Simulated:
        """Voltages at the points through the stages of a fault.

        Parameters
        ----------
        stages : sequence of Stage
            The first is the network as it is, from time 0.
        times : sequence of arrays
            Sample times of each stage; each begins and ends with the ends of the stage.
        moves : mapping of stage number to array (parameters,), optional
            Derivative of the time at which the stage begins.
        """
        d = self._dload.shape[1]
        still = np.zeros(d)
        pieces = []
        for k, (stage, samples) in enumerate(zip(stages, times, strict=True)):
            if not k:
                continue
            unchanged = not stage.shunts and not stage.out
            network = self._before if unchanged else self._network(stage)
            pieces.append(
                (float(samples[0]), float(samples[-1]), network, samples, (moves or {}).get(k, still))
            )
        v_start = self.v0[self.system.unit_bus[self.system.layout.unit_of_port]]
        found = simulate(self.fleet, pieces, v_start, options)
        at = self.system.points
        before = np.tile(self.v0[at], (len(times[0]), 1))
        d_before = np.tile(self._dv[at].T[None], (len(times[0]), 1, 1))
        return Simulated(
            np.concatenate([before, found.v]),
            np.concatenate([d_before, found.tangents]),
            found.status,
            found.events,
            found.steps,
            found.rejected,
            found.end,
        )
