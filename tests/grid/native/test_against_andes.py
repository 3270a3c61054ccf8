"""The native engine against ANDES: power flow, then voltages through faults."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from benchmarks._trapezoid import Stepper
from dcvrt.grid import BusFault, Grid, Period, andes
from dcvrt.grid.fault_run import FaultRun
from dcvrt.grid.native.engine import sample_times
from dcvrt.grid.native.steady import Flow, loads
from tests.grid.native.cases import NO_VRT, TIGHT, TIGHTEST, WINDY, away, case, package, run

CASES = {
    "kundur": ("kundur/kundur_full.xlsx", (7, 9), 8),
    "ieee14": ("ieee14/ieee14.raw", (9, 14), 4),
    "ieee39": ("ieee39/ieee39_full.xlsx", (15, 27), 16),
}
FAULTS = (17, 22, 23, 49, 69, 74, 77, 80, 100, 103, 105, 109)


# -- power flow --------------------------------------------------------------------------------------------


def differences(grid: Grid, hosting: dict[int, float], period: Period) -> tuple[float, float]:
    """Largest difference of the magnitudes, pu, and the angles, rad, to ANDES's power flow."""
    theirs = grid.operating_point(hosting, period).v0
    per_mw = period.dc_factor * (1 + 1j * np.tan(np.arccos(grid.pf)))
    hosted = {b: per_mw * mw for b, mw in hosting.items()}
    load = loads(grid.network, hosted, period.wind, period.load_scale)
    ours = Flow(grid.network).solve(load, grid.redispatch).v
    return float(np.abs(abs(theirs) - abs(ours)).max()), float(np.abs(np.angle(theirs / ours)).max())


@pytest.mark.slow
@pytest.mark.parametrize("period", [Period(), WINDY], ids=["base", "windy"])
def test_power_flow_of_the_large_case_with_redispatch(grid: Grid, period: Period) -> None:
    found = differences(grid, NO_VRT, period)
    assert max(found) < 1e-8, found


@pytest.mark.slow
@pytest.mark.parametrize("name", ["kundur", "ieee39"])
def test_power_flow_of_other_cases(name: str) -> None:
    path, sites, _ = CASES[name]
    grid = case(path, sites, redispatch="slack")
    found = differences(grid, dict.fromkeys(sites, 10.0), Period())
    assert max(found) < 1e-8, found


# -- faults ------------------------------------------------------------------------------------------------


def errors(a: FaultRun, b: FaultRun, fault: BusFault) -> tuple[float, float, float]:
    """Largest difference of the magnitudes on the samples of `a` before, in and after the fault."""
    before, during, after = 0.0, 0.0, 0.0
    for bus, w in a.require().waveforms.items():
        t = w.t
        np.testing.assert_array_equal(t, b[bus].t)
        error = np.abs(abs(w.v) - abs(b[bus].v))
        keep = away(t, fault.start, fault.cleared_at)
        before = max(before, error[keep & (t < fault.start)].max())
        during = max(during, error[keep & (t > fault.start) & (t < fault.cleared_at)].max())
        after = max(after, error[keep & (t > fault.cleared_at)].max())
    return before, during, after


