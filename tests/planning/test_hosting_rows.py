"""Requirement rows, sites that close, and every message of the hosting problem in full."""

from __future__ import annotations

import itertools
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dcvrt.errors import InfeasibleError, InputError
from dcvrt.grid.network import Network
from dcvrt.planning import N1, HostingProblem, MaxTotal, Row, profiles
from dcvrt.planning.base_case import base_case, short_hours
from dcvrt.planning.certificate import Hours
from tests.grid.native.cases import network
from tests.planning.test_hosting import solve_file

SITES = (21, 75, 106, 108)
NETWORK = Network.ieee118()
YEAR = profiles.ieee118().window(range(8424, 8448))


@pytest.fixture(scope="module")
def problem() -> HostingProblem:
    return HostingProblem(NETWORK, SITES, YEAR, rating_scale=0.6, reactive_limits=False)


def margin(site: int, intercept: float, slope: float, label: str = "") -> Row:
    """intercept + slope * (own + half of each other) >= 0, as a row of the site."""
    return Row(
        {bus: slope * (1.0 if bus == site else 0.5) for bus in SITES},
        -intercept,
        label or f"margin at {site}",
        site,
    )


def test_rows_that_hold_change_nothing(problem: HostingProblem) -> None:
    free = problem.solve()
    held = problem.solve([margin(bus, 10.0, -1e-3) for bus in SITES])
    assert held.total_mw == pytest.approx(free.total_mw, abs=1e-5)
    assert held.closed == {}


def test_row_without_a_site_binds_with_its_price(problem: HostingProblem) -> None:
    plan = problem.solve([Row({75: -1.0}, -50.0, "at most 50 MW at 75")])
    assert plan.by_site[75] == pytest.approx(50.0)
    (row,) = (b for b in plan.binding if b.kind == "row")
    less = problem.solve([Row({75: -1.0}, -50.0 - 0.01, "at most 50.01 MW at 75")])
    assert row.label == "at most 50 MW at 75"
    assert (less.total_mw - plan.total_mw) / 0.01 == pytest.approx(row.price, rel=1e-3)


def test_site_whose_row_fails_at_zero_is_closed_with_the_reason(problem: HostingProblem) -> None:
    plan = problem.solve([margin(75, -0.02, -1e-4, "loss at 75, fault 79, GFL, beta 1.10")])
    assert plan.by_site[75] == 0.0
    beside = sum(plan.by_site.values())
    short = 0.02 + 0.5e-4 * beside
    assert plan.closed == {
        75: f"loss at 75, fault 79, GFL, beta 1.10: {short:.4g} short at 0 MW beside the other sites"
    }
    assert plan.total_mw > 200


def test_reason_of_a_closed_site_and_price_of_a_row_have_units(problem: HostingProblem) -> None:
    failing = [replace(margin(75, -0.02 - 0.001 * k, -1e-4, f"fit {k}"), unit="pu") for k in range(3)]
    for count, more in (
        (1, ""),
        (2, ", and 1 more margin falls short"),
        (3, ", and 2 more margins fall short"),
    ):
        plan = problem.solve(failing[:count])
        short = 0.019 + 0.001 * count + 0.5e-4 * sum(plan.by_site.values())
        assert plan.closed == {
            75: f"fit {count - 1}: {short:.4g} pu short at 0 MW beside the other sites{more}"
        }
    bound = Row({75: -1.0}, -50.0, "at most 50 MW at 75")
    for row, unit in ((replace(bound, unit="MW"), "MW per MW"), (bound, "MW per unit of the row")):
        plan = problem.solve([row])
        assert [b.unit for b in plan.binding if b.kind == "row"] == [unit]


def test_every_site_may_close(problem: HostingProblem) -> None:
    plan = problem.solve([margin(bus, -1.0, -1e-4) for bus in SITES])
    assert plan.total_mw == 0.0
    assert set(plan.closed) == set(SITES)
    assert plan.certificate.hours == len(YEAR)


