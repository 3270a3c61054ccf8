"""The bridge to ANDES: reads cases, solves power flow and simulates faults. No other file imports andes."""

from __future__ import annotations

import contextlib
import importlib.util
import io
import logging
import os
import shutil
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from dcvrt.errors import InputError, SimulationError
from dcvrt.grid import redispatch
from dcvrt.grid.dynamics118 import Machine
from dcvrt.grid.faults import BusFault
from dcvrt.grid.network import Branches, Generators, Network
from dcvrt.grid.trapezoid import NoConvergence, Stepper

Floats = npt.NDArray[np.float64]
Phasors = npt.NDArray[np.complex128]

POWER_FLOW_TOLERANCE = 1e-9
"""Largest mismatch, pu."""
FLAT_START_TOLERANCE = 1e-6
"""Largest residual of any equation before the fault, pu."""
SLACK_TOLERANCE = 1e-7
"""Largest difference between the unit at the slack bus and its share, pu."""
COLLAPSED = 0.01
"""Voltage just after clearing, pu, below which the faulted bus counts as not recovered."""
LOST_SYNCHRONISM = np.pi
"""Angle between a rotor and the centre of inertia, rad, from which on the rotor counts as out of step."""

# -- the generated code ------------------------------------------------------------------------------------


def cache_folder() -> Path:
    """Folder for what can be made again: `$DCVRT_CACHE_DIR`, or `dcvrt` in the user's cache folder."""
    own = os.environ.get("DCVRT_CACHE_DIR")
    if own:
        return Path(own)
    if os.name == "nt":
        return Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData" / "Local")) / "dcvrt" / "cache"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "dcvrt"


def code_folder() -> Path:
    """Where the code that ANDES generates from its models is kept; one folder per version of ANDES and Python."""
    return cache_folder() / f"andes-{version('andes')}-py{sys.version_info.major}.{sys.version_info.minor}"


def prepared() -> bool:
    """Whether the generated code is there."""
    return (code_folder() / "__init__.py").is_file()


def prepare() -> Path:
    """Let ANDES generate its numerical code, once per version; later calls return at once.

    Takes up to half a minute and says so on standard error. Processes that start at the same time do not disturb
    each other: one generates, the others wait for it.

    Returns
    -------
    Path
        The folder of the code.

    Raises
    ------
    SimulationError
        When the generation fails; with the last line that it wrote.
    """
    folder = code_folder()
    if prepared():
        return folder
    folder.parent.mkdir(parents=True, exist_ok=True)
    with _lock(folder.with_suffix(".lock")):
        if not prepared():
            print(f"dcvrt: ANDES generates its code once, up to half a minute, into {folder}", file=sys.stderr, flush=True)
            _generate(folder)
    return folder


def _generate(folder: Path) -> None:
    """Generate into a temporary folder by a process of its own, then move it: a half-made folder is never seen."""
    fresh = Path(tempfile.mkdtemp(prefix=".andes-", dir=folder.parent))
    code = ("import sys; from andes.system import System; "
            "s = System(no_undill=True, no_output=True, default_config=True, pycode_path=sys.argv[1]); "
            "s.prepare(quick=True, nomp=True)")
    try:
        done = subprocess.run([sys.executable, "-W", "ignore", "-c", code, str(fresh)], capture_output=True, text=True,
                              check=False)
        if done.returncode or not (fresh / "__init__.py").is_file():
            said = (done.stderr or done.stdout).strip().splitlines()
            raise SimulationError(f"ANDES could not generate its code in {fresh.parent}: {said[-1] if said else 'no message'}. "
                                  "Way out: set DCVRT_CACHE_DIR to a folder that can be written.")
        shutil.rmtree(folder, ignore_errors=True)
        os.replace(fresh, folder)
    finally:
        shutil.rmtree(fresh, ignore_errors=True)


@contextlib.contextmanager
def _lock(path: Path, patience: float = 300.0) -> Iterator[None]:
    """Hold a lock file; one left behind longer than `patience` seconds is taken over."""
    while True:
        try:
            os.close(os.open(path, os.O_CREAT | os.O_EXCL))
            break
        except FileExistsError:
            with contextlib.suppress(FileNotFoundError):
                if time.time() - path.stat().st_mtime > patience:
                    path.unlink()
            time.sleep(0.2)
    try:
        yield
    finally:
        path.unlink(missing_ok=True)


