"""Fault simulation through ANDES: balance, flat start, exact events, order, agreement with ANDES's own
loop."""

from __future__ import annotations

import importlib.util
import os
import pickle
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
import scipy.sparse as sp

from dcvrt.errors import InputError, SimulationError
from dcvrt.grid import BusFault, FaultSequence, Grid, LineTrip, Period
from dcvrt.grid.andes import quiet
from dcvrt.grid.faults import Fault
from dcvrt.grid.operating_point import OperatingPoint
from dcvrt.grid.screening import retained_voltage
from dcvrt.grid.trapezoid import Stepper

SITES = (21, 75, 106, 108)
NO_VRT = {21: 31.4, 75: 153.9, 106: 102.4, 108: 104.1}
"""Hosted MW of the paper's allocation without ride-through."""
WIND = {69: 180.0, 80: 180.0, 89: 180.0}
PERIODS = (
    Period("peak"),
    Period("shoulder", 0.75, {bus: 80.0 for bus in WIND}, 0.9),
    Period("light", 0.45, WIND, 0.8),
)
CHOSEN = (18, 30, 76, 78, 107, 111, 112)
"""What `screen_faults` chooses for these periods."""


@pytest.fixture(scope="module")
def grid() -> Grid:
    return Grid.from_case("ieee118", sites=SITES)


def power_flow_mismatch(
    grid: Grid, point: OperatingPoint, hosting: Mapping[int, float], period: Period
) -> float:
    """Largest mismatch, MVA, of the solution against the equations of `Network`, which ANDES does not
    know."""
    network = grid.network
    s = -(network.p_load + 1j * network.q_load) * period.load_scale
    for bus, mva in point.generation.items():
        s[network.index(bus)] += mva
    for bus, mw in period.wind.items():
        s[network.index(bus)] += mw
    for bus, mw in hosting.items():
        s[network.index(bus)] -= period.dc_factor * mw * (1 + 1j * np.tan(np.arccos(grid.pf)))
    flow = point.v0 * np.conj(network.admittance() @ point.v0) * network.base_mva
    return float(np.abs(flow - s).max())


# -- one small live run ------------------------------------------------------------------------------------


def test_one_fault_from_power_flow_to_waveforms(grid: Grid) -> None:
    fault, period = BusFault(77), Period("windy", 0.9, {69: 100.0}, 0.95)
    point = grid.operating_point(NO_VRT, period, [fault])
    assert point.residual < 1e-6
    assert power_flow_mismatch(grid, point, NO_VRT, period) < 1e-5

    runs = grid.waveforms_of(NO_VRT, period, [fault], until=0.3, engine="andes")
    run = runs[fault]
    assert run.completed
    assert run.status == "ieee118, windy, fault at bus 77, 100 ms: completed."
    assert set(run) == set(SITES)

    shunt = point.load_admittance() + point.machine_admittance("subtransient")
    sites = grid.network.indices(SITES)
    retained = retained_voltage(grid.network.admittance() + sp.diags(shunt), point.v0, sites)
    for k, bus in enumerate(SITES):
        w = run[bus]
        assert w.jumps == (0.1, 0.2)
        assert run[SITES[0]].same_layout(w)
        before = w.t[:-1] <= 0.1
        first = int(np.flatnonzero(w.t == 0.1)[1])
        np.testing.assert_array_equal(w.v[:first], point.v0[sites[k]])
        assert before.sum() >= first
        # just after inception the network is that of the rank-1 formula
        assert abs(w.v[first] - retained[grid.network.index(77), k]) < 1e-6
        assert abs(w.at(0.25)) > abs(w.at(0.15))


def test_units_share_the_load_in_proportion_to_their_schedule(grid: Grid) -> None:
    point = grid.operating_point(NO_VRT, PERIODS[0])
    units = grid.network.generators
    generated = np.array([point.generation[int(bus)].real for bus in units.bus])
    follows = units.p_set > 0
    free = follows & (generated < units.p_max - 1e-6)
    ratio = generated[free] / units.p_set[free]
    np.testing.assert_allclose(ratio, ratio[0], rtol=1e-5)
    np.testing.assert_allclose(generated[~follows], 0.0, atol=1e-4)
    assert (generated <= units.p_max + 1e-4).all()