@pytest.mark.slow
def test_twelve_faults_of_the_large_case(grid: Grid) -> None:
    """On ANDES's own grids of 1/120 and 1/240 s, and where its error of second order is taken off."""
    faults = [BusFault(bus) for bus in FAULTS]
    coarse = grid.waveforms_of(NO_VRT, None, faults, until=1.5, engine="andes")
    fine = grid.waveforms_of(NO_VRT, None, faults, until=1.5, engine="andes", step=1 / 240)
    ours = grid.waveforms_of(NO_VRT, None, faults, until=1.5)
    finer = grid.waveforms_of(NO_VRT, None, faults, until=1.5, step=1 / 240)
    for fault in faults:
        assert ours[fault].completed, ours[fault].status
        before, during, after = errors(coarse[fault], ours[fault], fault)
        assert before < 1e-8
        assert after < 1e-3, (fault.bus, after)
        before, half_during, half_after = errors(fine[fault], finer[fault], fault)
        assert half_during < 1e-4, (fault.bus, half_during)
        assert half_after < 1e-3
        if during > 1e-4:  # then it is the step of ANDES: half of it leaves a quarter
            assert during / half_during == pytest.approx(4.0, rel=0.15)
        for bus in grid.sites:
            w, v = coarse[fault][bus], fine[fault][bus]
            once = [np.flatnonzero(away(t, fault.start, fault.cleared_at)) for t in (w.t, v.t)]
            common = np.isin(np.round(v.t[once[1]] * 240), np.round(w.t[once[0]] * 240))
            limit = abs(v.v[once[1]][common]) + (abs(v.v[once[1]][common]) - abs(w.v[once[0]])) / 3
            error = np.abs(limit - abs(ours[fault][bus].v[once[0]]))
            inside = w.t[once[0]] < fault.cleared_at
            assert error[inside].max() < 1e-4, fault.bus
            assert error.max() < 1e-3, fault.bus


@pytest.mark.slow
@pytest.mark.parametrize("bus", [23, 78, 103])
def test_by_the_same_rule_the_equations_are_those_of_andes(grid: Grid, bus: int) -> None:
    """Both stepped by the trapezoidal rule at 1/120 s, limits included: no error of a step is left."""
    fault, until = BusFault(bus), 0.5
    theirs = grid.waveforms_of(NO_VRT, None, [fault], until, engine="andes")[fault].require().waveforms
    stages = fault.stages(grid.network)
    stepper = Stepper(grid.native.point(NO_VRT, Period()))
    v = stepper.run(stages, sample_times(stages, until, 1 / 120))
    for k, site in enumerate(grid.sites):
        assert np.abs(abs(v[:, k]) - abs(theirs[site].v)).max() < 5e-7, site


@pytest.mark.slow
def test_the_trapezoidal_rule_tends_to_the_engine(grid: Grid) -> None:
    """Its error falls with the square of the step, towards what the engine gives."""
    fault, errors_ = BusFault(103), []
    stages = fault.stages(grid.network)
    for step in (1 / 120, 1 / 240, 1 / 480):
        times = sample_times(stages, 0.2, step)
        point = grid.native.point(NO_VRT, Period())
        difference = Stepper(point).run(stages, times) - point.simulate(stages, times, TIGHT).v
        errors_.append(float(np.abs(difference).max()))
    assert errors_[0] > 1e-4
    for coarse, fine in pairwise(errors_):
        assert coarse / fine == pytest.approx(4.0, rel=0.1)


@pytest.mark.slow
def test_a_fault_with_units_at_their_reactive_limits(grid: Grid) -> None:
    """Both engines start with the same units at a limit and none beyond, and stay together in the fault."""
    limited, fault = replace(grid, reactive_limits=True), BusFault(77)
    hosting = {bus: 0.7 * mw for bus, mw in NO_VRT.items()}
    start = limited.operating_point(hosting, WINDY)
    assert start.beyond_q_limits == ()
    at_limit = limited.native.point(hosting, WINDY).steady.at_limit
    assert len(at_limit) > 5
    assert len(grid.operating_point(hosting, WINDY).beyond_q_limits) > 5
    units = limited.network.generators
    limits = dict(zip(units.bus.tolist(), zip(units.q_min, units.q_max, strict=True), strict=True))
    for bus in at_limit:
        assert min(abs(start.generation[bus].imag - q) for q in limits[bus]) < 1e-3, bus
    theirs, ours = (
        limited.waveforms_of(hosting, WINDY, [fault], until=1.5, engine=engine)[fault]
        for engine in ("andes", "native")
    )
    before, during, after = errors(theirs, ours, fault)
    assert before < 2e-7
    assert during < 4e-4
    assert after < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("name", ["kundur", "ieee14", "ieee39"])
