"""Fault simulation of the grid: the native engine against ANDES, which steps 1/120 s as its users do.

One process, one thread, processor time, the least of several. ANDES runs its own time-domain loop; an
operating point costs it a load of the case, power flow and initialisation, as hosting another vector needs.
Voltages are compared on ANDES's time grid with its equations stepped by the implicit trapezoidal rule, which
takes events exactly, 1 ms around events left out; the error of a row of times is that comparison for the same
fault. In the rows "by the same rule" our equations are stepped like that too.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from benchmarks._trapezoid import Stepper
from benchmarks.harness import Result, least, least_in_turn, result
from dcvrt import Simulator, facility
from dcvrt.criteria import Criteria
from dcvrt.dae import Dae
from dcvrt.grid import BusFault, FaultRun, Grid, Period, andes
from dcvrt.grid.faults import Fault
from dcvrt.grid.native.engine import sample_times, thetas
from dcvrt.grid.native.run import Options

Floats = npt.NDArray[np.float64]

STEP = 1 / 120
UNTIL = 5.0
SAME_RULE_UNTIL = 1.0
"""End of the runs in which our equations are stepped as ANDES's are, s."""
ANDES_STATES = {
    "machine.delta": ("GENROU", "delta"), "machine.omega": ("GENROU", "omega"),
    "machine.e_q1": ("GENROU", "e1q"), "machine.e_d1": ("GENROU", "e1d"),
    "machine.e_d2": ("GENROU", "e2d"), "machine.e_q2": ("GENROU", "e2q"),
    "exciter.x": ("SEXS", "LL_x"), "exciter.e_f": ("SEXS", "LAW_y"),
    "governor.g": ("TGOV1", "LAG_y"), "governor.x": ("TGOV1", "LL_x"),
}  # fmt: skip
"""Model and variable of ANDES of our states in the IEEE 118-bus case."""

SITES = (21, 75, 106, 108)
HOSTING = {21: 31.4, 75: 153.9, 106: 102.4, 108: 104.1}
RATING = 1.3
"""Of the facilities in the closed loop."""
FAULTS = (22, 23, 17, 74, 100, 103, 105, 109, 30, 78, 92, 65)
OTHERS = {
    "kundur_full": ("kundur/kundur_full.xlsx", 7, 8),
    "ieee14": ("ieee14/ieee14.raw", 9, 4),
    "ieee39_full": ("ieee39/ieee39_full.xlsx", 20, 16),
}
"""Case: file in the package of ANDES, bus that is looked at, bus of the fault."""


def run(smoke: bool = False) -> list[Result]:
    """Rows of the benchmark; `smoke` takes one fault, short runs and no other cases."""
    until, faults = (0.4, FAULTS[:1]) if smoke else (UNTIL, FAULTS)
    grid = Grid.from_case("ieee118", sites=SITES)
    rows = _accuracy(grid, faults, until)
    rows += _times(grid, until, smoke)
    rows += _closed_loop(grid, until, smoke)
    if not smoke:
        rows += [row for name in OTHERS for row in _other(name)]
    return rows


# -- accuracy ------------------------------------------------------------------------------------------------


def _parts(t: Floats, error: Floats, fault: BusFault) -> tuple[float, float]:
    """Largest error in the fault and after it, 1 ms around events left out."""
    inside = (t > fault.start + 1e-3) & (t < fault.cleared_at - 1e-3)
    return float(error[inside].max()), float(error[t > fault.cleared_at + 1e-3].max())