# -- bad input: one message, before anything runs ----------------------------------------------------------


def test_bad_request_names_everything_at_once(grid: Grid) -> None:
    with pytest.raises(InputError) as failure:
        grid.waveforms_of(
            {22: 5.0, 75: -1.0, 106: float("nan")},
            Period("windy", wind={690: 10.0}),
            [BusFault(75), BusFault(230), BusFault(23, start=1.0, clear=0.1)],
            until=1.05,
        )
    text = str(failure.value)
    assert text.startswith("ieee118: 7 problems\n")
    assert [line.split(" Did you mean")[0].split(" Known")[0] for line in text.splitlines()[1:]] == [
        "  hosting at bus 22: not a candidate site.",
        "  hosting at bus 75 = -1.0 MW must be a number of at least 0.",
        "  hosting at bus 106 = nan MW must be a number of at least 0.",
        "  wind: no bus 690.",
        "  fault at bus 75: it is a candidate site, and no site rides through a fault at its own bus. "
        "Way out: a fault at a neighbouring bus.",
        "  fault: no bus 230.",
        "  fault at bus 23, 100 ms: until = 1.05 s ends before it is cleared at 1.1 s.",
    ]
    assert text.count(" Did you mean ") == 2  # for the two bus numbers with a zero too many


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"engine": "ands"},
            "ieee118: engine = 'ands' is not known. Did you mean 'andes'? Known: native, andes.",
        ),
        (
            {"engine": "andes", "wrt": ("H",)},
            "ieee118: wrt: ANDES gives no derivatives. Way out: engine='native'.",
        ),
        (
            {"engine": "andes", "facilities": {75: object()}},
            "ieee118: facilities: ANDES has no model of them. Way out: engine='native'.",
        ),
        ({"step": 0.5}, "ieee118: step = 0.5 s must be above 0 and at most 0.05 s."),
    ],
)
def test_what_andes_does_not_give(grid: Grid, arguments: dict[str, object], message: str) -> None:
    with pytest.raises(InputError) as failure:
        grid.waveforms(NO_VRT, BusFault(23), **arguments)  # type: ignore[arg-type]
    assert str(failure.value) == message


@pytest.mark.parametrize(
    "fault",
    [
        BusFault(77, opens=(77, 80)),
        BusFault(23, clear=0.15, opens=(24, 23)),
        LineTrip(77, 80, reclose=0.3),
        FaultSequence((BusFault(77, opens=(77, 80)), BusFault(77, 0.5, 0.1, opens=(77, 78)))),
    ],
    ids=lambda fault: fault.label,
)
def test_branches_open_alike_in_both_engines(grid: Grid, fault: Fault) -> None:
    """The difference is the step error of the trapezoidal rule, of order 2, on both sides of every jump."""

    def difference(step: float) -> float:
        own = grid.waveforms(NO_VRT, fault, until=1.0, step=step)
        by_andes = grid.waveforms(NO_VRT, fault, until=1.0, step=step, engine="andes")
        return max(float(np.abs(np.abs(own[bus].v) - np.abs(by_andes[bus].v)).max()) for bus in SITES)

    coarse, fine = difference(1 / 120), difference(1 / 240)
    assert fine < 1e-4
    assert 3.5 < coarse / fine < 4.5


def test_a_branch_that_opens_leaves_the_operating_point_as_it_was(grid: Grid) -> None:
    plain, opening = BusFault(77), BusFault(77, opens=(77, 80))
    both = grid.waveforms_of(NO_VRT, None, [opening, plain], until=0.5, engine="andes")
    alone = grid.waveforms(NO_VRT, plain, until=0.5, engine="andes")
    np.testing.assert_allclose(both[plain].waveforms[75].v, alone[75].v, atol=1e-9)
    assert np.abs(both[opening].waveforms[75].v - alone[75].v).max() > 0.01


