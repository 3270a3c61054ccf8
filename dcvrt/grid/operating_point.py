"""A case at one hosting vector and period: power flow, initialisation, and fault after fault from there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from dcvrt.errors import InputError, SimulationError
from dcvrt.grid import redispatch
from dcvrt.grid.andes import NO_MACHINES, Said, quiet
from dcvrt.grid.copy_run import CopyRun
from dcvrt.grid.faults import Fault, Stage
from dcvrt.grid.native.fleet import ON_LIMIT
from dcvrt.grid.repeated import Copies
from dcvrt.grid.trapezoid import Stepper

Floats = npt.NDArray[np.float64]
Phasors = npt.NDArray[np.complex128]

POWER_FLOW_TOLERANCE = 1e-9
"""Largest mismatch, pu."""
FLAT_START_TOLERANCE = 1e-6
"""Largest residual of any equation before the fault, pu."""
SLACK_TOLERANCE = 1e-7
"""Largest difference between the unit at the slack bus and its share, pu."""
Q_TOLERANCE = 1e-6
"""Reactive power beyond a limit that counts as on it, pu."""


class OperatingPoint:
    """A case at one hosting vector and period, initialised and ready for faults.

    Parameters
    ----------
    system : andes.System
        As `read` gives it, with machines, not set up yet.
    hosted : mapping of bus to complex MVA, import positive
    wind : mapping of bus to MW
    load_scale : float
    faults : mapping of fault to its stages
        Those that `simulate` will be asked for.
    rule : str
        How the units share the change of load, one of `redispatch.RULES`.
    where : str
        What messages call the operating point.
    set_points : mapping of bus to pu, optional
        Voltages held instead of those of the case: where a unit at its reactive limit cannot hold its own.
    copies : int
        How many faults are simulated at a time.

    Raises
    ------
    SimulationError
        When power flow or initialisation has no solution, or a unit starts outside its limits.
    InfeasibleError
        When the units cannot supply the load.
    """

    def __init__(
        self,
        system: Any,
        hosted: Mapping[int, complex],
        wind: Mapping[int, float],
        load_scale: float,
        faults: Mapping[Fault, Sequence[Stage]],
        rule: str,
        where: str,
        set_points: Mapping[int, float] | None = None,
        copies: int = 1,
    ) -> None:
        self.system, self.where, self.faults = system, where, faults
        base = float(system.config.mva)
        volts = dict(zip(system.Bus.idx.v, system.Bus.Vn.v, strict=True))
        loads = int(system.PQ.n)
        for bus in dict.fromkeys([*hosted, *wind]):
            power = (complex(hosted.get(bus, 0.0)) - wind.get(bus, 0.0)) / base
            name = f"dcvrt load {bus}"
            system.add("PQ", {"idx": name, "bus": bus, "Vn": volts[bus], "p0": power.real, "q0": power.imag})
        shunts = {item for stages in faults.values() for stage in stages for item in stage.shunts.items()}
        self.fault_index = {item: f"dcvrt fault {k}" for k, item in enumerate(sorted(shunts, key=str))}
        for (bus, admittance), idx in self.fault_index.items():
            z = 1.0 / admittance
            system.add("Fault", {"idx": idx, "bus": bus, "tf": -1.0, "tc": -1.0, "xf": z.imag, "rf": z.real})
        self.copies = Copies(system, copies)
        self.buses = int(system.Bus.n) // copies
        with quiet() as said:
            system.setup()
            self.lines = [system.Line.idx.v[k] for k in np.flatnonzero(self._one(system.Line.u.v))]
            if not system.SynGen.n:
                raise InputError(NO_MACHINES.format(where=where))
            load = self._one(system.PQ.p0.v) * self._one(system.PQ.u.v)
            for power in (system.PQ.p0.v, system.PQ.q0.v):
                power.reshape(copies, -1)[:, :loads] *= load_scale
            more = float((self._one(system.PQ.p0.v) * self._one(system.PQ.u.v)).sum() - load[:loads].sum())
            for units in (system.PV, system.Slack):
                held = [
                    (set_points or {}).get(bus, v)
                    for bus, v in zip(units.bus.v, self._one(units.v0.v), strict=False)
                ]
                units.v0.v[:] = np.tile(held, copies)
            self._power_flow(rule, more)
            self._initialise(said)

    def _one(self, values: Any) -> Any:
        """Of values of all devices of a model those of one copy: all copies start alike."""
        return np.asarray(values[: len(values) // self.copies.count])

    # -- power flow ----------------------------------------------------------------------------------------

    def _power_flow(self, rule: str, more: float) -> None:
        """Solve for `more` load, pu, with the unit at the slack bus generating its share too."""
        system, slack = self.system, self.system.Slack
        system.PFlow.config.tol = POWER_FLOW_TOLERANCE
        units = (system.PV, slack)
        p_set = np.concatenate([self._one(unit.p0.v * unit.u.v) for unit in units])
        p_max = np.concatenate([self._one(unit.pmax.v) for unit in units])
        held = int(system.PV.n) // self.copies.count
        if rule == "slack":
            self._solve()
        else:
            total, surplus = float(p_set.sum()) + more, np.inf
            while abs(surplus) > SLACK_TOLERANCE:  # contracts: the losses change by a small part of the load
                p = redispatch.share(p_set, p_max, total, float(system.config.mva), self.where)
                system.PV.p0.v[:] = np.tile(p[:held], self.copies.count)
                self._solve()
                surplus = float(self._one(slack.p.v).sum() - p[held:].sum())
                total += surplus
        base = float(system.config.mva)
        self.generation: dict[int, complex] = {}
        for unit in units:
            for bus, p, q in zip(unit.bus.v, self._one(unit.p.v), self._one(unit.q.v), strict=False):
                self.generation[int(bus)] = self.generation.get(int(bus), 0j) + base * complex(p, q)
        self.beyond_q_limits = tuple(
            int(unit.bus.v[k])
            for unit in units
            for k in np.flatnonzero(
                self._one((unit.q.v > unit.qmax.v + Q_TOLERANCE) | (unit.q.v < unit.qmin.v - Q_TOLERANCE))
            )
        )
        if not (slack.p.v >= 0).all() or not (slack.p.v <= slack.pmax.v).all():
            raise SimulationError(
                f"{self.where}: the unit at slack bus {slack.bus.v[0]} would generate "
                f"{base * slack.p.v[0]:.0f} MW, outside 0 to {base * slack.pmax.v[0]:.0f} MW. "
                "Way out: redispatch='proportional', or host less."
            )

    def _solve(self) -> None:
        """One power flow."""
        system = self.system
        system.PFlow.run()
        if system.PFlow.converged:
            return
        bus = system.Bus
        mismatch = self._one(np.hypot(system.dae.g[bus.a.a], system.dae.g[bus.v.a]))
        worst = int(np.argmax(np.nan_to_num(mismatch, nan=np.inf)))
        raise SimulationError(
            f"{self.where}: power flow has no solution; the largest mismatch, "
            f"{mismatch[worst] * float(system.config.mva):.3g} MVA, is at bus {bus.idx.v[worst]}. "
            "Way out: host less there, or check load_scale and the voltage set points."
        )

    # -- initialisation ------------------------------------------------------------------------------------

    def _initialise(self, said: Said) -> None:
        """Initialise all dynamic devices; refuse a start that is not an equilibrium inside all limits."""
        system, tds = self.system, self.system.TDS
        limits: list[tuple[Any, Any]] = [
            (model, getattr(part, side))
            for model in system.exist.tds.values()
            if model.n
            for part in model.discrete.values()
            for side in ("lower", "upper")
            if hasattr(getattr(part, side, None), "vin")
        ]
        before = [limit.v.copy() for _, limit in limits]
        tds.config.no_tqdm = 1
        tds.config.criteria = 0
        tds.init()
        # Nothing is recorded there, but `reinit` of each fault makes empty tables of it: as long as 20 steps.
        system.dae.ts.reset = lambda: None
        if not tds.initialized:
            raise SimulationError(f"{self.where}: ANDES could not initialise the dynamic devices. {said}")
        moved, notes = [], []
        for (model, limit), value in zip(limits, before, strict=True):
            for k in np.flatnonzero(self._one(limit.v != value)):
                name = f"{model.class_name} '{model.idx.v[k]}'"
                beyond = abs(limit.v[k] - value[k])
                if beyond > ON_LIMIT:
                    moved.append(
                        f"{name}: {limit.name} = {value[k]:.4g} pu, but {limit.v[k]:.4g} pu is needed"
                    )
                else:
                    notes.append(f"{name}: {limit.name} by {beyond:.1g} pu")
        if moved:
            more = f"; and {len(moved) - 4} more" if len(moved) > 4 else ""
            raise SimulationError(
                f"{self.where}: {len(moved)} limit(s) are exceeded before the fault: {'; '.join(moved[:4])}"
                f"{more}. ANDES would widen them and say nothing. Way out: host less, or give the unit a "
                "wider limit."
            )
        self.variables = self.copies.variables()
        x, y = self.variables[0]
        own = np.concatenate([x, y + int(system.dae.n)])
        residual = np.abs(system.dae.fg[own])
        worst = int(np.argmax(np.nan_to_num(residual, nan=np.inf)))
        size, name = float(residual[worst]), system.dae.xy_name[own[worst]]
        clipped = self._clipped() if FLAT_START_TOLERANCE < size <= ON_LIMIT else []
        if not (size <= FLAT_START_TOLERANCE or clipped):
            raise SimulationError(
                f"{self.where}: the start is no equilibrium; the largest residual, {size:.3g} pu, "
                f"is that of {name}. {said}".rstrip()
            )
        self.notes = (*notes, *(f"{limit} by {size:.1g} pu" for limit in clipped))
        self.residual = size

    def _clipped(self) -> list[str]:
        """States that the start puts onto a limit of theirs, which is where a small residual comes from."""
        return [
            f"{model.class_name} '{model.idx.v[k]}': {getattr(part, side).name}"
            for model in self.system.exist.tds.values()
            if model.n
            for part in model.discrete.values()
            if type(part).__name__.startswith("AntiWindup")
            for side, flag in (("lower", part.zl), ("upper", part.zu))
            for k in np.flatnonzero(self._one(flag))
        ]

    @property
    def v0(self) -> Phasors:
        """Bus voltages before the fault, pu, in the order of the buses."""
        bus = self.system.Bus
        y = self.system.TDS._y_t0
        return self._one(y[bus.v.a] * np.exp(1j * y[bus.a.a]))

    def machine_admittance(self, reactance: Literal["subtransient", "transient"]) -> Phasors:
        """Admittance between each bus and the internal voltage of its machines, pu, in bus order.

        Parameters
        ----------
        reactance : str
            `subtransient`: the mean of x_d'' and x_q'', for the instant after inception; `transient`: x_d',
            for some cycles later. A classical machine has only x_d'.
        """
        system = self.system
        position = {idx: k for k, idx in enumerate(system.Bus.idx.v)}
        y = np.zeros(int(system.Bus.n), dtype=complex)
        for model in system.SynGen.models.values():
            if model.n:
                subtransient = reactance == "subtransient" and hasattr(model, "xd2")
                x = 0.5 * (model.xd2.v + model.xq2.v) if subtransient else model.xd1.v
                np.add.at(y, [position[bus] for bus in model.bus.v], model.ue.v / (model.ra.v + 1j * x))
        return self._one(y)

    def load_admittance(self) -> Phasors:
        """Admittance of the loads at the voltages before the fault, pu, in the order of the buses.

        They keep it in the fault.
        """
        system = self.system
        load = self._one(system.PQ.u.v * (system.PQ.p0.v - 1j * system.PQ.q0.v))
        place = {idx: k for k, idx in enumerate(system.Bus.idx.v)}
        position = [place[bus] for bus in self._one(np.array(system.PQ.bus.v))]
        y = np.zeros(self.buses, dtype=complex)
        np.add.at(y, position, load / np.abs(self.v0[position]) ** 2)
        return y

    # -- faults --------------------------------------------------------------------------------------------

    def simulate(
        self, faults: Sequence[Fault], times: Sequence[Floats], buses: Sequence[int]
    ) -> list[tuple[Phasors, str]]:
        """Voltages at `buses` on the times of the stretches between the changes of the network.

        Parameters
        ----------
        faults : sequence of BusFault, LineTrip or FaultSequence
            Of those the operating point was made for, at most as many as there are copies; their networks
            change at the same times.
        times : sequence of arrays
            One for each stage of the faults. The first ends where the second begins, and so on; both sides of
            a jump are returned.

        Returns
        -------
        list of (complex array (times, buses), str)
            For each fault the voltages up to the time reached, and how it ended: empty when the end was
            reached, else the sentence that says what happened.
        """
        with quiet():
            found = self._simulate(faults, times, buses)
            if len(faults) > 1:  # one that wants shorter steps than the others is simulated by itself
                for k, run in enumerate(found):
                    if run.collapsed:
                        found[k] = self._simulate([faults[k]], times, buses)[0]
        return [(np.array(run.samples), run.status) for run in found]

    def _simulate(
        self, faults: Sequence[Fault], times: Sequence[Floats], buses: Sequence[int]
    ) -> list[CopyRun]:
        system = self.system
        for copy in range(self.copies.count):
            self.enter(Stage(0.0), copy)
        system.TDS.reinit()
        before = system.dae.y.copy()
        stepper = Stepper(system, self.variables[: len(faults)])
        runs = [CopyRun(self, copy, self.faults[fault], buses) for copy, fault in enumerate(faults)]
        for _ in times[0]:  # an equilibrium, checked in `_initialise`: nothing moves before the fault
            for run in runs:
                run.record()
        for number, stretch in enumerate(times[1:], start=1):
            if not stepper.active:
                break
            stepper.t = float(stretch[0])
            guess = system.dae.y.copy()
            for copy in stepper.active:
                runs[copy].enter(number, guess, before)
            stepper.event(guess)
            for copy in list(stepper.active):
                if not runs[copy].recovered():
                    stepper.active.remove(copy)
            for t in stretch:
                if not stepper.active:
                    break
                if t > stretch[0]:
                    stepper.advance(float(t))
                for copy in list(stepper.active):
                    if not runs[copy].record():
                        stepper.active.remove(copy)
        for copy, failure in stepper.lost.items():
            runs[copy].collapse(failure.t, failure.variable)
        self.iterations, self.factorisations = stepper.iterations, stepper.factorisations
        return runs

    def enter(self, stage: Stage, copy: int) -> None:
        """Put the network of a copy into a stage: its faults on, its open branches out."""
        system, name = self.system, self.copies.name
        for item, idx in self.fault_index.items():
            system.Fault.uf.v[system.Fault.idx2uid(name(idx, copy))] = float(item in stage.shunts.items())
        for k, idx in enumerate(self.lines):
            line = name(idx, copy)
            if system.Line.u.v[system.Line.idx2uid(line)] != (k not in stage.out):
                system.set_status("Line", line, float(k not in stage.out))