def _accuracy(grid: Grid, buses: tuple[int, ...], until: float) -> list[Result]:
    faults = [BusFault(bus) for bus in buses]
    ours = grid.waveforms_of(HOSTING, Period(), faults, until, step=STEP)
    theirs = grid.waveforms_of(HOSTING, Period(), faults, until, engine="andes", step=STEP)
    worst = np.zeros(2)
    for fault in faults:
        for bus in SITES:
            a, b = ours[fault][bus], theirs[fault][bus]
            worst = np.maximum(worst, _parts(a.t, np.abs(np.abs(a.v) - np.abs(b.v)), fault))
    point, andes_point = grid.native.point(HOSTING, Period()), grid.operating_point(HOSTING, Period())
    times = sample_times(faults[0].stages(grid.network), until, STEP)
    tight = Options(rtol=1e-9, atol=1e-9)
    found, reference = (point.simulate(faults[0].stages(grid.network), times, o) for o in (Options(), tight))
    case = f"ieee118, {len(faults)} fault(s)"
    andes_ = "ANDES 1/120 s"
    return [
        result("ieee118", "power flow", float(np.abs(point.v0 - andes_point.v0).max()), "pu", "ANDES"),
        result("ieee118", "largest residual at rest", point.residual, "pu"),
        _initial_states(grid),
        result(case, "|V| in the fault", worst[0], "pu", andes_),
        result(case, "|V| after the fault", worst[1], "pu", andes_),
        *_by_the_same_rule(grid, faults, min(until, SAME_RULE_UNTIL)),
        *_against_finer(grid, ours, faults, until),
        result(case, "V", float(np.abs(found.v - reference.v).max()), "pu", "own at 1e-9"),
        result(case, "dV/dH", _sensitivity_error(grid, faults[0], until), "relative", "central differences"),
    ]  # fmt: skip


def _initial_states(grid: Grid) -> Result:
    """States of all machines, exciters and governors before the fault, pu and rad."""
    system = grid.operating_point(HOSTING, Period()).system
    worst = 0.0
    for rest in grid.native.point(HOSTING, Period()).rest:
        for unit, states in zip(rest.group.units, rest.x, strict=True):
            for path, state in zip(rest.group.structure.dae.x_names, states, strict=True):
                model, variable = ANDES_STATES[path]
                prefix = "machine" if model == "GENROU" else model
                place = list(system.models[model].idx.v).index(f"{prefix} {unit.bus}")
                theirs = getattr(system.models[model], variable).v[place]
                worst = max(worst, abs(float(state - theirs)))
    return result("ieee118", "initial states", worst, "pu", "ANDES")


def _by_the_same_rule(grid: Grid, faults: Sequence[BusFault], until: float) -> list[Result]:
    """Our equations, stepped as ANDES's are: what of the difference is that of the equations."""
    theirs = grid.waveforms_of(HOSTING, Period(), faults, until, engine="andes", step=STEP)
    worst = np.zeros(2)
    for fault in faults:
        stages = fault.stages(grid.network)
        v = Stepper(grid.native.point(HOSTING, Period())).run(stages, sample_times(stages, until, STEP))
        for k, bus in enumerate(SITES):
            w = theirs[fault][bus]
            worst = np.maximum(worst, _parts(w.t, np.abs(np.abs(v[:, k]) - np.abs(w.v)), fault))
    case = f"ieee118, {len(faults)} fault(s), {until:g} s"
    return [
        result(case, "|V| in the fault, by the same rule", worst[0], "pu", "ANDES 1/120 s"),
        result(case, "|V| after the fault, by the same rule", worst[1], "pu", "ANDES 1/120 s"),
    ]


def _against_finer(
    grid: Grid, ours: Mapping[Fault, FaultRun], faults: Sequence[BusFault], until: float
) -> list[Result]:
    """The same against ANDES with a quarter of the step: what of the difference is ANDES's own error."""
    fine = grid.waveforms_of(HOSTING, Period(), faults, until, engine="andes", step=STEP / 4)
    worst = np.zeros(2)
    for fault in faults:
        for bus in SITES:
            a, b = ours[fault][bus], fine[fault][bus]
            worst = np.maximum(worst, _parts(a.t, np.abs(np.abs(a.v) - np.abs(b.at(a.t))), fault))
    case = f"ieee118, {len(faults)} fault(s)"
    return [
        result(case, "|V| in the fault", worst[0], "pu", "ANDES 1/480 s"),
        result(case, "|V| after the fault", worst[1], "pu", "ANDES 1/480 s"),
    ]