def test_andes_is_not_asked_for_islands(grid: Grid) -> None:
    runs = grid.waveforms_of(NO_VRT, None, [LineTrip(9, 10), BusFault(77)], until=0.3, engine="andes")
    island, fine = runs.values()
    assert "with 9-10 open, 1 bus(es) are islanded: 10. Islands are not simulated." in island.status
    assert fine.completed


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"case": "ieee118", "sites": (21, 21), "pf": 1.2, "redispatch": "propotional"},
            "ieee118: 3 problems\n  pf = 1.2 must be above 0 and at most 1.\n  sites (21, 21) names a bus "
            "twice.\n"
            "  redispatch = 'propotional' is not known. Did you mean 'proportional'? Known: proportional, "
            "slack.",
        ),
        (
            {"case": "iee118"},
            "case 'iee118' is neither a built-in case nor a file. Did you mean 'ieee118'? Known: ieee118.",
        ),
        (
            {"case": "ieee118", "dynamics": "machines.dyr"},
            "ieee118 has its own dynamic data; dynamics= is for case files.",
        ),
        (
            {"case": "missing.raw"},
            "missing.raw: no such file. Way out: a path of a .raw (+ .dyr), .xlsx, .json or .m file, or "
            "'ieee118'.",
        ),
    ],
)
def test_a_case_that_cannot_be_opened(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(InputError) as failure:
        Grid.from_case(**arguments)  # type: ignore[arg-type]
    assert str(failure.value) == message


def test_a_grid_travels_to_workers(grid: Grid) -> None:
    assert grid.network.name == "ieee118"
    again = pickle.loads(pickle.dumps(grid))
    assert (again.name, again.sites, again.path) == (grid.name, grid.sites, grid.path)
    assert again.network.bus.tolist() == grid.network.bus.tolist()


# -- slow: physics -----------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("period", PERIODS, ids=lambda p: p.name)
@pytest.mark.parametrize("hosting", [{}, NO_VRT], ids=["empty", "no-vrt"])
class TestEveryOperatingPoint:
    def test_power_flow_holds(self, grid: Grid, period: Period, hosting: dict[int, float]) -> None:
        point = grid.operating_point(hosting, period)
        assert power_flow_mismatch(grid, point, hosting, period) < 1e-5

    def test_flat_start_stays_flat(self, grid: Grid, period: Period, hosting: dict[int, float]) -> None:
        point = grid.operating_point(hosting, period)
        v0, x0 = point.v0, point.system.dae.x.copy()
        with quiet():
            stepper = Stepper(point.system)
            for t in np.linspace(0.0, 1.0, 121)[1:]:
                stepper.advance(float(t))
        assert not stepper.lost
        bus = point.system.Bus
        assert np.abs(bus.v.v * np.exp(1j * bus.a.v) - v0).max() < 1e-6
        assert np.abs(point.system.dae.x - x0).max() < 1e-6

    def test_start_is_small_signal_stable(
        self, grid: Grid, period: Period, hosting: dict[int, float]
    ) -> None:
        point = grid.operating_point(hosting, period)
        with quiet():
            point.system.EIG.run()
        modes = np.ravel(point.system.EIG.mu)
        angle_reference = np.argmin(np.abs(modes))  # all angles may turn together
        assert abs(modes[angle_reference]) < 1e-3
        assert np.delete(modes, angle_reference).real.max() < -0.01

    def test_chosen_faults_survive(self, grid: Grid, period: Period, hosting: dict[int, float]) -> None:
        runs = grid.waveforms_of(hosting, period, [BusFault(bus) for bus in CHOSEN], engine="andes")
        for run in runs.values():
            assert run.completed, run.status
            for w in run.waveforms.values():
                assert abs(w.v[-1]) > 0.9
                assert np.isfinite(w.v).all()


def own_loop(
    grid: Grid, fault: BusFault, until: float
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.complex128]]:
    """The same fault by ANDES's own time-domain routine at 1/480 s."""
    point = grid.operating_point(NO_VRT, None, [fault])
    system, tds = point.system, point.system.TDS
    with quiet():
        tds.config.tstep, tds.config.tf, tds.config.tol, tds.tol_zero = 1 / 480, until, 1e-6, 1e-12
        system.Fault.tf.v[:], system.Fault.tc.v[:] = fault.start, fault.cleared_at
        system.store_switch_times(system.exist.tds)
        for model in system.exist.pflow_tds.values():
            if model.n:
                model.snapshot_init()
        tds.reinit()
        assert tds.run(no_summary=True)
    t, y = np.array(system.dae.ts.t), np.array(system.dae.ts.y)
    at = grid.network.indices(SITES)
    return t, y[:, system.Bus.v.a[at]] * np.exp(1j * y[:, system.Bus.a.a[at]])