def test_choice_of_open_sites_equals_enumeration(problem: HostingProblem) -> None:
    rng = np.random.default_rng(5)
    for _ in range(4):
        rows = [
            Row(
                {b: -rng.uniform(0.2, 1.0) * 1e-3 for b in SITES},
                -rng.uniform(-0.02, 0.3),
                f"row {k} of {bus}",
                bus,
            )
            for bus in SITES
            for k in range(2)
        ]
        best = 0.0
        for count in range(1, 5):
            for open_sites in itertools.combinations(SITES, count):
                closed = [Row({bus: -1.0}, 0.0, "closed") for bus in SITES if bus not in open_sites]
                held = [Row(row.coefficients, row.lower, row.label) for row in rows if row.site in open_sites]
                try:
                    best = max(best, problem.solve([*closed, *held]).total_mw)
                except InfeasibleError:
                    continue
        plan = problem.solve(rows)
        assert plan.total_mw == pytest.approx(best, abs=1e-4)
        assert plan.gap == pytest.approx(0.0, abs=1e-6)
        for row in rows:
            if plan.by_site[row.site] > 0:  # type: ignore[index]
                assert row.value(plan.by_site) >= -1e-7


def test_file_with_rows_and_choices_has_the_same_optimum(tmp_path: Path) -> None:
    problem = HostingProblem(
        NETWORK, SITES, YEAR.window(range(8436, 8444)), rating_scale=0.6, voltage_screen="one-shot"
    )
    rows = [
        margin(21, 0.02, -1e-3),
        margin(75, -0.01, -1e-4),
        margin(106, 0.15, -1e-3),
        margin(108, 0.1, -5e-4),
    ]
    plan = problem.solve(rows)
    assert 0 < plan.total_mw < 300
    problem.write_mps(tmp_path / "rows.mps", rows=rows)
    assert plan.total_mw == pytest.approx(solve_file(tmp_path / "rows.mps")[0], rel=1e-6)


def test_smallest_size_closes_a_site_that_cannot_reach_it() -> None:
    """The largest size that is told is no less than what the site has in any plan."""
    sizes = {21: 40.0, 75: 0.0, 106: 0.0, 108: 0.0}
    plan = HostingProblem(NETWORK, SITES, YEAR, rating_scale=0.6, min_size=sizes).solve()
    assert plan.by_site[21] == 0.0
    free = HostingProblem(NETWORK, SITES, YEAR, rating_scale=0.6)
    most = free.solve(objective=MaxTotal({75: 0.0, 106: 0.0, 108: 0.0})).by_site[21]
    assert plan.closed[21] == (
        f"its smallest size is 40 MW, but the limits leave it at most {most:.4g} MW whatever the other "
        "sites host"
    )
    assert free.solve().by_site[21] <= most + 1e-3
    assert not free.allows({21: most + 0.05})


def test_largest_size_of_a_site_leaves_the_problem_as_it_was() -> None:
    asked = HostingProblem(NETWORK, SITES, YEAR, rating_scale=0.6)
    before = asked.solve()
    slope = asked.screen.slope.copy() if asked.screen is not None else None
    most = asked.largest(75)
    assert most >= before.by_site[75]
    assert asked.screen is not None
    assert np.array_equal(slope, asked.screen.slope)
    assert asked.solve().by_site == pytest.approx(before.by_site, abs=1e-4)