def _sensitivity_error(grid: Grid, fault: BusFault, until: float) -> float:
    """Largest difference of dV/dH from central differences, over the largest derivative."""
    engine, step = grid.native, 0.05
    times = sample_times(fault.stages(grid.network), until, STEP)
    options = Options(rtol=1e-11, atol=1e-11, theta_rtol=1e-8)
    by = thetas(("H",), SITES, grid.network)
    stages = fault.stages(grid.network)
    exact = engine.point(HOSTING, Period(), by).simulate(stages, times, options).tangents
    worst = 0.0
    for k, bus in enumerate(SITES):
        moved = [
            engine.point({**HOSTING, bus: HOSTING[bus] + h}, Period()).simulate(stages, times, options).v
            for h in (step, -step)
        ]
        difference = (moved[0] - moved[1]) / (2 * step)
        worst = max(worst, float(np.abs(difference - exact[:, k]).max() / np.abs(exact[:, k]).max()))
    return worst


# -- times ---------------------------------------------------------------------------------------------------


def _andes_system(grid: Grid, fault: BusFault, until: float) -> Any:
    """A case in ANDES with hosted load and fault, set up."""
    system = andes.read(grid.path, grid.dynamics)
    andes.add_machines(system, grid.machines)
    volts = dict(zip(system.Bus.idx.v, system.Bus.Vn.v, strict=True))
    for bus in grid.sites:
        p = HOSTING.get(bus, 0.0) / system.config.mva
        q = p * np.tan(np.arccos(grid.pf))
        system.add("PQ", {"idx": f"hosted {bus}", "bus": bus, "Vn": volts[bus], "p0": p, "q0": q})
    system.add(
        "Fault", {"idx": "f", "bus": fault.bus, "tf": fault.start, "tc": fault.cleared_at, "xf": fault.x_f}
    )
    with andes.quiet():
        system.setup()
        system.Toggle.u.v[:] = 0
    config = system.TDS.config
    config.tf, config.fixt, config.tstep, config.no_tqdm, config.criteria = until, 1, STEP, 1, 0
    return system


def _andes_run(system: Any) -> None:
    with andes.quiet():
        system.TDS.run()


def _andes_point(system: Any) -> None:
    with andes.quiet():
        system.PFlow.run()
        system.TDS.init()


def _andes_times(grid: Grid, fault: BusFault, until: float) -> tuple[float, float]:
    """Processor time of ANDES's own loop, and of it with all that another hosting vector needs."""
    loop, whole = np.inf, np.inf
    for _ in range(2):
        start = time.process_time()
        system = _andes_system(grid, fault, until)
        _andes_point(system)
        middle = time.process_time()
        _andes_run(system)
        end = time.process_time()
        loop, whole = min(loop, end - middle), min(whole, end - start)
    return loop, whole


def _times(grid: Grid, until: float, smoke: bool) -> list[Result]:
    engine, fault = grid.native, BusFault(FAULTS[0])
    loop, whole = _andes_times(grid, fault, until)
    stages = fault.stages(grid.network)
    times = sample_times(stages, until, STEP)
    by = thetas(("H",), SITES, grid.network)
    point = engine.point(HOSTING, Period())
    point.simulate(stages, times, engine.options)
    many = [BusFault(bus) for bus in FAULTS[:10]]

    def new(wrt: tuple[str, ...] = ()) -> None:
        found = by if wrt else ()
        made = engine.point(HOSTING, Period(), found)
        engine.simulate(made, fault, times, found)

    def ten() -> None:
        made = engine.point(HOSTING, Period())
        for each in many:
            engine.simulate(made, each, sample_times(each.stages(grid.network), until, STEP))

    budget = 0.2 if smoke else 1.0
    error = _same_fault_error(grid, fault, until)
    open_loop = least(new, budget)
    case = f"ieee118, {until:g} s"
    together = least(ten, budget)
    return [
        result(case, "integration", least(lambda: point.simulate(stages, times, engine.options), budget), "s",
               "ANDES 1/120 s", loop, error),
        result(case, "new hosting vector to waveforms", open_loop, "s", "ANDES 1/120 s", whole, error),
        result(case, "the same with 4 sensitivities", least(lambda: new(("H",)), budget), "s",
               "ANDES 1/120 s", whole, error),
        result(case, "10 faults of one operating point", len(many) / together, "simulations/s"),
    ]  # fmt: skip