@pytest.mark.slow
@pytest.mark.parametrize("bus", [77, 103])
def test_agrees_with_the_loop_of_andes(grid: Grid, bus: int) -> None:
    fault, until = BusFault(bus, start=0.5, clear=0.1), 2.5
    t, reference = own_loop(grid, fault, until)
    ours = grid.waveforms(NO_VRT, fault, until=until, step=1 / 480, engine="andes")
    error = np.abs(np.stack([ours[site].at(t) for site in SITES], axis=1) - reference).max(axis=1)
    away = (np.abs(t - fault.start) > 1e-3) & (np.abs(t - fault.cleared_at) > 1e-3)
    during = (t > fault.start) & (t < fault.cleared_at)
    assert error[away & (t < fault.start)].max() < 1e-6
    assert error[away & during].max() < 2e-4
    assert error[away & (t > fault.cleared_at)].max() < 4e-4


@pytest.mark.slow
def test_second_order_in_the_step(grid: Grid) -> None:
    fault = BusFault(77, start=0.1, clear=0.1)
    v = [
        grid.waveforms(NO_VRT, fault, until=0.6, step=step, engine="andes")[75].at([0.14, 0.3, 0.6])
        for step in (1 / 100, 1 / 200, 1 / 1600)
    ]
    coarse, fine = np.abs(v[0] - v[2]).max(), np.abs(v[1] - v[2]).max()
    assert 3.5 < coarse / fine < 4.6