class _Said(logging.Handler):
    """Keeps what ANDES logs as errors, for our own message."""

    def __init__(self) -> None:
        super().__init__(logging.ERROR)
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append(record.getMessage().strip().splitlines()[0] if record.getMessage().strip() else "")

    def __str__(self) -> str:
        return " ".join(line for line in self.lines[:3] if line)


@contextlib.contextmanager
def _quiet() -> Iterator[_Said]:
    """Keep ANDES's prints, logs and warnings from the user; errors that it logs are collected."""
    log, said = logging.getLogger("andes"), _Said()
    before = log.handlers[:], log.level, log.propagate
    log.handlers, log.propagate = [said], False
    log.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            yield said
    finally:
        log.handlers, log.propagate = before[0], before[2]
        log.setLevel(before[1])


# -- cases -------------------------------------------------------------------------------------------------


def case118() -> Path:
    """Path of `case118.m` in the installed ANDES package."""
    spec = importlib.util.find_spec("andes")  # located, not imported: importing it takes a second
    if spec is None or spec.origin is None:
        raise InputError("ieee118: the case file comes with the package 'andes', which is not installed. "
                         "Way out: pip install andes.")
    return Path(spec.origin).parent / "cases" / "matpower" / "case118.m"


def read(path: Path, dynamics: Path | None = None) -> Any:
    """Read a case file into an ANDES system that can still be added to.

    Raises
    ------
    InputError
        When a file is missing or ANDES cannot read it; with what ANDES says.
    """
    for file in (path, dynamics):
        if file is not None and not file.is_file():
            raise InputError(f"{file}: no such file. Way out: a path of a .raw (+ .dyr), .xlsx, .json or .m file, or 'ieee118'.")
    code = prepare()
    with _quiet() as said:
        import andes

        try:
            system = andes.load(str(path), setup=False, use_input_path=False, no_output=True, default_config=True,
                                addfile=str(dynamics) if dynamics else None, pycode_path=str(code))
        except Exception as error:  # its parsers raise whatever they run into
            raise InputError(f"{path}: ANDES cannot read it: {type(error).__name__}: {error}") from error
    if system is None or said.lines:
        raise InputError(f"{path}: ANDES cannot read it. {said}".rstrip())
    return system


def read_network(path: Path, dynamics: Path | None, name: str) -> Network:
    """Read the network of a case file, loads at their reference level; see `read`."""
    system = read(path, dynamics)
    with _quiet():
        system.setup()
    base = float(system.config.mva)
    bus, position = system.Bus, {idx: k for k, idx in enumerate(system.Bus.idx.v)}
    strange = [idx for idx in bus.idx.v if not isinstance(idx, (int, np.integer))]
    if strange:
        raise InputError(f"{name}: bus {strange[0]!r} has no number. Way out: number the buses.")
    p, q, g, b = (np.zeros(bus.n) for _ in range(4))
    np.add.at(p, [position[x] for x in system.PQ.bus.v], system.PQ.p0.v * system.PQ.u.v * base)
    np.add.at(q, [position[x] for x in system.PQ.bus.v], system.PQ.q0.v * system.PQ.u.v * base)
    np.add.at(g, [position[x] for x in system.Shunt.bus.v], system.Shunt.g.v * system.Shunt.u.v * base)
    np.add.at(b, [position[x] for x in system.Shunt.bus.v], system.Shunt.b.v * system.Shunt.u.v * base)
    kind, v_set, units = ["pq"] * bus.n, np.array(bus.v0.v, dtype=float), []
    for model, held in ((system.PV, "pv"), (system.Slack, "slack")):
        for k in np.flatnonzero(model.u.v):
            at = position[model.bus.v[k]]
            kind[at], v_set[at] = held, model.v0.v[k]
            units.append((model.bus.v[k], *(base * column.v[k] for column in
                                            (model.p0, model.pmin, model.pmax, model.qmin, model.qmax))))
    unit = np.array(units, dtype=float).reshape(-1, 6)
    lines, on = system.Line, np.flatnonzero(system.Line.u.v)
    return Network(
        name=name, base_mva=base, bus=np.array(bus.idx.v, dtype=np.int64), kind=tuple(kind),
        base_kv=np.array(bus.Vn.v, dtype=float), p_load=p, q_load=q, g_shunt=g, b_shunt=b, v_set=v_set,
        branches=Branches(
            from_bus=np.array(lines.bus1.v, dtype=np.int64)[on], to_bus=np.array(lines.bus2.v, dtype=np.int64)[on],
            r=lines.r.v[on], x=lines.x.v[on], b=lines.b.v[on], tap=lines.tap.v[on], shift=lines.phi.v[on],
            rating=np.where(lines.rate_a.v[on] > 0, lines.rate_a.v[on] * base, np.inf)),
        generators=Generators(
            bus=unit[:, 0].astype(np.int64), p_set=unit[:, 1], p_min=unit[:, 2], p_max=unit[:, 3], q_min=unit[:, 4],
            q_max=unit[:, 5], name=tuple(f"unit {k + 1} at bus {int(x)}" for k, x in enumerate(unit[:, 0]))))