def test_smallest_sizes_that_no_site_can_have_are_no_plan() -> None:
    large = HostingProblem(
        NETWORK,
        (21, 75),
        YEAR,
        rating_scale=0.6,
        min_size={21: 90.0, 75: 300.0},
        reactive_limits=False,
    )
    with pytest.raises(InfeasibleError) as error:
        large.solve()
    one, two = (f"{large.largest(bus):.4g}" for bus in (21, 75))
    assert str(error.value) == (
        "ieee118: no site can be opened, as the smallest sizes exceed the limits.\n"
        f"  site 21: at least 90 MW, at most {one} MW fit whatever the others host\n"
        f"  site 75: at least 300 MW, at most {two} MW fit whatever the others host\n"
        "Ways out: smaller min_size, or wider limits."
    )
    one_fits = HostingProblem(
        NETWORK,
        (21, 75),
        YEAR,
        rating_scale=0.6,
        min_size={21: 90.0, 75: large.largest(75) - 1.0},
        reactive_limits=False,
    )
    assert one_fits.solve().by_site[75] > 0


def test_a_site_that_gains_nothing_is_told_the_limits_in_its_way() -> None:
    """Bus 117 hangs on one branch that is full with its own load in the peak hour."""
    lines = NETWORK.branches
    rating = lines.rating.copy()
    rating[(lines.from_bus == 117) | (lines.to_bus == 117)] = 20.0 / 0.6
    full = HostingProblem(NETWORK.with_ratings(rating), (75, 117), YEAR, rating_scale=0.6, voltage=None)
    plan = full.solve()
    assert len(plan.binding) > 3
    assert plan.closed[117] == (
        "hosting here gains nothing within the shared limits (line 12-117 in hour 8441)"
    )


def test_voltages_that_were_held_outside_the_limits_are_told_with_the_verdict() -> None:
    held = HostingProblem(
        NETWORK, SITES, YEAR, 0.6, (0.95, 1.06), reactive_limits=False, base_violations="hold"
    )
    verdict = held.check_ac(held.solve())
    assert held.screen is not None
    assert verdict.passed
    assert verdict.status.startswith(
        f"All 24 hours solve with every voltage within its limits, but for {held.screen.widened} bus-hours "
        "that are outside with nothing hosted and do not get worse."
    )


def test_a_row_without_coefficients_is_not_passed_over(problem: HostingProblem) -> None:
    free = problem.solve()
    assert problem.solve([Row({}, -1.0, "holds"), Row({75: 0.0}, 0.0, "holds")]).total_mw == pytest.approx(
        free.total_mw, abs=1e-4
    )
    with pytest.raises(InfeasibleError) as error:
        problem.solve([Row({75: 0.0}, 1.0, "cannot be", unit="MW")])
    assert "Missed: cannot be (1 MW short at least)." in str(error.value)
    unknown = Row({75: 0.0}, 1.0, "no margin known at 75", 75)
    assert problem.solve([unknown]).closed[75] == "no margin known at 75"
    with pytest.raises(InfeasibleError) as error:
        problem.solve([unknown], must_open=(75,))
    assert "Missed: no margin known at 75 (1 short at least)." in str(error.value)


def test_a_range_without_any_of_its_sizes_is_told_as_such() -> None:
    sized = HostingProblem(NETWORK, SITES, YEAR, rating_scale=0.6, min_size=20.0, reactive_limits=False)
    closed = sized.solve(bounds={75: (0.0, 10.0)}).closed
    assert closed[75] == "the range given to it holds none of its sizes, 20 to 500 MW"
    free = HostingProblem(
        NETWORK,
        SITES,
        YEAR,
        rating_scale=0.6,
        h_max={21: 0.0, 75: 500.0, 106: 500.0, 108: 500.0},
        reactive_limits=False,
    )
    closed = free.solve(bounds={75: (0.0, 0.0)}).closed
    assert closed[75] == "the range given to it holds no size above 0 MW"
    assert closed[21] == "its largest size is 0 MW"


def test_bounds_narrow_the_sizes_of_open_sites(problem: HostingProblem) -> None:
    plan = problem.solve(bounds={75: (0.0, 60.0), 108: (10.0, 20.0)})
    assert plan.by_site[75] == pytest.approx(60.0)
    assert plan.by_site[108] == pytest.approx(20.0)
    free = problem.solve()
    assert plan.total_mw < free.total_mw