@pytest.mark.slow
def test_faults_of_one_operating_point_do_not_touch_each_other(grid: Grid) -> None:
    faults = [BusFault(77), BusFault(103), BusFault(77, clear=0.15)]
    together = grid.waveforms_of(NO_VRT, None, faults, until=0.5, engine="andes")
    for fault in reversed(faults):
        alone = grid.waveforms(NO_VRT, fault, until=0.5, engine="andes")
        for bus in SITES:
            np.testing.assert_allclose(together[fault][bus].v, alone[bus].v, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_all_load_at_the_slack_bus_on_request(grid: Grid) -> None:
    slack = Grid.from_case("ieee118", redispatch="slack")
    units, moved = grid.network.generators, []
    for hosting in ({}, {75: 100.0}):
        point = slack.operating_point(hosting)
        generated = np.array([point.generation[int(bus)].real for bus in units.bus])
        away = units.bus != 69
        np.testing.assert_allclose(generated[away], units.p_set[away], atol=1e-4)
        moved.append(point.generation[69].real)
    assert 98 < moved[1] - moved[0] < 115  # 100 MW and the change of losses
    with pytest.raises(
        SimulationError, match=r"^ieee118, base: the unit at slack bus 69 would generate .* outside 0 to 805"
    ):
        slack.operating_point(NO_VRT)


# -- slow: what goes wrong is said -------------------------------------------------------------------------


@pytest.mark.slow
def test_a_power_flow_without_solution_names_the_bus(grid: Grid) -> None:
    with pytest.raises(SimulationError) as failure:
        grid.waveforms({21: 1500.0}, BusFault(77), engine="andes")
    text = str(failure.value)
    assert text.startswith("ieee118, base: power flow has no solution; the largest mismatch, ")
    assert text.endswith("Way out: host less there, or check load_scale and the voltage set points.")


@pytest.mark.slow
def test_a_machine_that_falls_out_of_step_is_named(grid: Grid) -> None:
    long, short = BusFault(9, clear=0.6), BusFault(77)
    runs = grid.waveforms_of({}, None, [long, short], engine="andes")
    assert runs[short].completed
    assert not runs[long].completed
    assert "lost synchronism at t = " in runs[long].status
    assert "GENROU 'machine 10' is " in runs[long].status
    with pytest.raises(SimulationError) as failure:
        runs[long][75]
    assert str(failure.value) == runs[long].status


@pytest.mark.slow
def test_a_limit_that_is_exceeded_before_the_fault_is_named(tmp_path: Path) -> None:
    case = andes_cases() / "ieee14" / "ieee14.raw"
    text = case.with_suffix(".dyr").read_text()
    lines = [line for line in text.splitlines() if "TGOV1" in line]
    fields = lines[0].split()
    narrow = " ".join([*fields[:5], "0.1", *fields[6:]])  # VMAX
    (tmp_path / "small.raw").write_text(case.read_text())
    (tmp_path / "small.dyr").write_text(text.replace(lines[0], narrow))
    grid = Grid.from_case(tmp_path / "small.raw", sites=(9,))
    with pytest.raises(SimulationError) as failure:
        grid.waveforms({9: 10.0}, BusFault(4), engine="andes")
    assert str(failure.value).startswith(
        "small, base: 1 limit(s) are exceeded before the fault: TGOV1 'TGOV1_1': VMAX = "
    )


def andes_cases() -> Path:
    spec = importlib.util.find_spec("andes")
    assert spec is not None
    assert spec.origin is not None
    return Path(spec.origin).parent / "cases"


@pytest.mark.slow
def test_a_case_without_dynamic_data_says_what_to_add() -> None:
    grid = Grid.from_case(andes_cases() / "matpower" / "case14.m", sites=(9,))
    with pytest.raises(InputError) as failure:
        grid.waveforms({9: 5.0}, BusFault(4), engine="andes")
    assert str(failure.value) == (
        "case14, base: the case has no dynamic data, not one machine. Way out: add a machine (GENROU, "
        "GENCLS) for each "
        "generator, in a .dyr file given as dynamics=... or in the case itself."
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "sites", "bus"),
    [
        ("kundur/kundur_full.xlsx", (7,), 8),
        ("ieee14/ieee14.raw", (9, 14), 4),
        ("ieee39/ieee39_full.xlsx", (15, 27), 16),
    ],
)
def test_other_cases_run(case: str, sites: tuple[int, ...], bus: int) -> None:
    grid = Grid.from_case(andes_cases() / case, sites=sites)
    hosting = {site: 10.0 for site in sites}
    point = grid.operating_point(hosting)
    assert power_flow_mismatch(grid, point, hosting, Period()) < 1e-5
    run = grid.waveforms_of(hosting, None, [BusFault(bus)], engine="andes")[BusFault(bus)]
    assert run.completed, run.status
    for w in run.waveforms.values():
        assert abs(w.at(0.15)) < 0.75 * abs(w.v[0])
        assert abs(w.v[-1]) == pytest.approx(abs(w.v[0]), abs=0.1)


@pytest.mark.slow
def test_two_processes_may_start_cold_at_once(tmp_path: Path) -> None:
    code = "from dcvrt.grid import andes; print(andes.prepare())"
    own = {**os.environ, "DCVRT_CACHE_DIR": str(tmp_path)}
    runs = [
        subprocess.Popen(
            [sys.executable, "-c", code], env=own, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        for _ in range(2)
    ]
    said = [run.communicate(timeout=300) for run in runs]
    assert [run.returncode for run in runs] == [0, 0], said
    assert said[0][0] == said[1][0]
    assert sum("ANDES generates its code once" in err for _, err in said) == 1
    folder = Path(said[0][0].strip())
    assert folder.parent == tmp_path
    assert sorted(path.name for path in tmp_path.iterdir()) == [folder.name]
    assert (folder / "GENROU.py").is_file()