def _waveforms(
    grid: Grid, faults: Sequence[BusFault], until: float, coupled: Mapping[int, Dae] | None
) -> Mapping[Fault, FaultRun]:
    values = {"beta": RATING} if coupled else None
    return grid.waveforms_of(HOSTING, None, faults, until, step=STEP, facilities=coupled, values=values)


def _facility_runs(simulator: Simulator, found: Mapping[Fault, FaultRun], pf: float) -> None:
    at_sites = [run[bus] for run in found.values() for bus in SITES]
    simulator.batch(at_sites, {"H": 1.0, "beta": RATING, "pf": pf}, criteria=Criteria())


def _closed_loop(grid: Grid, until: float, smoke: bool) -> list[Result]:
    """Facilities as ports of the network, from a new hosting vector on, over the open loop.

    The open loop leaves the facilities out; to know what they do, each is run on the waveform of its site,
    with margins. That is given three ways: both loops without these runs, only the open loop with them, both
    with them.
    """
    return [
        row
        for mode in ("gfl", "gfm")
        for count in ((1,) if smoke else (1, 10))
        for row in _one_closed_loop(grid, mode, count, until, 0.2 if smoke else 1.0)
    ]


def _one_closed_loop(grid: Grid, mode: str, count: int, until: float, budget: float) -> list[Result]:
    dae = facility.get(mode).compile()
    simulator, coupled = Simulator(dae), dict.fromkeys(SITES, dae)
    faults = [BusFault(bus) for bus in FAULTS[:count]]
    found = _waveforms(grid, faults, until, None)
    open_loop, closed, runs = least_in_turn(
        [
            lambda: _waveforms(grid, faults, until, None),
            lambda: _waveforms(grid, faults, until, coupled),
            lambda: _facility_runs(simulator, found, grid.pf),
        ],
        budget,
    )
    case = f"closed loop, 4 {mode}, {count} fault(s), {until:g} s"
    with_runs = "of the open loop's with its facility runs"
    return [
        result(case, "waveforms", closed / open_loop, "of the open loop's"),
        result(case, "waveforms", closed / (open_loop + runs), with_runs),
        result(case, "waveforms and facility runs", (closed + runs) / (open_loop + runs), with_runs),
    ]


def _same_fault_error(grid: Grid, fault: BusFault, until: float) -> float:
    ours = grid.waveforms(HOSTING, fault, until, step=STEP)
    theirs = grid.waveforms(HOSTING, fault, until, engine="andes", step=STEP)
    return max(max(_parts(ours[b].t, np.abs(np.abs(ours[b].v) - np.abs(theirs[b].v)), fault)) for b in SITES)


def _other(name: str) -> list[Result]:
    spec = find_spec("andes")
    assert spec is not None
    assert spec.origin is not None
    file, site, bus = OTHERS[name]
    grid = Grid.from_case(Path(spec.origin).parent / "cases" / file, sites=(site,))
    fault = BusFault(bus)
    ours = grid.waveforms({}, fault, UNTIL, step=STEP)[site]
    theirs = grid.waveforms({}, fault, UNTIL, engine="andes", step=STEP / 4)[site]
    at = theirs.at(ours.t)
    error = _parts(ours.t, np.abs(np.abs(ours.v) - np.abs(at)), fault)[1]
    _, whole = _andes_times(grid, fault, UNTIL)
    stages = fault.stages(grid.network)
    times = sample_times(stages, UNTIL, STEP)

    def new() -> None:
        grid.native.simulate(grid.native.point({}, Period()), fault, times)

    return [result(name, "case to waveforms", least(new), "s", "ANDES 1/120 s", whole, error)]