def test_capacity_never_falls_as_rows_are_relaxed(problem: HostingProblem) -> None:
    totals = [
        problem.solve([margin(bus, 0.05 * k - 0.1 + 0.01 * i, -3e-4) for i, bus in enumerate(SITES)]).total_mw
        for k in range(6)
    ]
    assert all(more >= less - 1e-5 for less, more in itertools.pairwise(totals))
    assert totals[0] == 0.0
    assert totals[-1] > 300


# -- messages ----------------------------------------------------------------------------------------------


def test_arguments_are_refused_together() -> None:
    with pytest.raises(InputError) as error:
        HostingProblem(
            NETWORK,
            (21, 21, 1180),
            YEAR,
            rating_scale=0.0,
            voltage=(1.06, 0.94),
            pf=1.2,
            h_max={21: 5.0},
            voltage_screen="oneshot",
        )
    known = "Known: 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, ... (118 in all)."
    assert str(error.value) == (
        "hosting problem: 7 problems\n"
        f"  site 1180 is not a bus of ieee118. Did you mean '118'? {known}\n"
        "  site 21 is listed more than once.\n"
        "  rating_scale is 0; it must be a finite number above 0.\n"
        "  voltage limits 1.06 to 0.94 pu must be positive and ascending.\n"
        "  pf is 1.2; it must be above 0 and at most 1.\n"
        "  voltage_screen 'oneshot' is unknown. Did you mean 'one-shot'? Known: relinearised, one-shot.\n"
        "  h_max says nothing about site 1180."
    )


def test_smallest_size_above_the_largest_is_refused() -> None:
    with pytest.raises(InputError) as error:
        HostingProblem(NETWORK, SITES, YEAR, h_max=50.0, min_size=60.0)
    assert str(error.value).splitlines()[:2] == [
        "hosting problem: 4 problems",
        "  min_size 60 MW at site 21 exceeds its h_max 50 MW.",
    ]


def test_negative_size_is_refused() -> None:
    with pytest.raises(InputError) as error:
        HostingProblem(NETWORK, (21,), YEAR, h_max=-1.0)
    assert str(error.value) == (
        "hosting problem: 2 problems\n"
        "  h_max of site 21 is -1 MW; it must be finite and not negative.\n"
        "  min_size 0 MW at site 21 exceeds its h_max -1 MW."
    )


def test_wind_at_an_unknown_bus_is_refused() -> None:
    with pytest.raises(InputError) as error:
        HostingProblem(NETWORK, SITES, profiles.ieee118({690: 10.0}).window(range(4)))
    assert str(error.value) == (
        "hosting problem: wind bus 690 is not a bus of ieee118. Did you mean '90'? "
        "Known: 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, ... (118 in all)."
    )


def test_row_that_names_no_site_is_refused(problem: HostingProblem) -> None:
    with pytest.raises(InputError) as error:
        problem.solve([Row({76: 1.0}, 0.0, "m"), Row({75: float("nan")}, 0.0, "n", 75)])
    assert str(error.value) == (
        "requirement rows: 2 problems\n"
        "  row 'm' names 76, which is not a site. Known: 21, 75, 106, 108.\n"
        "  row 'n' has a coefficient or a limit that is not finite."
    )


def test_bounds_are_refused_together(problem: HostingProblem) -> None:
    with pytest.raises(InputError) as error:
        problem.solve(bounds={5: (0.0, 1.0), 75: (2.0, 1.0), 106: (600.0, 700.0)})
    assert str(error.value) == (
        "bounds: 3 problems\n"
        "  5 is not a site. Did you mean '75'? Known: 21, 75, 106, 108.\n"
        "  the range of site 75 is 2 to 1 MW; it must be ascending and not negative.\n"
        "  the range of site 106, 600 to 700 MW, has nothing in common with its sizes 0 to 500 MW."
    )