def test_faults_of_other_cases(name: str) -> None:
    path, sites, bus = CASES[name]
    grid, hosting, fault = case(path, sites), dict.fromkeys(sites, 10.0), BusFault(bus, clear=0.08)
    theirs = grid.waveforms_of(hosting, None, [fault], until=2.5, engine="andes", step=1 / 480)[fault]
    ours = grid.waveforms_of(hosting, None, [fault], until=2.5, step=1 / 480)[fault]
    before, during, after = errors(theirs, ours, fault)
    assert before < 1e-6
    assert during < 1e-3
    assert after < 1e-3


@pytest.mark.slow
def test_a_fault_of_the_fourteen_bus_case_by_the_loop_of_andes() -> None:
    """With all of the change at the slack bus, and ANDES's own treatment of a start below V_min."""
    path, sites, bus = CASES["ieee14"]
    fault, until = BusFault(bus, 0.1, 0.08), 2.0
    grid = case(path, sites, redispatch="slack")
    case_path = package() / path
    system = andes.read(case_path, case_path.with_suffix(".dyr"))
    system.add(
        "Fault",
        {"idx": "it", "bus": bus, "tf": fault.start, "tc": fault.cleared_at, "xf": fault.x_f, "rf": 0.0},
    )
    with andes.quiet():
        system.setup()
        system.Toggle.u.v[:] = 0  # the case trips a line of its own at 1 s
        system.PFlow.config.tol = 1e-9
        system.PFlow.run()
        tds = system.TDS
        tds.config.no_tqdm, tds.config.criteria = 1, 0
        tds.config.tstep, tds.config.tf, tds.config.tol, tds.tol_zero = 1 / 480, until, 1e-6, 1e-12
        tds.config.fixt = 1
        tds.init()
        assert tds.run(no_summary=True)
    t, y = np.array(system.dae.ts.t), np.array(system.dae.ts.y)
    at = grid.network.indices(sites)
    reference = y[:, system.Bus.v.a[at]]
    ours = grid.waveforms({}, fault, until=until, step=1 / 480)
    error = np.abs(np.stack([abs(ours[s].at(t)) for s in sites], axis=1) - reference).max(axis=1)
    keep = away(t, fault.start, fault.cleared_at, by=2.5e-3)  # its event step and interpolation across it
    assert error[keep & (t < fault.start)].max() < 1e-6
    assert error[keep & (t > fault.start) & (t < fault.cleared_at)].max() < 1e-3
    assert error[keep & (t > fault.cleared_at)].max() < 1e-3


# -- our own reference -------------------------------------------------------------------------------------


@pytest.mark.parametrize("bus", [22, 77, 100, 103])
def test_the_tolerance_of_use_against_a_tight_one(grid: Grid, bus: int) -> None:
    fault, of = BusFault(bus), grid.native
    _, usual, _ = run(of, NO_VRT, fault, 2.5, options=of.options)
    _, tight, _ = run(of, NO_VRT, fault, 2.5, options=TIGHT)
    _, tightest, _ = run(of, NO_VRT, fault, 2.5, options=TIGHTEST)
    assert np.abs(usual.v - tight.v).max() < 1e-5
    assert np.abs(tight.v - tightest.v).max() < 1e-7


@pytest.mark.slow
def test_a_start_that_counts_as_on_its_limit_is_told_by_both_engines() -> None:
    """TGOV1_2 begins 2e-5 pu below its V_min: the data have four digits."""
    path, sites, bus = CASES["ieee14"]
    grid, fault = case(path, sites), BusFault(bus)
    theirs, ours = (
        grid.waveforms_of({}, None, [fault], until=2.5, engine=engine, step=1 / 480)[fault]
        for engine in ("andes", "native")
    )
    said = "ieee14, base, fault at bus 4, 100 ms: completed. Counts as on its limit at the start: "
    assert theirs.status == f"{said}TGOV1 'TGOV1_2': VMIN by 2e-05 pu."
    assert ours.status.startswith(f"{said}GENROU 'GENROU_4' at bus 6: governor, FREE -> LOWER: g < V_min")
    assert ours.status.endswith(" by 2e-05 pu.")
    assert max(errors(theirs, ours, fault)) < 1e-4
