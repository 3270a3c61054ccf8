"""A grid that faults can be simulated on: POI waveforms for any hosting vector and operating period."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from dcvrt.dae import Dae
from dcvrt.errors import InputError, did_you_mean, raise_all
from dcvrt.grid import andes, dynamics118, redispatch
from dcvrt.grid.fault_run import FaultRun
from dcvrt.grid.faults import Fault, islanding
from dcvrt.grid.native.engine import Engine, sample_times, thetas
from dcvrt.grid.native.steady import Flow, loads
from dcvrt.grid.network import Network
from dcvrt.grid.operating_point import OperatingPoint
from dcvrt.grid.period import Period
from dcvrt.grid.request import Request
from dcvrt.models import Diagram
from dcvrt.models.machines import UnitBlock
from dcvrt.waveform import Waveform

Floats = npt.NDArray[np.float64]
Phasors = npt.NDArray[np.complex128]

STEP = 1.0 / 120.0
"""Default sample distance, s, and the step of ANDES: its complex voltages are 2e-4 pu off in a fault and
4e-4 pu
after, against 1/1920 s; twice the step takes half the time and has four times the error. The native engine
chooses its own steps."""


TOGETHER = 1000
"""Buses of all copies of a case in which ANDES evaluates several faults at a time. In larger systems the time
of an evaluation is that of its numbers, not of its calls."""


class _Found(NamedTuple):
    """What an engine gives of one fault: voltages (samples, sites) with their tangents."""

    fault: Fault
    t: Floats
    v: Phasors
    tangents: Mapping[str, Phasors]
    status: str
    notes: Sequence[str]


@dataclass(frozen=True, eq=False)
class Grid:
    """A transmission grid with candidate sites.

    Parameters
    ----------
    name : str
        What messages call it.
    path : Path
        Case file that ANDES reads.
    sites : tuple of int
        Candidate buses.
    pf : float
        Power factor of hosted load, lagging.
    dynamics : Path, optional
        File with the dynamic data, where the case keeps them apart.
    rule : bool
        Whether machines come from the rule table of the IEEE 118-bus case instead of the file.
    redispatch : str
        Who supplies a change of load. `proportional`: all scheduled units in proportion to their schedule, up
        to their limits, losses included; `slack`: the unit at the slack bus.
    reactive_limits : bool
        Whether the power flow keeps units within their reactive limits.
    load_model, wind_model : block of `dcvrt.models.machines`, optional
        What network loads and wind are in a fault, for the native engine: `ExponentialLoad`, `ZipLoad`,
        `CurrentConverter`. Impedances when not given.
    """

    name: str
    path: Path
    sites: tuple[int, ...]
    pf: float = 0.98
    dynamics: Path | None = None
    rule: bool = False
    redispatch: str = "proportional"
    reactive_limits: bool = False
    load_model: UnitBlock | None = None
    wind_model: UnitBlock | None = None

    @classmethod
    def from_case(
        cls,
        case: str | Path,
        sites: Sequence[int] = dynamics118.SITES,
        pf: float = 0.98,
        dynamics: str | Path | None = None,
        redispatch: str = "proportional",
        reactive_limits: bool = False,
        load_model: UnitBlock | None = None,
        wind_model: UnitBlock | None = None,
    ) -> Grid:
        """Open a case.

        Parameters
        ----------
        case : str or Path
            `ieee118`, or a file that ANDES reads: .raw, .xlsx, .json, .m.
        sites : sequence of int
            Candidate buses.
        pf : float
            Power factor of hosted load, lagging.
        dynamics : str or Path, optional
            File with the dynamic data (.dyr); for a .raw file the .dyr file beside it when not given.
        redispatch : str
            `proportional` or `slack`.
        reactive_limits : bool
            Whether the power flow keeps units within their reactive limits.
        load_model, wind_model : block of `dcvrt.models.machines`, optional
            What network loads and wind are in a fault, for the native engine; impedances when not given.

        Raises
        ------
        InputError
            Unknown case or file, a site that is no bus, a power factor outside (0, 1].
        """
        if str(case) == "ieee118":
            if dynamics is not None:
                raise InputError("ieee118 has its own dynamic data; dynamics= is for case files.")
            grid = cls("ieee118", andes.case118(), tuple(sites), pf, None, True, redispatch)
        else:
            path = Path(case)
            if not path.suffix:
                hint = did_you_mean(case, ["ieee118"])
                raise InputError(f"case {str(case)!r} is neither a built-in case nor a file.{hint}")
            beside = path.with_suffix(".dyr")
            if dynamics is None and path.suffix.lower() == ".raw" and beside.is_file():
                dynamics = beside
            given = Path(dynamics) if dynamics else None
            grid = cls(path.stem, path, tuple(sites), pf, given, False, redispatch)
        grid = replace(grid, reactive_limits=reactive_limits, load_model=load_model, wind_model=wind_model)
        grid._check()
        return grid

    @cached_property
    def network(self) -> Network:
        """Buses, branches and units, as both engines have them."""
        read = Network.ieee118() if self.rule else andes.read_network(self.path, self.dynamics, self.name)
        return andes.as_evaluated(read)

    def __getstate__(self) -> dict[str, object]:
        return {
            key: value for key, value in self.__dict__.items() if key not in ("network", "native", "flow")
        }

    # -- what is asked for ---------------------------------------------------------------------------------

    def waveforms(
        self,
        hosting: Mapping[int, float],
        fault: Fault,
        until: float = 2.5,
        period: Period | None = None,
        engine: str = "native",
        step: float = STEP,
        wrt: Sequence[str] = (),
        facilities: Mapping[int, Diagram | Dae] | None = None,
        values: Mapping[str, float] | None = None,
    ) -> dict[int, Waveform]:
        """POI voltage at every site under one fault.

        Parameters
        ----------
        hosting : mapping of site to MW
            Hosted capacity; a site that is left out hosts nothing.
        fault : BusFault, LineTrip or FaultSequence
        until : float
            End, s.
        period : Period, optional
            Operating period; default: reference load, no wind, data centres at full load.
        engine : str
            `native`: the compiled engine of dcvrt; `andes`: the equations as ANDES evaluates them.
        step : float
            Sample distance, s; ANDES steps by it too.
        wrt : sequence of str
            Quantities that the waveforms carry tangents of, with `native`: `H` (every site) or `H_<bus>`, MW;
            `wind_<bus>`, MW; `load`, factor on every load of the network; `clear`, time at which the fault is
            cleared, s; `beta`, rating of all facilities in the network.
        facilities : mapping of site to Diagram or Dae, optional
            Facilities that act back on the network, with `native`; what is hosted at other sites is a
            constant impedance in the fault. Each has the site's capacity, the period's load factor and the
            grid's power factor; its own `beta`. A Dae, once compiled, is prepared once; a Diagram in every
            call.
        values : mapping of parameter path to value, optional
            Values of the facilities' parameters in place of their own: ``{"beta": 1.2}``.

        Returns
        -------
        dict of bus to Waveform
            Complex, pu, in the network frame at omega_0. Inception and clearing are jumps: the time stands
            twice, with the exact voltage on each side. All waveforms for the same start, clearing and end
            have the same times.

        Raises
        ------
        InputError
            Bad buses, numbers or times, all at once, before anything runs.
        SimulationError
            When the simulation did not reach its end; the message says how it ended.
        InfeasibleError
            When the units cannot supply the load.
        """
        runs = self.waveforms_of(hosting, period, [fault], until, engine, step, wrt, facilities, values)
        return dict(runs[fault].require().waveforms)

    def waveforms_of(
        self,
        hosting: Mapping[int, float],
        period: Period | None,
        faults: Sequence[Fault],
        until: float = 2.5,
        engine: str = "native",
        step: float = STEP,
        wrt: Sequence[str] = (),
        facilities: Mapping[int, Diagram | Dae] | None = None,
        values: Mapping[str, float] | None = None,
    ) -> dict[Fault, FaultRun]:
        """Several faults of one operating point, which is solved and initialised once; see `waveforms`.

        A fault whose simulation does not reach its end stays in, with its status. An operating point that has
        no power flow or no equilibrium raises `SimulationError`: it has no faults to simulate.
        """
        asked = Request(
            hosting, period or Period(), faults, until, engine, step, wrt, facilities or {}, values or {}
        )
        asked.check(self)
        cut_off = {fault: islanding(self.network, fault.stages(self.network)) for fault in faults}
        whole = replace(asked, faults=[fault for fault, said in cut_off.items() if not said])
        by_engine = self._by_andes(whole) if engine == "andes" else self._by_own_engine(whole)
        simulated = {found.fault: found for found in by_engine}
        runs = {}
        for fault, said in cut_off.items():
            found = simulated.get(fault) or _Found(
                fault, np.zeros(0), np.zeros((0, 0), dtype=complex), {}, said, ()
            )
            name = f"{self.name}, {asked.period.name}, fault at {fault.label}"
            reached = () if found.status else enumerate(self.sites)
            waveforms = {
                bus: Waveform.from_samples(
                    found.t,
                    found.v[:, k],
                    {q: dv[:, k] for q, dv in found.tangents.items()},
                    name=f"{name}, bus {bus}",
                )
                for k, bus in reached
            }
            ended = found.status or "completed."
            if found.notes:
                ended += f" Counts as on its limit at the start: {'; '.join(found.notes)}."
            runs[fault] = FaultRun(fault, waveforms, f"{name}: {ended}")
        return runs

    def _by_andes(self, asked: Request) -> Iterator[_Found]:
        alike: dict[tuple[float, ...], list[Fault]] = {}  # networks that change at the same times
        for fault in asked.faults:
            alike.setdefault(tuple(stage.begin for stage in fault.stages(self.network)), []).append(fault)
        room = max(1, TOGETHER // len(self.network.bus))
        many = min(room, max(map(len, alike.values()), default=1))
        point = self.operating_point(asked.hosting, asked.period, asked.faults, many)
        for faults in alike.values():
            times = sample_times(point.faults[faults[0]], asked.until, asked.step)
            for k in range(0, len(faults), many):
                some = faults[k : k + many]
                for fault, (v, status) in zip(some, point.simulate(some, times, self.sites), strict=True):
                    yield _Found(fault, np.concatenate(times), v, {}, status, point.notes)

    def _by_own_engine(self, asked: Request) -> Iterator[_Found]:
        by = thetas(asked.wrt, self.sites, self.network)
        point = self.native.point(asked.hosting, asked.period, by, asked.facilities, asked.values)
        for fault in asked.faults:
            times = sample_times(fault.stages(self.network), asked.until, asked.step)
            run = self.native.simulate(point, fault, times, by)
            tangents = {q.name: run.tangents[:, k] for k, q in enumerate(by)}
            yield _Found(fault, np.concatenate(times), run.v, tangents, run.status, point.notes)

    @cached_property
    def native(self) -> Engine:
        """The native engine on this grid.

        Raises
        ------
        InputError
            When the case has a dynamic model that the engine lacks, with model, devices and count.
        """
        return Engine(
            self.network,
            andes.read_units(self.path, self.dynamics, self.machines, self.name),
            self.sites,
            1 + 1j * float(np.tan(np.arccos(self.pf))),
            self.redispatch,
            self.reactive_limits,
            self.load_model,
            self.wind_model,
        )

    @cached_property
    def flow(self) -> Flow:
        """Power flow of single operating points.

        Raises
        ------
        InputError
            When a bus has several units.
        """
        return Flow(self.network)

    @property
    def machines(self) -> Sequence[dynamics118.Machine]:
        """Machines that the rule table adds to the case file."""
        return dynamics118.machines(self.network) if self.rule else ()

    def operating_point(
        self,
        hosting: Mapping[int, float],
        period: Period | None = None,
        faults: Sequence[Fault] = (),
        copies: int = 1,
    ) -> OperatingPoint:
        """Solve power flow and initialise all machines; the arguments are those of `waveforms_of`, and how
        many faults are to be simulated at a time."""
        period = period or Period()
        system = andes.read(self.path, self.dynamics)
        if self.rule:
            andes.add_machines(system, self.machines)
        q_per_p = float(np.tan(np.arccos(self.pf)))
        hosted = {bus: period.dc_factor * hosting.get(bus, 0.0) * (1 + 1j * q_per_p) for bus in self.sites}
        where = f"{self.name}, {period.name}"
        return OperatingPoint(
            system,
            hosted,
            period.wind,
            period.load_scale,
            {fault: fault.stages(self.network) for fault in faults},
            self.redispatch,
            where,
            self._set_points(hosted, period, where) if self.reactive_limits else {},
            copies,
        )

    def _set_points(self, hosted: Mapping[int, complex], period: Period, where: str) -> dict[int, float]:
        """Voltages at which the units that cannot hold theirs give their reactive limit, pu.

        ANDES holds what it is given: it converts a unit beyond its limit, but never back.
        """
        load = loads(self.network, hosted, period.wind, period.load_scale)
        found = self.flow.solve(load, self.redispatch, True, where)
        return {bus: float(abs(found.v[self.network.index(bus)])) for bus in found.at_limit}

    # -- checks --------------------------------------------------------------------------------------------

    def _check(self) -> None:
        problems = []
        if not 0 < self.pf <= 1:
            problems.append(f"pf = {self.pf} must be above 0 and at most 1.")
        if not self.sites:
            problems.append("sites is empty: at least one candidate bus is needed.")
        if len(set(self.sites)) < len(self.sites):
            problems.append(f"sites {self.sites} names a bus twice.")
        if self.redispatch not in redispatch.RULES:
            hint = did_you_mean(self.redispatch, redispatch.RULES)
            problems.append(f"redispatch = {self.redispatch!r} is not known.{hint}")
        raise_all(problems + [f"site: {line}" for line in self.unknown(self.sites)], self.name)

    def unknown(self, buses: Sequence[int]) -> list[str]:
        """A sentence for every bus that the network does not have."""
        known = set(self.network.bus.tolist())
        return [f"no bus {bus}.{did_you_mean(bus, self.network.bus)}" for bus in buses if bus not in known]