def test_rows_that_no_plan_meets_are_named() -> None:
    with pytest.raises(InfeasibleError) as error:
        HostingProblem(NETWORK, SITES, YEAR, rating_scale=0.6).solve(
            [Row({21: 1.0}, 1e4, "aggregate loss, fault 22")]
        )
    assert str(error.value) == (
        "No capacities meet all requirement rows, not even with every site closed. Missed: "
        "aggregate loss, fault 22 (9500 short at least). Ways out: give a row the site that it belongs to, "
        "so that the site can be closed, or relax its limit."
    )


def test_a_row_of_a_site_that_must_be_open_is_named(problem: HostingProblem) -> None:
    with pytest.raises(InfeasibleError) as error:
        problem.solve([margin(21, -0.5, -1e-3, "loss at 21")], must_open=(21,))
    assert str(error.value) == (
        "No capacities meet all requirement rows, not even with every other site closed. Missed: "
        "loss at 21 (0.5 short at least). Ways out: give a row the site that it belongs to, so that the "
        "site can be closed, let site 21 be closed, or relax its limit."
    )


def test_capacities_that_are_none_are_refused_together(problem: HostingProblem) -> None:
    with pytest.raises(InputError) as error:
        problem.allows({5: 1.0, 75: -2.0, 106: float("nan")})
    assert str(error.value) == (
        "capacities: 3 problems\n"
        "  5 is not a site. Did you mean '75'? Known: 21, 75, 106, 108.\n"
        "  the capacity of site 75 is -2 MW; it must be finite and not negative.\n"
        "  the capacity of site 106 is nan MW; it must be finite and not negative."
    )


def test_a_base_case_beyond_the_nose_is_told_as_such() -> None:
    """One line from a stiff source carries at most 1/(2 x) = 100 MW at unity power factor."""
    two = network({1: "slack", 2: "pq"}, [(1, 2, complex(0.0, 0.5))], {1: 300.0}, {2: 110.0})
    year = profiles.Year(np.arange(3), np.array([0.5, 1.0, 0.8]), {}, np.ones(3))
    problem = HostingProblem(two, (2,), year, voltage=(0.5, 1.1), pf=1.0, reactive_limits=False)
    with pytest.raises(InfeasibleError) as error:
        problem.solve()
    assert str(error.value) == (
        f"{two.name}: with nothing hosted 1 of 3 hours have no AC power flow (hours 1).\n"
        "  Newton's method ends with the largest mismatch at bus 2.\n"
        "Ways out: check loads, reactive limits and voltage set points, leave these hours out, or "
        "voltage=None for line limits alone."
    )


def test_overloaded_base_case_names_hours_lines_and_amount() -> None:
    with pytest.raises(InfeasibleError) as error:
        HostingProblem(NETWORK, SITES, YEAR, rating_scale=0.4, voltage=None).solve()
    first, worst, way = str(error.value).splitlines()
    assert first == (
        "ieee118: the base case has no dispatch in 3 of 24 hours (hours 8440-8442) with nothing hosted."
    )
    assert worst == (
        "  Worst hour 8442: branches are overloaded by 1.709 MW whatever the dispatch: "
        "77-78 (rated 60.4 MVA), 77-80 (rated 56.4 MVA)."
    )
    assert way == (
        "Ways out: a larger rating_scale (now 0.4), or more generation behind these branches, "
        "or leave these hours out."
    )


@pytest.mark.parametrize(
    ("scale", "rule", "hours"),
    [(0.38, None, range(8200, 8600)), (0.6, N1(1.0), range(8400, 8460)), (0.25, None, range(0, 8760, 60))],
)
def test_short_hours_and_the_worst_of_them_are_those_of_every_hour_solved(
    scale: float, rule: N1 | None, hours: range
) -> None:
    network = NETWORK.with_ratings(NETWORK.branches.rating * scale)
    year = profiles.ieee118().window(hours)
    short = short_hours(Hours(network, network.indices(SITES), year, rule=rule))
    single = Hours(network, network.indices(SITES), year, hull=False, rule=rule)
    mw = np.array([single.dispatch(np.zeros(len(SITES)), at).shortfall for at in range(len(year))])
    assert short.all_seen
    assert short.worst_known
    assert short.at.tolist() == np.flatnonzero(mw > single.tolerance).tolist()
    worst = next(iter(short.solved.values()))
    assert worst.shortfall == pytest.approx(mw.max(), abs=1e-6)