def add_machines(system: Any, units: Sequence[Machine]) -> None:
    """Add machine, exciter and governor of each unit to a system that is not set up yet."""
    static = {bus: idx for model in (system.PV, system.Slack) for bus, idx in zip(model.bus.v, model.idx.v, strict=True)}
    volts = dict(zip(system.Bus.idx.v, system.Bus.Vn.v, strict=True))
    for unit in units:
        for model, values in unit.models.items():
            if model == "GENROU":
                own = {"idx": f"machine {unit.bus}", "bus": unit.bus, "gen": static[unit.bus], "Sn": unit.s_n,
                       "Vn": volts[unit.bus], "fn": 60.0, "M": 2.0 * values["H_m"],
                       **{symbol: value for symbol, value in values.items() if symbol != "H_m"}}
            else:
                own = {"idx": f"{model} {unit.bus}", "syn": f"machine {unit.bus}", **values}
            system.add(model, own)


# -- one operating point -----------------------------------------------------------------------------------


class OperatingPoint:
    """A case at one hosting vector and period, initialised and ready for faults.

    Parameters
    ----------
    system : andes.System
        As `read` gives it, with machines, not set up yet.
    hosted : mapping of bus to complex MVA, import positive
    wind : mapping of bus to MW
    load_scale : float
    faults : sequence of BusFault
        Those that `simulate` will be asked for.
    rule : str
        How the units share the change of load, one of `redispatch.RULES`.
    where : str
        What messages call the operating point.

    Raises
    ------
    SimulationError
        When power flow or initialisation has no solution, or a unit starts outside its limits.
    InfeasibleError
        When the units cannot supply the load.
    """

    def __init__(self, system: Any, hosted: Mapping[int, complex], wind: Mapping[int, float], load_scale: float,
                 faults: Sequence[BusFault], rule: str, where: str) -> None:
        self.system, self.where = system, where
        base = float(system.config.mva)
        volts = dict(zip(system.Bus.idx.v, system.Bus.Vn.v, strict=True))
        loads = int(system.PQ.n)
        for bus, mva in {**hosted, **{bus: -mw for bus, mw in wind.items() if bus not in hosted}}.items():
            mva = complex(mva) - (wind.get(bus, 0.0) if bus in hosted else 0.0)
            system.add("PQ", {"idx": f"dcvrt load {bus}", "bus": bus, "Vn": volts[bus], "p0": mva.real / base,
                              "q0": mva.imag / base})
        self.fault_index = {fault: f"dcvrt fault {k}" for k, fault in enumerate(dict.fromkeys(faults))}
        for fault, idx in self.fault_index.items():
            system.add("Fault", {"idx": idx, "bus": fault.bus, "tf": -1.0, "tc": -1.0, "xf": fault.x_f, "rf": fault.r_f})
        with _quiet() as said:
            system.setup()
            if not system.SynGen.n:
                raise InputError(f"{where}: the case has no dynamic data, not one machine. Way out: add a machine "
                                 "(GENROU, GENCLS) for each generator, in a .dyr file given as dynamics=... or in the case itself.")
            reference = float(system.PQ.p0.v[:loads] @ system.PQ.u.v[:loads])
            system.PQ.p0.v[:loads] *= load_scale
            system.PQ.q0.v[:loads] *= load_scale
            self._power_flow(rule, float(system.PQ.p0.v @ system.PQ.u.v) - reference)
            self._initialise(said)

    # -- power flow ----------------------------------------------------------------------------------------

    def _power_flow(self, rule: str, more: float) -> None:
        """Solve for `more` load, pu; move the schedule until the unit at the slack bus generates its share too."""
        system, slack = self.system, self.system.Slack
        system.PFlow.config.tol = POWER_FLOW_TOLERANCE
        units = (system.PV, slack)
        p_set = np.concatenate([unit.p0.v * unit.u.v for unit in units])
        p_max = np.concatenate([unit.pmax.v for unit in units])
        total, surplus = float(p_set.sum()) + more, np.inf
        while abs(surplus) > SLACK_TOLERANCE:
            if rule == "proportional":
                p_set = redispatch.share(p_set, p_max, total)
                system.PV.p0.v[:] = p_set[: system.PV.n]
            self._solve()
            surplus = float(slack.p.v.sum() - p_set[system.PV.n :].sum()) if rule == "proportional" else 0.0
            total += surplus
        base = float(system.config.mva)
        self.generation: dict[int, complex] = {}
        for unit in units:
            for bus, p, q in zip(unit.bus.v, unit.p.v, unit.q.v, strict=True):
                self.generation[int(bus)] = self.generation.get(int(bus), 0j) + base * complex(p, q)
        self.beyond_q_limits = tuple(
            int(unit.bus.v[k]) for unit in units for k in np.flatnonzero((unit.q.v > unit.qmax.v) | (unit.q.v < unit.qmin.v)))
        if not (0 <= slack.p.v).all() or not (slack.p.v <= slack.pmax.v).all():
            raise SimulationError(f"{self.where}: the unit at slack bus {slack.bus.v[0]} would generate "
                                  f"{base * slack.p.v[0]:.0f} MW, outside 0 to {base * slack.pmax.v[0]:.0f} MW. "
                                  "Way out: redispatch='proportional', or host less.")

    def _solve(self) -> None:
        """One power flow."""
        system = self.system
        system.PFlow.run()
        if system.PFlow.converged:
            return
        bus = system.Bus
        mismatch = np.hypot(system.dae.g[bus.a.a], system.dae.g[bus.v.a])
        worst = int(np.argmax(np.nan_to_num(mismatch, nan=np.inf)))
        raise SimulationError(f"{self.where}: power flow has no solution; the largest mismatch, "
                              f"{mismatch[worst] * float(system.config.mva):.3g} MVA, is at bus {bus.idx.v[worst]}. "
                              "Way out: host less there, or check load_scale and the voltage set points.")

    # -- initialisation ------------------------------------------------------------------------------------

    def _initialise(self, said: _Said) -> None:
        """Initialise all dynamic devices, and refuse a start that is not an equilibrium within every limit."""
        system, tds = self.system, self.system.TDS
        limits = [(model, limit) for model in system.exist.tds.values() if model.n for part in model.discrete.values()
                  for limit in (getattr(part, "lower", None), getattr(part, "upper", None)) if hasattr(limit, "vin")]
        before = [np.array(limit.v, dtype=float) for _, limit in limits]
        tds.config.no_tqdm = 1
        tds.config.criteria = 0
        tds.init()
        if not tds.initialized:
            raise SimulationError(f"{self.where}: ANDES could not initialise the dynamic devices. {said}")
        moved = []
        for (model, limit), value in zip(limits, before, strict=True):
            moved += [f"{model.class_name} '{model.idx.v[k]}': {limit.name} = {value[k]:.4g} pu, but {limit.v[k]:.4g} pu is needed"
                      for k in np.flatnonzero(limit.v != value)]
        if moved:
            more = f"; and {len(moved) - 4} more" if len(moved) > 4 else ""
            raise SimulationError(f"{self.where}: {len(moved)} limit(s) are exceeded before the fault: {'; '.join(moved[:4])}{more}. "
                                  "ANDES would widen them and say nothing. Way out: host less, or give the unit a wider limit.")
        residual = np.abs(system.dae.fg)
        worst = int(np.argmax(np.nan_to_num(residual, nan=np.inf)))
        if not residual[worst] <= FLAT_START_TOLERANCE:
            raise SimulationError(f"{self.where}: the start is no equilibrium; the largest residual, {residual[worst]:.3g} pu, is "
                                  f"that of {system.dae.xy_name[worst]}. {said}".rstrip())
        self.residual = float(residual[worst])

    @property
    def v0(self) -> Phasors:
        """Bus voltages before the fault, pu, in the order of the buses."""
        bus = self.system.Bus
        y = self.system.TDS._y_t0
        return np.asarray(y[bus.v.a] * np.exp(1j * y[bus.a.a]))

    # -- faults --------------------------------------------------------------------------------------------

    def simulate(self, fault: BusFault, times: Sequence[Floats], buses: Sequence[int]) -> tuple[Phasors, str]:
        """Voltages at `buses` on the times of the three stretches before, in and after the fault.

        Parameters
        ----------
        fault : BusFault
            One of those the operating point was made for.
        times : three arrays
            The first ends where the second begins, and so on; both sides of a jump are returned.

        Returns
        -------
        v : complex array (times, buses)
            Up to the time reached.
        status : str
            Empty when the end was reached, else the sentence that says what happened.
        """
        with _quiet():
            return self._simulate(fault, times, buses)

    def _simulate(self, fault: BusFault, times: Sequence[Floats], buses: Sequence[int]) -> tuple[Phasors, str]:
        system = self.system
        system.TDS.reinit()
        address = [list(system.Bus.idx.v).index(bus) for bus in buses]
        magnitude, angle = system.Bus.v.a[address], system.Bus.a.a[address]
        device = system.Fault.idx2uid(self.fault_index[fault])
        faulted = list(system.Bus.idx.v).index(fault.bus)
        samples: list[Phasors] = []

        def record() -> None:
            y = system.dae.y
            samples.append(y[magnitude] * np.exp(1j * y[angle]))

        for _ in times[0]:  # an equilibrium, checked in `_initialise`: nothing moves before the fault
            record()
        stepper = Stepper(system)
        stepper.t = fault.start
        rotor = _Rotors(system)
        before = system.dae.y.copy()
        what = "inception"
        try:
            for what, on, stretch in (("inception", 1.0, times[1]), ("clearing", 0.0, times[2])):
                system.Fault.uf.v[device] = on
                # In polar form V = 0 solves the balance of a bus without load, so that a search which starts from the
                # voltages of the fault ends there: the fault would never be cleared. Start from those before it.
                stepper.event(before)
                if not on and system.Bus.v.v[faulted] < COLLAPSED:
                    raise NoConvergence(fault.cleared_at, f"the voltage at bus {fault.bus}")
                record()
                for t in stretch[1:]:
                    stepper.advance(float(t))
                    record()
                    lost = rotor.out_of_step()
                    if lost:
                        return np.array(samples), f"lost synchronism at t = {t:.3f} s: {lost}."
        except NoConvergence as failure:
            v = system.Bus.v.v
            low = int(np.argmin(v))
            return np.array(samples), (
                f"voltage collapse or numerical failure after {what} at t = {failure.t:.4f} s: the equations have no "
                f"solution near the last one; {failure.variable} did not settle; lowest voltage {v[low]:.2f} pu at bus "
                f"{system.Bus.idx.v[low]}.")
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
        """The machine that is furthest from the centre of inertia, when that is half a turn or more."""
        delta = self.system.dae.x[self.address]
        away = np.where(self.on, np.abs(delta - delta @ self.inertia / self.inertia.sum()), 0.0)
        k = int(np.argmax(away))
        return f"{self.name[k]} is {np.rad2deg(away[k]):.0f} deg from the centre of inertia" if away[k] > LOST_SYNCHRONISM else ""
