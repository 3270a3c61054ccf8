"""The hosting programme equals a monolithic solve, certifies every hour, and prices what binds."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import highspy
import numpy as np
import pytest

from dcvrt.grid.network import Network
from dcvrt.planning import HostingProblem, Plan, profiles
from dcvrt.planning.certificate import corner_hours
from dcvrt.planning.profiles import Year

SITES = (21, 75, 106, 108)
NETWORK = Network.ieee118()
YEAR = profiles.ieee118()
LOAD_BUSES = [int(b) for b, kind in zip(NETWORK.bus, NETWORK.kind, strict=True) if kind == "pq"]


def window(start: int, length: int) -> Year:
    return YEAR.window(range(start, start + length))


def solve_file(path: Path) -> tuple[float, dict[str, float]]:
    """Optimum and columns of an MPS file, by HiGHS as it comes."""
    solver = highspy.Highs()
    solver.setOptionValue("output_flag", False)
    solver.readModel(str(path))
    solver.run()
    assert solver.getModelStatus() == highspy.HighsModelStatus.kOptimal
    values = solver.getSolution().col_value
    names = [solver.getColName(j)[1] for j in range(solver.getNumCol())]
    return solver.getInfo().objective_function_value, dict(zip(names, values, strict=True))


def random_problem(seed: int, **options: object) -> HostingProblem:
    """Five random load buses, twelve random hours, ratings tight enough for lines to bind."""
    rng = np.random.default_rng(seed)
    sites = tuple(int(b) for b in rng.choice(LOAD_BUSES, 5, replace=False))
    start, scale = int(rng.integers(0, 8748)), rng.uniform(0.45, 0.6)
    return HostingProblem(
        NETWORK, sites, window(start, 12), rating_scale=scale, pf=0.97, h_max=400.0, **options
    )  # type: ignore[arg-type]


# Seeds whose optimum has lines and voltages binding together.
BOTH_BIND = (0, 1, 2, 3, 4, 5, 6, 7, 9, 10, 11, 12, 14, 16)


@pytest.mark.parametrize("seed", BOTH_BIND)
def test_equals_the_monolith_with_lines_and_voltages_binding(seed: int, tmp_path: Path) -> None:
    problem = random_problem(seed, voltage_screen="one-shot")
    plan = problem.solve()
    assert {"line", "voltage"} <= {b.kind for b in plan.binding}
    problem.write_mps(tmp_path / "check.mps")
    total, _ = solve_file(tmp_path / "check.mps")
    assert plan.total_mw == pytest.approx(total, rel=1e-8)


@pytest.mark.parametrize("start", [0, 4368, 8400])
def test_equals_the_monolith_on_windows_of_the_study(start: int, tmp_path: Path) -> None:
    problem = HostingProblem(NETWORK, SITES, window(start, 60), rating_scale=0.6)
    plan = problem.solve()
    problem.write_mps(tmp_path / "check.mps", around=plan)
    total, columns = solve_file(tmp_path / "check.mps")
    assert plan.total_mw == pytest.approx(total, rel=1e-6)
    assert {bus: columns[f"H_{bus}"] for bus in SITES} == pytest.approx(plan.by_site, abs=1e-2)


def test_part_of_the_year_can_be_written_from_the_problem_of_the_year(tmp_path: Path) -> None:
    hours = range(8430, 8454)
    whole = HostingProblem(NETWORK, SITES, YEAR, rating_scale=0.6, voltage=None)
    part = HostingProblem(NETWORK, SITES, YEAR.window(hours), rating_scale=0.6, voltage=None)
    whole.write_mps(tmp_path / "part.mps", hours=hours)
    assert part.solve().total_mw == pytest.approx(solve_file(tmp_path / "part.mps")[0], rel=1e-8)


@pytest.mark.parametrize("voltage", [(0.94, 1.06), None])
def test_every_hour_has_a_dispatch_within_all_limits(voltage: tuple[float, float] | None) -> None:
    year = window(8400, 48)
    problem = HostingProblem(NETWORK, SITES, year, rating_scale=0.5, voltage=voltage)
    plan = problem.solve()
    assert plan.certificate.hours == 48
    units, lines = NETWORK.generators, NETWORK.branches
    laplacian = (NETWORK.incidence.T.multiply(NETWORK.susceptance) @ NETWORK.incidence).toarray()
    keep = np.delete(np.arange(118), NETWORK.slack)
    for hour in year.hours:
        now = year.at(int(hour))
        injection = -now.load * NETWORK.p_load
        for bus, mw in now.wind.items():
            injection[NETWORK.index(bus)] += mw
        for bus, mw in plan.by_site.items():
            injection[NETWORK.index(bus)] -= now.dc * mw
        g = problem.dispatch(plan, int(hour))
        assert (g >= units.p_min - 1e-7).all()
        assert (g <= units.p_max + 1e-7).all()
        np.add.at(injection, NETWORK.generator_index, g)
        assert injection.sum() == pytest.approx(0.0, abs=1e-5)
        theta = np.zeros(118)
        theta[keep] = np.linalg.solve(laplacian[np.ix_(keep, keep)], injection[keep])
        flow = NETWORK.susceptance * (NETWORK.incidence @ theta)
        assert (abs(flow) <= 0.5 * lines.rating + 1e-5).all()


def test_a_little_more_at_any_site_breaks_a_limit() -> None:
    problem = HostingProblem(NETWORK, SITES, window(8400, 48), rating_scale=0.6, voltage=None)
    plan = problem.solve()
    for bus in SITES:
        more = np.array([mw + (0.01 if site == bus else 0.0) for site, mw in plan.by_site.items()])
        assert problem.certifier.certify(more) is not None


def test_more_rating_never_hosts_less() -> None:
    for voltage in ((0.94, 1.06), None):
        totals = [
            HostingProblem(NETWORK, SITES, window(8400, 48), scale, voltage).solve().total_mw
            for scale in (0.45, 0.5, 0.6, 0.8)
        ]
        assert all(more >= less - 1e-5 for less, more in itertools.pairwise(totals))
    assert totals[-1] > totals[0] + 100.0


def test_corner_hours_give_the_answer_of_all_hours() -> None:
    year = window(7400, 1200)
    assert len(corner_hours(year)) < 600
    short, full = (
        HostingProblem(NETWORK, SITES, year, rating_scale=0.6, voltage=None, hull=hull)
        for hull in (True, False)
    )
    assert short.solve().total_mw == pytest.approx(full.solve().total_mw, rel=1e-9)
    assert full.solve().certificate.combination == 0


def test_solving_again_gives_the_same_plan() -> None:
    problem = HostingProblem(NETWORK, SITES, window(8400, 48), rating_scale=0.5)
    first, again = problem.solve(), problem.solve()
    assert again.by_site == pytest.approx(first.by_site, abs=1e-4)
    assert again.total_mw == pytest.approx(first.total_mw, abs=1e-5)


def test_line_prices_equal_differences() -> None:
    year, step = window(8424, 24), 1e-3

    def total(network: Network) -> Plan:
        return HostingProblem(network, SITES, year, voltage=None).solve()

    scaled = replace(NETWORK, branches=replace(NETWORK.branches, rating=0.6 * NETWORK.branches.rating))
    plan = total(scaled)
    priced = [b for b in plan.binding if b.kind == "line"]
    assert len({b.label for b in priced}) >= 4
    labels = [scaled.branches.label(k) for k in range(len(scaled.branches))]
    for label in {b.label for b in priced}:
        change = step * (np.array(labels) == label)
        up, down = (
            total(
                replace(
                    scaled, branches=replace(scaled.branches, rating=scaled.branches.rating + sign * change)
                )
            )
            for sign in (1, -1)
        )
        price = sum(b.price for b in priced if b.label == label)
        assert (up.total_mw - down.total_mw) / (2 * step) == pytest.approx(price, rel=1e-4)


def test_voltage_prices_equal_differences_of_the_nonlinear_optimum() -> None:
    year, step = window(8424, 24), 1e-5

    def total(low: float) -> Plan:
        return HostingProblem(NETWORK, SITES, year, rating_scale=0.6, voltage=(low, 1.06)).solve()

    plan = total(0.94)
    assert {b.kind for b in plan.binding} == {"voltage"}
    slope = (total(0.94 - step).total_mw - total(0.94 + step).total_mw) / (2 * step)
    assert slope == pytest.approx(sum(b.price for b in plan.binding), rel=1e-3)


def test_relinearised_screen_agrees_with_ac_and_one_shot_overstates() -> None:
    year = window(8400, 168)
    plans = {}
    for name in ("one-shot", "relinearised"):
        problem = HostingProblem(
            NETWORK, SITES, year, rating_scale=0.6, voltage_screen=name, reactive_limits=False
        )
        plan = problem.solve()
        plans[name] = plan, problem.check_ac(plan)
    (loose, loose_ac), (tight, tight_ac) = plans["one-shot"], plans["relinearised"]
    assert tight_ac.passed
    assert tight_ac.v_min_pu == pytest.approx(0.94, abs=1e-6)
    assert tight_ac.v_error_pu < 1e-4
    assert tight.voltage is not None
    assert tight.voltage.v_error_pu < 1e-4
    assert tight_ac.status.startswith("All 168 hours solve with every voltage within its limits. Units ")
    assert not loose_ac.passed
    assert loose_ac.v_min_pu < 0.9385
    assert loose_ac.v_error_pu > 1e-3
    assert loose.total_mw > 1.03 * tight.total_mw
    assert (loose_ac.hour, loose_ac.bus) == (8441, 106)
    assert f"the worst is {loose_ac.v_min_pu:.5f} pu at bus 106 in hour 8441. Units " in loose_ac.status


def test_largest_size_binds_with_a_price_of_one() -> None:
    plan = HostingProblem(NETWORK, SITES, window(0, 24), h_max=5.0).solve()
    assert plan.total_mw == pytest.approx(20.0)
    assert [(b.kind, b.bus, b.price) for b in plan.binding] == [
        ("bound", bus, pytest.approx(1.0)) for bus in (106, 108, 21, 75)
    ]
    assert str(plan.binding[2]) == "bound largest size of site 21: 1 MW/MW"
    assert list(plan.table().columns) == [
        *("kind", "label", "hour", "bus", "price", "unit", "limit"),
        *("outage", "period", "fault", "mode", "target"),
    ]


def test_unit_limits_are_named_where_generation_is_short() -> None:
    units = NETWORK.generators
    tight = replace(NETWORK, generators=replace(units, p_max=units.p_max * 0.44))
    problem = HostingProblem(tight, SITES, window(8424, 24), rating_scale=10.0, voltage=None)
    plan = problem.solve()
    hour = plan.binding[0].hour
    assert hour is not None
    now = YEAR.at(hour)
    spare = tight.generators.p_max.sum() + sum(now.wind.values()) - now.load * NETWORK.p_load.sum()
    assert plan.total_mw == pytest.approx(spare / now.dc, rel=1e-9)
    assert {b.kind for b in plan.binding} == {"generator"}
    assert plan.binding[0].price == pytest.approx(1 / now.dc)


@pytest.mark.slow
def test_year_is_solved_certified_and_passes_ac() -> None:
    problem = HostingProblem(NETWORK, SITES, YEAR, rating_scale=0.6, reactive_limits=False)
    plan = problem.solve()
    assert plan.certificate.hours == 8760
    assert problem.check_ac(plan).passed
    assert plan.total_mw == pytest.approx(365.5527, abs=1e-3)
    week = HostingProblem(NETWORK, SITES, window(8400, 168), rating_scale=0.6, reactive_limits=False).solve()
    assert plan.total_mw <= week.total_mw + 1e-4
