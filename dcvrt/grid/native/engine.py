"""A grid as the native engine runs it: units in groups of one structure, operating points, derivatives."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt

from dcvrt.dae import Dae
from dcvrt.errors import InputError, did_you_mean, raise_all
from dcvrt.grid import units as described
from dcvrt.grid.faults import Fault, Stage
from dcvrt.grid.native.fleet import Group, Unit
from dcvrt.grid.native.point import NativePoint, System
from dcvrt.grid.native.run import MOST_DIRECTIONS, Options, Simulated
from dcvrt.grid.native.steady import Flow, directions, loads
from dcvrt.grid.native.structure import SCALE, Structure
from dcvrt.grid.network import Network
from dcvrt.grid.period import Period
from dcvrt.models import Diagram
from dcvrt.models.machines import UnitBlock, alone, setpoints

Floats = npt.NDArray[np.float64]
Phasors = npt.NDArray[np.complex128]

RATING = "beta"
"""Parameter that rates the converter of a facility; the same at all sites where it is a quantity."""
SEEN_OF_A_FACILITY = 3.0
"""How much coarser the states of a facility may be than those of machines: the network sees of them the
current, times size and impedance at the bus, 0.3 pu and less, so that voltages stay as exact."""
QUANTITY = re.compile(r"(?:(?P<kind>H|wind)_(?P<bus>\d+)|(?P<whole>load|clear|beta))")


@dataclass(frozen=True)
class Theta:
    """A quantity that waveforms are differentiated by.

    Parameters
    ----------
    name : str
        As tangents are called: `H_21`, `wind_69`, `load`, `clear`, `beta`.
    kind : str
    bus : int, optional
    """

    name: str
    kind: str
    bus: int | None


def thetas(wrt: Sequence[str], sites: Sequence[int], network: Network) -> tuple[Theta, ...]:
    """Quantities by name: `H` stands for `H_<bus>` of every site.

    Raises
    ------
    InputError
        With every name that is none; when there are more than a run carries.
    """
    if isinstance(wrt, str):
        raise InputError(f"{network.name}: wrt = {wrt!r} must be a tuple of names: wrt=({wrt!r},).")
    names = [name for w in wrt for name in ([f"H_{b}" for b in sites] if w == "H" else [w])]
    found, problems = [], []
    for name in dict.fromkeys(names):
        match = QUANTITY.fullmatch(name)
        if match is None:
            problems.append(
                f"wrt: {name!r} is not known. It takes H (all sites), H_<bus>, wind_<bus>, load "
                "(factor on every "
                "load), clear (s) and beta (rating of the facilities)."
            )
            continue
        bus = None if match["bus"] is None else int(match["bus"])
        if match["kind"] == "H" and bus not in sites:
            problems.append(f"wrt: {name!r}: bus {bus} is not one of the sites {', '.join(map(str, sites))}.")
        elif bus is not None and bus not in set(network.bus.tolist()):
            problems.append(f"wrt: {name!r}: no bus {bus}.")
        found.append(Theta(name, match["kind"] or match["whole"], bus))
    if len(found) > MOST_DIRECTIONS:
        problems.append(
            f"wrt: {len(found)} quantities; one run carries derivatives by {MOST_DIRECTIONS} at most. "
            "Way out: ask for them in several calls."
        )
    raise_all(problems, network.name, InputError)
    return tuple(found)


def groups(units: Iterable[described.Unit]) -> tuple[Group, ...]:
    """Units in groups of one structure, each compiled once."""
    by_structure: dict[Any, list[described.Unit]] = {}
    for unit in units:
        by_structure.setdefault(unit.structure, []).append(unit)
    made = []
    for same in by_structure.values():
        dae = same[0].diagram().compile()
        behind = next(path for path in ("machine.x_q", "machine.x_d1") if path in dae.p_names)
        structure = Structure(
            dae, setpoints=setpoints(dae), angle="machine.delta", inertia="machine.M", reactance=behind
        )
        made.append(Group(structure, [Unit(u.name, u.bus, u.values, u.share_p, u.share_q) for u in same]))
    return tuple(made)


@dataclass(frozen=True, eq=False)
class Engine:
    """A grid ready for any operating point.

    Parameters
    ----------
    network : Network
    units : sequence of dcvrt.grid.units.Unit
    sites : sequence of int
    per_hosted : complex
        MVA that a hosted MW takes.
    rule : str
        Who supplies a change of load, one of `redispatch.RULES`.
    reactive_limits : bool
        Whether units respect their reactive limits in the power flow.
    load_model, wind_model : UnitBlock, optional
        What network loads and wind are in a fault, a block for each bus that has any; impedances when not
        given.
    """

    network: Network
    units: tuple[described.Unit, ...]
    sites: tuple[int, ...]
    per_hosted: complex
    rule: str = "proportional"
    reactive_limits: bool = False
    load_model: UnitBlock | None = None
    wind_model: UnitBlock | None = None
    options: Options = field(default_factory=Options)

    @cached_property
    def system(self) -> System:
        """Units and network, compiled."""
        return System(Flow(self.network), groups(self.units), self.network.indices(self.sites))

    def point(
        self,
        hosting: Mapping[int, float],
        period: Period,
        wrt: Sequence[Theta] = (),
        facilities: Mapping[int, Diagram | Dae] | None = None,
        values: Mapping[str, float] | None = None,
    ) -> NativePoint:
        """Solve and initialise an operating point; the arguments are those of `Grid.waveforms`.

        Raises
        ------
        SimulationError, InfeasibleError
            When there is no power flow or no equilibrium.
        """
        network, coupled = self.network, self._coupled(hosting, period, wrt, facilities or {}, values or {})
        own = {unit.bus for group in coupled for unit in group.units}
        scale = period.dc_factor * self.per_hosted
        hosted = {bus: 0j if bus in own else scale * hosting.get(bus, 0.0) for bus in self.sites}
        own_load, wind = loads(network, {}, {}, period.load_scale), -loads(network, {}, period.wind, 0.0)
        outside = [("", None) if q.kind == "H" and q.bus in own else (q.kind, q.bus) for q in wrt]

        def change(*kinds: str) -> Phasors:
            kept = [(kind, bus) if kind in kinds else ("", None) for kind, bus in outside]
            return directions(network, kept, scale, loads(network, {}, {}, 1.0))

        load, changes = loads(network, hosted, {}, 0.0), change("H")
        fed: dict[str, tuple[Phasors, Phasors]] = {}
        for kind, model, power, moved in (
            ("load", self.load_model, -own_load, -change("load")),
            ("wind", self.wind_model, wind, -change("wind")),
        ):
            if model is None:
                load, changes = load - power, changes - moved
            else:
                fed[kind] = power, moved
        varied = [self._varied(group, wrt) for group in coupled]
        where = f"{network.name}, {period.name}"
        system = self._system(tuple(self._devices(fed)), coupled)
        return NativePoint(system, load, changes, fed, varied, self.rule, self.reactive_limits, where)

    def _system(self, devices: tuple[Group, ...], coupled: tuple[Group, ...]) -> System:
        return self.system.joined_by(devices, coupled) if devices or coupled else self.system

    def _devices(self, fed: Mapping[str, tuple[Phasors, Phasors]]) -> Iterable[Group]:
        """Loads and wind as units, one at each bus that has any."""
        for kind, (power, _) in fed.items():
            model = self.load_model if kind == "load" else self.wind_model
            assert model is not None
            if kind not in self._of_devices:
                dae = alone(model).compile()
                self._of_devices[kind] = Structure(dae, setpoints=setpoints(dae))
            structure = self._of_devices[kind]
            units = [Unit(f"{kind} at bus {bus}", int(bus), {}) for bus in self.network.bus[power != 0]]
            if units:
                yield Group(structure, units, kind)

    @cached_property
    def _of_devices(self) -> dict[str, Structure]:
        return {}

    def _varied(self, group: Group, wrt: Sequence[Theta]) -> Floats:
        """Derivatives (units, varied, quantities) of sizes and ratings of facilities."""
        names = group.structure.varied
        moved = np.zeros((len(group.units), len(names), len(wrt)))
        for k, quantity in enumerate(wrt):
            if quantity.kind == "H":
                own = [unit.bus == quantity.bus for unit in group.units]
                moved[own, names.index(SCALE), k] = 1.0 / self.network.base_mva
            elif quantity.kind == RATING and RATING in names:
                moved[:, names.index(RATING), k] = 1.0
        return moved

    def _coupled(
        self,
        hosting: Mapping[int, float],
        period: Period,
        wrt: Sequence[Theta],
        facilities: Mapping[int, Diagram | Dae],
        values: Mapping[str, float],
    ) -> tuple[Group, ...]:
        """Facilities as units, those of one diagram together; a site that hosts nothing has none, unless its
        first megawatt is asked about."""
        asked = {quantity.bus for quantity in wrt if quantity.kind == "H"}
        alike: dict[int, list[int]] = {}
        for bus, facility in facilities.items():
            if hosting.get(bus, 0.0) > 0 or bus in asked:
                alike.setdefault(id(facility), []).append(bus)
        pf = float(np.cos(np.angle(self.per_hosted)))
        given = {"H": 1.0, "d": period.dc_factor, "pf": pf, **values}
        made = []
        for buses in alike.values():
            facility = facilities[buses[0]]
            structure = self._structure_of(facility)
            names = structure.dae.p_names
            wanted = [*values, *(RATING for quantity in wrt if quantity.kind == RATING)]
            for path in wanted:
                if path not in names:
                    raise InputError(
                        f"{self.network.name}: facility {facility.name} at bus {buses[0]} has no parameter "
                        f"{path!r}.{did_you_mean(path, names)}"
                    )
            known = {path: value for path, value in given.items() if path in names}
            allowed = self._allowed.setdefault(structure, set())
            if tuple(known.items()) not in allowed:
                try:
                    structure.dae.parameter_values(**known)
                except InputError as error:
                    raise InputError(
                        f"{self.network.name}, {period.name}: facility {facility.name} at bus {buses[0]} "
                        f"cannot run there: {error} Way out: another dc_factor or pf, or no facility at "
                        "this bus."
                    ) from None
                allowed.add(tuple(known.items()))
            units = [
                Unit(
                    f"facility {facility.name}",
                    bus,
                    known | {SCALE: hosting.get(bus, 0.0) / self.network.base_mva},
                )
                for bus in buses
            ]
            made.append(Group(structure, units, tolerance=SEEN_OF_A_FACILITY, quick=True))
        return tuple(made)

    def _structure_of(self, facility: Diagram | Dae) -> Structure:
        """What the network sees of a facility; kept for a compiled one, which can't change."""
        if isinstance(facility, Diagram):
            return self._seen(facility.compile())
        if facility not in self._structures:
            self._structures[facility] = self._seen(facility)
        return self._structures[facility]

    @staticmethod
    def _seen(dae: Dae) -> Structure:
        return Structure(
            dae, "v_poi", "i", -1.0, varied=(SCALE, RATING) if RATING in dae.p_names else (SCALE,)
        )

    @cached_property
    def _allowed(self) -> WeakKeyDictionary[Structure, set[tuple[tuple[str, float], ...]]]:
        """Values with which a facility was seen to run; the same at all operating points of a period."""
        return WeakKeyDictionary()

    @cached_property
    def _structures(self) -> WeakKeyDictionary[Dae, Structure]:
        return WeakKeyDictionary()

    def simulate(
        self, point: NativePoint, fault: Fault, times: Sequence[Floats], wrt: Sequence[Theta] = ()
    ) -> Simulated:
        """One fault from a point; `wrt` as the point was made with."""
        stages = fault.stages(self.network)
        clear = np.array([float(q.kind == "clear") for q in wrt])
        last = len(stages) - 1
        return point.simulate(stages, times, self.options, {last: clear} if clear.any() else None)


def sample_times(stages: Sequence[Stage], until: float, step: float) -> list[Floats]:
    """Even sample times in every stage; each has its own two ends."""
    ends = [*(stage.begin for stage in stages[1:]), until]
    return [
        np.linspace(stage.begin, end, int(np.ceil((end - stage.begin) / step - 1e-9)) + 1)
        for stage, end in zip(stages, ends, strict=True)
    ]
