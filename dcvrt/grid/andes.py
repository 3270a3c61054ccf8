"""The bridge to ANDES: its generated code, its messages, its case files. No other file imports andes."""

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
from collections.abc import Iterator, Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from dcvrt.cache import cache_folder
from dcvrt.errors import InputError, SimulationError
from dcvrt.grid import units
from dcvrt.grid.dynamics118 import Machine
from dcvrt.grid.network import Branches, Generators, Network
from dcvrt.grid.units import Unit

Floats = npt.NDArray[np.float64]
Phasors = npt.NDArray[np.complex128]

ADDED = 1e-8
"""What ANDES adds to the resistance and the reactance of every branch, pu."""
NO_MACHINES = (
    "{where}: the case has no dynamic data, not one machine. Way out: add a machine (GENROU, GENCLS) "
    "for each "
    "generator, in a .dyr file given as dynamics=... or in the case itself."
)

# -- the generated code ------------------------------------------------------------------------------------


def code_folder() -> Path:
    """Where the code that ANDES generates from its models is kept; one folder per version of ANDES and
    Python."""
    return cache_folder() / f"andes-{version('andes')}-py{sys.version_info.major}.{sys.version_info.minor}"


def prepared() -> bool:
    """Whether the generated code is there."""
    return (code_folder() / "__init__.py").is_file()


def prepare() -> Path:
    """Let ANDES generate its numerical code, once per version; later calls return at once.

    Takes up to half a minute and says so on standard error. Processes that start at the same time do not
    disturb each other: one generates, the others wait for it.

    Returns
    -------
    Path
        The folder of the code.

    Raises
    ------
    InputError
        When the cache folder cannot be written.
    SimulationError
        When the generation fails; with the last line that it wrote.
    """
    folder = code_folder()
    if prepared():
        return folder
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        writable = os.access(folder.parent, os.W_OK)
    except OSError:
        writable = False
    if not writable:
        raise InputError(
            f"{folder.parent}: the cache folder cannot be written. Way out: set DCVRT_CACHE_DIR to one "
            "that can."
        )
    with _lock(folder.parent / f"{folder.name}.lock"):
        if not prepared():
            print(
                f"dcvrt: ANDES generates its code once, up to half a minute, into {folder}",
                file=sys.stderr,
                flush=True,
            )
            _generate(folder)
    return folder


