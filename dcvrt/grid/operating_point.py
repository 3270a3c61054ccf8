"""A case at one hosting vector and period: power flow, initialisation, and fault after fault from there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from dcvrt.errors import InputError, SimulationError
from dcvrt.grid import redispatch
from dcvrt.grid.andes import NO_MACHINES, Said, quiet
from dcvrt.grid.faults import Fault, Stage
from dcvrt.grid.native.fleet import ON_LIMIT
from dcvrt.grid.trapezoid import NoConvergenceError, Stepper

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
COLLAPSED = 0.01
"""Voltage just after clearing, pu, below which the faulted bus counts as not recovered."""
LOST_SYNCHRONISM = np.pi
"""Angle between a rotor and the centre of inertia, rad, from which on the rotor counts as out of step."""


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
        with quiet() as said:
            system.setup()
            self.lines = [system.Line.idx.v[k] for k in np.flatnonzero(system.Line.u.v)]
            if not system.SynGen.n:
                raise InputError(NO_MACHINES.format(where=where))
            reference = float(system.PQ.p0.v[:loads] @ system.PQ.u.v[:loads])
            system.PQ.p0.v[:loads] *= load_scale
            system.PQ.q0.v[:loads] *= load_scale
            for units in (system.PV, system.Slack):
                for k, bus in enumerate(units.bus.v):
                    units.v0.v[k] = (set_points or {}).get(bus, units.v0.v[k])
            self._power_flow(rule, float(system.PQ.p0.v @ system.PQ.u.v) - reference)
            self._initialise(said)

    # -- power flow ----------------------------------------------------------------------------------------

    def _power_flow(self, rule: str, more: float) -> None:
        """Solve for `more` load, pu, with the unit at the slack bus generating its share too."""
        system, slack = self.system, self.system.Slack
        system.PFlow.config.tol = POWER_FLOW_TOLERANCE
        units = (system.PV, slack)
        p_set = np.concatenate([unit.p0.v * unit.u.v for unit in units])
        p_max = np.concatenate([unit.pmax.v for unit in units])
        if rule == "slack":
            self._solve()
        else:
            total, surplus = float(p_set.sum()) + more, np.inf
            while abs(surplus) > SLACK_TOLERANCE:  # contracts: the losses change by a small part of the load
                p = redispatch.share(p_set, p_max, total, float(system.config.mva), self.where)
                system.PV.p0.v[:] = p[: system.PV.n]
                self._solve()
                surplus = float(slack.p.v.sum() - p[system.PV.n :].sum())
                total += surplus
        base = float(system.config.mva)
        self.generation: dict[int, complex] = {}
        for unit in units:
            for bus, p, q in zip(unit.bus.v, unit.p.v, unit.q.v, strict=True):
                self.generation[int(bus)] = self.generation.get(int(bus), 0j) + base * complex(p, q)
        self.beyond_q_limits = tuple(
            int(unit.bus.v[k])
            for unit in units
            for k in np.flatnonzero(
                (unit.q.v > unit.qmax.v + Q_TOLERANCE) | (unit.q.v < unit.qmin.v - Q_TOLERANCE)
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
        mismatch = np.hypot(system.dae.g[bus.a.a], system.dae.g[bus.v.a])
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
            for k in np.flatnonzero(limit.v != value):
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
        residual = np.abs(system.dae.fg)
        worst = int(np.argmax(np.nan_to_num(residual, nan=np.inf)))
        size, name = float(residual[worst]), system.dae.xy_name[worst]
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
            for k in np.flatnonzero(flag)
        ]

    @property
    def v0(self) -> Phasors:
        """Bus voltages before the fault, pu, in the order of the buses."""
        bus = self.system.Bus
        y = self.system.TDS._y_t0
        return np.asarray(y[bus.v.a] * np.exp(1j * y[bus.a.a]))

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
        y = np.zeros(system.Bus.n, dtype=complex)
        for model in system.SynGen.models.values():
            if model.n:
                subtransient = reactance == "subtransient" and hasattr(model, "xd2")
                x = 0.5 * (model.xd2.v + model.xq2.v) if subtransient else model.xd1.v
                np.add.at(y, [position[bus] for bus in model.bus.v], model.ue.v / (model.ra.v + 1j * x))
        return y

    def load_admittance(self) -> Phasors:
        """Admittance of the loads at the voltages before the fault, pu, in the order of the buses.

        They keep it in the fault.
        """
        system = self.system
        position = [list(system.Bus.idx.v).index(bus) for bus in system.PQ.bus.v]
        y = np.zeros(system.Bus.n, dtype=complex)
        load = system.PQ.u.v * (system.PQ.p0.v - 1j * system.PQ.q0.v)
        np.add.at(y, position, load / np.abs(self.v0[position]) ** 2)
        return y

    # -- faults --------------------------------------------------------------------------------------------

    def simulate(self, fault: Fault, times: Sequence[Floats], buses: Sequence[int]) -> tuple[Phasors, str]:
        """Voltages at `buses` on the times of the stretches between the changes of the network.

        Parameters
        ----------
        fault : BusFault, LineTrip or FaultSequence
            One of those the operating point was made for.
        times : sequence of arrays
            One for each stage of the fault. The first ends where the second begins, and so on; both sides of
            a jump are returned.

        Returns
        -------
        v : complex array (times, buses)
            Up to the time reached.
        status : str
            Empty when the end was reached, else the sentence that says what happened.
        """
        with quiet():
            try:
                return self._simulate(self.faults[fault], times, buses)
            finally:
                self._enter(Stage(0.0))

    def _enter(self, stage: Stage) -> None:
        """Put the network into a stage: its faults on, its open branches out."""
        system = self.system
        for item, idx in self.fault_index.items():
            system.Fault.uf.v[system.Fault.idx2uid(idx)] = float(item in stage.shunts.items())
        for k, idx in enumerate(self.lines):
            if system.Line.u.v[system.Line.idx2uid(idx)] != (k not in stage.out):
                system.set_status("Line", idx, float(k not in stage.out))

    def _simulate(
        self, stages: Sequence[Stage], times: Sequence[Floats], buses: Sequence[int]
    ) -> tuple[Phasors, str]:
        system = self.system
        system.TDS.reinit()
        place = {bus: k for k, bus in enumerate(system.Bus.idx.v)}
        address = [place[bus] for bus in buses]
        magnitude, angle = system.Bus.v.a[address], system.Bus.a.a[address]
        samples: list[Phasors] = []

        def record() -> None:
            y = system.dae.y
            samples.append(y[magnitude] * np.exp(1j * y[angle]))

        for _ in times[0]:  # an equilibrium, checked in `_initialise`: nothing moves before the fault
            record()
        stepper = Stepper(system)
        stepper.t = stages[1].begin
        rotor = _Rotors(system)
        before = system.dae.y.copy()
        what = ""
        try:
            for last, stage, stretch in zip(stages[:-1], stages[1:], times[1:], strict=True):
                cleared = [bus for bus in last.shunts if bus not in stage.shunts]
                what = "inception" if stage.shunts else "clearing" if cleared else "a change of branches"
                self._enter(stage)
                # In polar form V = 0 solves the balance of a bus without load, so that a search which starts
                # from the voltages of the fault ends there: the fault would never be cleared. Start from
                # those before it.
                stepper.event(before if cleared else system.dae.y.copy())
                for bus in cleared:
                    if system.Bus.v.v[place[bus]] < COLLAPSED:
                        raise NoConvergenceError(stage.begin, f"the voltage at bus {bus}")
                record()
                for t in stretch[1:]:
                    stepper.advance(float(t))
                    record()
                    lost = rotor.out_of_step()
                    if lost:
                        return np.array(samples), f"lost synchronism at t = {t:.3f} s: {lost}."
        except NoConvergenceError as failure:
            v = system.Bus.v.v
            low = int(np.argmin(v))
            return np.array(samples), (
                f"voltage collapse or numerical failure after {what}, at t = {failure.t:.4f} s: no "
                f"solution near the last one; {failure.variable} did not settle; lowest voltage "
                f"{v[low]:.2f} pu "
                f"at bus {system.Bus.idx.v[low]}."
            )
        finally:
            self.iterations, self.factorisations = stepper.iterations, stepper.factorisations
        return np.array(samples), ""


class _Rotors:
    """Rotor angles of all machines against their centre of inertia."""

    def __init__(self, system: Any) -> None:
        models = [model for model in system.SynGen.models.values() if model.n]
        self.system = system
        self.address = np.concatenate([model.delta.a for model in models])
        self.inertia = np.concatenate([model.M.v * model.ue.v for model in models])
        self.name = [f"{model.class_name} '{idx}'" for model in models for idx in model.idx.v]
        self.on = self.inertia > 0

    def out_of_step(self) -> str:
        """Say which machine is furthest from the centre of inertia, when that is half a turn or more."""
        delta = self.system.dae.x[self.address]
        away = np.where(self.on, np.abs(delta - delta @ self.inertia / self.inertia.sum()), 0.0)
        k = int(np.argmax(away))
        if away[k] <= LOST_SYNCHRONISM:
            return ""
        return f"{self.name[k]} is {np.rad2deg(away[k]):.0f} deg from the centre of inertia"