def test_the_worst_hour_is_not_claimed_where_too_many_are_short() -> None:
    network = NETWORK.with_ratings(0.15 * NETWORK.branches.rating)
    year = profiles.ieee118().window(range(6000, 6700))
    every = Hours(network, network.indices(SITES), year, hull=False)
    short = short_hours(every)
    assert not short.worst_known
    assert 300 <= len(short.solved) < len(short.at)
    assert f"\n  Worst of {len(short.solved)} hours solved, hour " in base_case(every, 0.15)


def test_base_case_that_outages_overload_names_them_and_the_other_branches() -> None:
    """Radial: 1-2 carries 50 MW twice over in the first hour, 1-3 is full in the second."""
    three = network(
        {1: "slack", 2: "pq", 3: "pq"},
        [(1, 2, complex(0.0, 0.1)), (1, 2, complex(0.0, 0.1)), (1, 3, complex(0.0, 0.1))],
        {1: 500.0},
        {2: 100.0},
    )
    rated = three.with_ratings(np.array([60.0, 60.0, 40.0]))
    wind = {3: np.array([0.0, 50.0])}
    year = profiles.Year(np.arange(2), np.array([1.0, 0.55]), wind, np.ones(2))
    with pytest.raises(InfeasibleError) as error:
        HostingProblem(rated, (3,), year, voltage=None, security=N1(1.2)).solve()
    assert str(error.value).splitlines()[1:] == [
        "  Worst hour 0: branches are overloaded by 28 MW whatever the dispatch: 1-2 (rated 72 MVA after the "
        "outage of 1-2).",
        "  In other hours: 1-3 (with others by 10 MW in hour 1).",
        "Ways out: a larger rating_scale (now 1), a larger factor on ratings after an outage (now 1.2), or "
        "more generation behind these branches, or leave these hours out.",
    ]


def test_base_case_without_enough_units_says_so() -> None:
    units = NETWORK.generators
    weak = replace(NETWORK, generators=replace(units, p_max=0.35 * units.p_max))
    with pytest.raises(InfeasibleError) as error:
        HostingProblem(weak, SITES, YEAR, rating_scale=10.0, voltage=None).solve()
    lines = str(error.value).splitlines()
    assert lines[0].startswith(
        "ieee118: the base case has no dispatch in 10 of 24 hours (hours 8433-8437, 8440-8444) "
    )
    assert lines[1] == (
        "  Worst hour 8442: units that give 0 to 3488.2 MW cannot meet a net load of 3835.4 MW "
        "(347.2 MW off)."
    )
    assert lines[2] == "Ways out: more units, or other limits of theirs, or leave these hours out."


def test_voltages_outside_the_limits_before_hosting_are_named() -> None:
    with pytest.raises(InfeasibleError) as error:
        HostingProblem(NETWORK, SITES, YEAR, voltage=(0.95, 1.06), reactive_limits=False).solve()
    lines = str(error.value).splitlines()
    assert lines[0] == "ieee118: with nothing hosted 3 bus(es) are outside the voltage limits 0.95-1.06 pu."
    assert lines[1] == "  bus 53: outside in 14 hours (8431-8444), worst 0.9459 pu in hour 8441"
    assert lines[3] == "  bus 76: holds its set point 0.9430 pu"
    assert lines[-1] == (
        "Ways out: wider voltage limits, other set points, or base_violations='hold', with which "
        "these voltages must only not get worse."
    )