def _generate(folder: Path) -> None:
    """Generate into a temporary folder by a process of its own, then move it: a half-made folder is never
    seen."""
    fresh = Path(tempfile.mkdtemp(prefix=".andes-", dir=folder.parent))
    code = (
        "import sys; from andes.system import System; "
        "s = System(no_undill=True, no_output=True, default_config=True, pycode_path=sys.argv[1]); "
        "s.prepare(quick=True, nomp=True)"
    )
    try:
        done = subprocess.run(
            [sys.executable, "-W", "ignore", "-c", code, str(fresh)],
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode or not (fresh / "__init__.py").is_file():
            said = (done.stderr or done.stdout).strip().splitlines()
            raise SimulationError(
                f"ANDES could not generate its code in {fresh.parent}: {said[-1] if said else 'no message'}. "
                "Way out: check that the installed andes works by itself."
            )
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


class Said(logging.Handler):
    """Keeps what ANDES logs as errors, for our own message."""

    def __init__(self) -> None:
        super().__init__(logging.ERROR)
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append(record.getMessage().strip().splitlines()[0] if record.getMessage().strip() else "")

    def __str__(self) -> str:
        return " ".join(line for line in self.lines[:3] if line)


@contextlib.contextmanager
def quiet() -> Iterator[Said]:
    """Keep ANDES's prints, logs and warnings from the user; errors that it logs are collected."""
    log, said = logging.getLogger("andes"), Said()
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
        raise InputError(
            "ieee118: the case file comes with the package 'andes', which is not installed. "
            "Way out: pip install andes."
        )
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
            raise InputError(
                f"{file}: no such file. Way out: a path of a .raw (+ .dyr), .xlsx, .json or .m file, or "
                "'ieee118'."
            )
    code = prepare()
    with quiet() as said:
        import andes

        try:
            system = andes.load(
                str(path),
                setup=False,
                use_input_path=False,
                no_output=True,
                default_config=True,
                config_option=["PQ.pq2z=0"],  # else power flow serves less load below 0.8 pu, silently
                addfile=str(dynamics) if dynamics else None,
                pycode_path=str(code),
            )
        except Exception as error:  # its parsers raise whatever they run into
            raise InputError(f"{path}: ANDES cannot read it: {type(error).__name__}: {error}") from error
    if system is None or said.lines:
        raise InputError(f"{path}: ANDES cannot read it. {said}".rstrip())
    return system


def read_network(path: Path, dynamics: Path | None, name: str) -> Network:
    """Read the network of a case file, loads at their reference level; see `read`."""
    system = read(path, dynamics)
    with quiet():
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
            units.append(
                (
                    model.bus.v[k],
                    *(
                        base * column.v[k]
                        for column in (model.p0, model.pmin, model.pmax, model.qmin, model.qmax)
                    ),
                )
            )
    unit = np.array(units, dtype=float).reshape(-1, 6)
    lines, on = system.Line, np.flatnonzero(system.Line.u.v)
    return Network(
        name=name,
        base_mva=base,
        bus=np.array(bus.idx.v, dtype=np.int64),
        kind=tuple(kind),
        base_kv=np.array(bus.Vn.v, dtype=float),
        p_load=p,
        q_load=q,
        g_shunt=g,
        b_shunt=b,
        v_set=v_set,
        branches=Branches(
            from_bus=np.array(lines.bus1.v, dtype=np.int64)[on],
            to_bus=np.array(lines.bus2.v, dtype=np.int64)[on],
            r=lines.r.v[on],
            x=lines.x.v[on],
            b=lines.b.v[on],
            tap=lines.tap.v[on],
            shift=lines.phi.v[on],
            rating=np.where(lines.rate_a.v[on] > 0, lines.rate_a.v[on] * base, np.inf),
        ),
        generators=Generators(
            bus=unit[:, 0].astype(np.int64),
            p_set=unit[:, 1],
            p_min=unit[:, 2],
            p_max=unit[:, 3],
            q_min=unit[:, 4],
            q_max=unit[:, 5],
            name=tuple(f"unit {k + 1} at bus {int(x)}" for k, x in enumerate(unit[:, 0])),
        ),
        slack_angle=float(system.Slack.a0.v[0]) if system.Slack.n else 0.0,
    )


def as_evaluated(network: Network) -> Network:
    """The network as ANDES evaluates it, which adds 1e-8 pu to every resistance and reactance.

    One engine simulates a grid and the other replays it. The addition moves voltages by 1e-7 pu, and states
    of small machines by more; with it in both they solve the same equations.
    """
    lines = network.branches
    return replace(network, branches=replace(lines, r=lines.r + ADDED, x=lines.x + ADDED))


def read_units(path: Path, dynamics: Path | None, machines: Sequence[Machine], name: str) -> tuple[Unit, ...]:
    """Generating units of a case, with their values on the system base; see `read`.

    Parameters
    ----------
    machines : sequence of Machine
        Those that are added to what the file has.
    name : str
        What messages call the case.

    Raises
    ------
    InputError
        When the case has no machine, or a dynamic model that the native engine lacks: model, count, devices.
    """
    system = read(path, dynamics)
    add_machines(system, machines)
    with quiet():
        system.setup()
    if not system.SynGen.n:
        raise InputError(NO_MACHINES.format(where=name))
    lacking = units.unsupported(system)
    if lacking:
        lines = [
            f"{model}: {count} device(s): {', '.join(map(str, names))}" for model, count, names in lacking
        ]
        raise InputError(
            f"{name}: the native engine lacks {len(lines)} dynamic model(s) of this case.\n  "
            + "\n  ".join(lines)
            + "\nWay out: engine='andes', or replace these devices."
        )
    return tuple(units.read_units(system))


def add_machines(system: Any, units: Sequence[Machine]) -> None:
    """Add machine, exciter and governor of each unit to a system that is not set up yet."""
    static = {
        bus: idx
        for model in (system.PV, system.Slack)
        for bus, idx in zip(model.bus.v, model.idx.v, strict=True)
    }
    volts = dict(zip(system.Bus.idx.v, system.Bus.Vn.v, strict=True))
    for unit in units:
        for model, values in unit.models.items():
            if model == "GENROU":
                own = {
                    "idx": f"machine {unit.bus}",
                    "bus": unit.bus,
                    "gen": static[unit.bus],
                    "Sn": unit.s_n,
                    "Vn": volts[unit.bus],
                    "fn": 60.0,
                    "M": 2.0 * values["H_m"],
                    **{symbol: value for symbol, value in values.items() if symbol != "H_m"},
                }
            else:
                own = {"idx": f"{model} {unit.bus}", "syn": f"machine {unit.bus}", **values}
            system.add(model, own)