def test_a_range_below_the_least_size_closes_a_site() -> None:
    problem = HostingProblem(NETWORK, SITES, YEAR, rating_scale=0.6, min_size=25.0, reactive_limits=False)
    plan = problem.solve(bounds={75: (0.0, 24.0), 106: (0.0, 30.0)})
    assert plan.by_site[75] == 0.0
    assert 25.0 <= plan.by_site[106] <= 30.0
    with pytest.raises(InputError, match="the range of site 75, 10 to 24 MW, has nothing in common"):
        problem.solve(bounds={75: (10.0, 24.0)})


def test_only_sizes_that_a_site_may_have_are_allowed() -> None:
    problem = HostingProblem(
        NETWORK, SITES, YEAR, rating_scale=0.6, h_max=60.0, min_size=25.0, reactive_limits=False
    )
    assert problem.allows({75: 25.0, 106: 0.0})
    assert not problem.allows({75: 24.9})
    assert not problem.allows({75: 60.1})


def test_the_solver_of_the_programmes_is_silent() -> None:
    """What a C library prints would stand in the output of `--json`."""
    code = "from dcvrt.planning.master import highs; highs().run()"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout == ran.stderr == ""


def test_voltages_outside_the_limits_can_be_held() -> None:
    held = HostingProblem(NETWORK, SITES, YEAR, voltage=(0.95, 1.06), base_violations="hold")
    plan = held.solve()
    assert plan.voltage is not None
    assert plan.voltage.widened > 24
    assert 0 <= plan.total_mw < 300
    assert held.check_ac(plan).passed


def test_path_that_cannot_be_written_is_refused(problem: HostingProblem, tmp_path: Path) -> None:
    with pytest.raises(InputError) as error:
        problem.write_mps(tmp_path / "check.lp", hours=range(8424, 8425))
    assert str(error.value) == f"{tmp_path / 'check.lp'}: the file must be called .mps."
    with pytest.raises(InputError) as error:
        problem.write_mps(tmp_path / "none" / "check.mps", hours=range(8424, 8425))
    assert str(error.value) == f"{tmp_path / 'none' / 'check.mps'}: there is no folder {tmp_path / 'none'}."


def test_hours_outside_the_problem_are_refused(problem: HostingProblem, tmp_path: Path) -> None:
    with pytest.raises(InputError) as error:
        problem.write_mps(tmp_path / "check.mps", hours=range(10))
    assert str(error.value) == "hour 0 is not among the 24 operating hours (8424 to 8447)."


@pytest.mark.parametrize(("v_min", "x"), [(0.9, 0.5), (0.75, 0.5), (0.95, 0.2)])
def test_a_proposal_beyond_the_nose_is_left_for_the_voltage_limit(v_min: float, x: float) -> None:
    """One line x from a stiff source to a site at unity power factor: V^2 = (1 + sqrt(1 - (2 P x)^2))/2.

    With nothing hosted the voltage does not fall at all, so the first proposal is the largest size allowed,
    ten times what the line can carry.
    """
    two = network({1: "slack", 2: "pq"}, [(1, 2, complex(0.0, x))], {1: 100.0})
    year = profiles.Year(np.arange(3), np.ones(3), {}, np.array([0.5, 1.0, 0.8]))
    problem = HostingProblem(
        two, (2,), year, voltage=(v_min, 1.1), pf=1.0, h_max=500.0 / x, reactive_limits=False
    )
    plan = problem.solve()
    hosted = 100.0 * np.sqrt(1.0 - (2.0 * v_min**2 - 1.0) ** 2) / (2.0 * x)
    assert plan.total_mw == pytest.approx(hosted, rel=1e-5)
    assert problem.check_ac(plan).passed


def test_a_row_that_no_size_meets_closes_its_site_with_its_own_words(problem: HostingProblem) -> None:
    plan = problem.solve([Row({75: 0.0}, 1.0, "no margin known at 75: it did not start", 75)])
    assert plan.closed[75] == "no margin known at 75: it did not start"
