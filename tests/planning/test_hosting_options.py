"""Objectives, ratings, N-1 security and hourly unit limits: each equals the programme written out whole."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dcvrt.errors import InfeasibleError, InputError
from dcvrt.grid.network import Network
from dcvrt.planning import N1, HostingProblem, MaxMin, MaxTotal, Rating, Row, profiles
from dcvrt.planning.profiles import Year
from tests.planning.test_hosting import solve_file

SITES = (21, 75, 106, 108)
NETWORK = Network.ieee118()
DAY = profiles.ieee118().window(range(8424, 8448))


@pytest.fixture(scope="module")
def problem() -> HostingProblem:
    return HostingProblem(NETWORK, SITES, DAY, rating_scale=0.6)


@pytest.fixture(scope="module")
def lines() -> HostingProblem:
    """Sites behind the same lines, so that what one gains another loses."""
    return HostingProblem(NETWORK, (105, 106, 107, 108), DAY, rating_scale=0.6, voltage=None)


def without(network: Network, k: int) -> Network:
    """The network with branch k taken out."""
    lines = network.branches
    keep = np.arange(len(lines)) != k
    return replace(
        network, branches=type(lines)(**{name: getattr(lines, name)[keep] for name in vars(lines)})
    )


# -- N-1 ---------------------------------------------------------------------------------------------------


def test_distribution_factors_equal_the_network_with_the_branch_out(problem: HostingProblem) -> None:
    secured = HostingProblem(NETWORK, SITES, DAY, rating_scale=2.0, voltage=None, security=N1())
    outages = secured.certifier.outages
    rng = np.random.default_rng(2)
    injection = rng.normal(size=118) * 60
    flow = NETWORK.flows(injection)
    for k in rng.choice(len(outages), 12, replace=False):
        out = int(outages.branch[k])
        after = np.delete(flow + outages.factors[:, k] * flow[out], out)
        assert after == pytest.approx(without(NETWORK, out).flows(injection), abs=1e-7)


def test_outages_that_split_the_network_are_named_not_covered() -> None:
    secured = HostingProblem(NETWORK, SITES, DAY.window(range(8430, 8432)), 2.0, None, security=N1(1.3))
    info = secured.solve().security
    assert info is not None
    assert len(info.islanding) + info.outages == len(NETWORK.branches)
    labels = [NETWORK.branches.label(k) for k in range(len(NETWORK.branches))]
    for label in info.islanding:
        with pytest.raises(InputError, match="no path to the slack bus"):
            without(NETWORK, labels.index(label))


@pytest.mark.parametrize("emergency", [1.1, 1.3])
def test_secured_plan_equals_the_monolith_and_survives_every_outage(emergency: float, tmp_path: Path) -> None:
    year = DAY.window(range(8440, 8443))
    secured = HostingProblem(NETWORK, SITES, year, 1.4, None, security=N1(emergency))
    plan = secured.solve()
    secured.write_mps(tmp_path / "n1.mps")
    assert plan.total_mw == pytest.approx(solve_file(tmp_path / "n1.mps")[0], rel=1e-7)
    assert plan.total_mw < HostingProblem(NETWORK, SITES, year, 1.4, None).solve().total_mw - 1
    assert any(b.outage for b in plan.binding)
    outages, limit = secured.certifier.outages, emergency * secured.network.branches.rating
    for hour in year.hours:
        injection = secured.certifier.injection(np.array(list(plan.by_site.values())), int(hour) - 8440)
        np.add.at(injection, NETWORK.generator_index, secured.dispatch(plan, int(hour)))
        for out in outages.branch.tolist():
            flow = without(NETWORK, out).flows(injection)
            assert (abs(flow) <= np.delete(limit, out) + 1e-4).all()


def test_price_of_a_line_after_an_outage_equals_a_difference() -> None:
    year, step = DAY.window(range(8440, 8443)), 1e-3

    def total(change: np.ndarray) -> float:
        rating = 1.4 * NETWORK.branches.rating + change
        scaled = replace(NETWORK, branches=replace(NETWORK.branches, rating=rating))
        return HostingProblem(scaled, SITES, year, 1.0, None, security=N1(1.2)).solve().total_mw

    plan = HostingProblem(NETWORK, SITES, year, 1.4, None, security=N1(1.2)).solve()
    labels = np.array([NETWORK.branches.label(k) for k in range(len(NETWORK.branches))])
    lines = {b.label for b in plan.binding if b.outage}
    smooth = 0
    for label in lines:
        per_mva = sum(b.price * (1.2 if b.outage else 1.0) for b in plan.binding if b.label == label)
        change = step * (labels == label)
        up, down = (total(change) - plan.total_mw) / step, (plan.total_mw - total(-change)) / step
        assert up - 1e-4 <= per_mva <= down + 1e-4  # the optimum is concave in the ratings
        smooth += abs(up - down) < 1e-4
    assert smooth


def test_line_after_an_outage_says_which() -> None:
    plan = HostingProblem(NETWORK, SITES, DAY.window(range(8440, 8443)), 1.4, None, security=N1(1.2)).solve()
    (first, *_) = (b for b in plan.binding if b.outage)
    assert f"line {first.label} after the outage of {first.outage} in hour {first.hour}: " in str(first)


def test_unknown_outage_is_refused() -> None:
    with pytest.raises(InputError) as error:
        HostingProblem(NETWORK, SITES, DAY, security=N1(0.0, ["77-81"]))
    text = str(error.value)
    assert text.startswith(
        "hosting problem: 2 problems\n  outage '77-81' is not a branch of ieee118. Did you"
    )
    assert text.endswith("\n  emergency is 0; it must be a finite number above 0.")


# -- unit limits that vary ---------------------------------------------------------------------------------


def outage_of_units(year: Year) -> Year:
    """Large units at less than half for the first part of the hours, and one that must run after that."""
    n, units = len(year), NETWORK.generators
    early = np.arange(n) < 2 * n // 3
    large = np.flatnonzero(units.p_max > 250)
    off = {units.name[g]: np.where(early, 0.35, 1.0) * units.p_max[g] for g in large}
    return replace(year, p_max=off, p_min={"G80": np.where(early, 0.0, 300.0)})


def test_unit_limits_of_the_hour_equal_the_monolith(tmp_path: Path) -> None:
    year = outage_of_units(DAY)
    varied = HostingProblem(NETWORK, SITES, year, rating_scale=0.6, voltage=None)
    plan = varied.solve()
    varied.write_mps(tmp_path / "units.mps")
    assert plan.total_mw == pytest.approx(solve_file(tmp_path / "units.mps")[0], rel=1e-8)
    assert plan.total_mw < HostingProblem(NETWORK, SITES, DAY, 0.6, None).solve().total_mw - 1
    names = NETWORK.generators.name
    for k in (0, 23):
        given_out = varied.dispatch(plan, 8424 + k)
        assert given_out[names.index("G10")] <= year.p_max["G10"][k] + 1e-7
        assert given_out[names.index("G80")] >= year.p_min["G80"][k] - 1e-7


def test_corner_hours_count_unit_limits_as_parameters() -> None:
    whole = profiles.ieee118({}).window(range(7400, 8600))
    year = replace(whole, p_max={"G10": 300 + 200 * np.cos(np.arange(1200) / 9.0)})
    short, full = (HostingProblem(NETWORK, SITES, year, 0.55, None, hull=hull) for hull in (True, False))
    assert short.solve().total_mw == pytest.approx(full.solve().total_mw, rel=1e-9)
    assert short.solve().certificate.combination > 0


def test_limits_of_unknown_units_and_crossed_limits_are_refused_together() -> None:
    wrong = replace(DAY, p_max={"G10": np.full(24, -1.0), "G11": np.zeros(24)})
    with pytest.raises(InputError) as error:
        HostingProblem(NETWORK, SITES, wrong)
    first, crossed, unknown = str(error.value).splitlines()
    assert first == "hosting problem: 2 problems"
    assert crossed == "  unit G10 has p_min 0 MW above p_max -1 MW in hour 8424 (24 hours in all)."
    assert unknown.startswith("  unit 'G11' is not in ieee118. Did you mean 'G116'?")


# -- objectives --------------------------------------------------------------------------------------------


def test_weights_move_capacity_to_the_site_that_is_worth_more(lines: HostingProblem, tmp_path: Path) -> None:
    plain, favoured = lines.solve(), lines.solve(objective=MaxTotal({108: 3.0}))
    assert favoured.by_site[108] > plain.by_site[108] + 1
    assert favoured.objective == pytest.approx(favoured.total_mw + 2 * favoured.by_site[108])
    lines.write_mps(tmp_path / "w.mps", around=favoured, objective=MaxTotal({108: 3.0}))
    assert favoured.objective == pytest.approx(solve_file(tmp_path / "w.mps")[0], rel=1e-6)


def test_least_size_equals_the_monolith_and_no_site_is_smaller(lines: HostingProblem, tmp_path: Path) -> None:
    fair = lines.solve(objective=MaxMin({108: 2.0}))
    share = np.array([1.0, 1.0, 1.0, 2.0])
    size = np.array(list(fair.by_site.values())) / share
    assert size.min() == pytest.approx(fair.objective, rel=1e-6)
    assert fair.total_mw < lines.solve().total_mw
    lines.write_mps(tmp_path / "fair.mps", around=fair, objective=MaxMin({108: 2.0}))
    assert fair.objective == pytest.approx(solve_file(tmp_path / "fair.mps")[0], rel=1e-5)


def test_front_runs_from_the_largest_total_to_the_largest_least_size(lines: HostingProblem) -> None:
    front = lines.pareto(5)
    least = [min(plan.by_site.values()) for plan in front]
    total = [plan.total_mw for plan in front]
    assert total[0] == pytest.approx(lines.solve().total_mw, abs=1e-4)
    assert least[-1] == pytest.approx(lines.solve(objective=MaxMin()).objective, rel=1e-5)
    assert (np.diff(least) > 0).all()
    assert (np.diff(total) < 1e-6).all()
    assert total[-1] < total[0] - 1
    slopes = np.diff(total) / np.diff(least)
    assert (np.diff(slopes) < 1e-3).all()  # concave: each further MW for the smallest costs more


def test_a_front_without_conflict_is_one_plan() -> None:
    """Two sites, each behind a line of its own: the largest total has the largest least size."""
    apart = HostingProblem(NETWORK, (21, 108), DAY, rating_scale=0.6, voltage=None)
    (only,) = apart.pareto(6)
    assert only.by_site == apart.solve().by_site
    assert min(only.by_site.values()) == pytest.approx(apart.solve(objective=MaxMin()).objective, rel=1e-6)


def test_a_front_that_jumps_has_each_plan_once(problem: HostingProblem) -> None:
    """Site 21 opens only beside a small 106: the least size jumps from 0 to what it then is."""
    row = Row({21: 0.002, 106: -0.003}, 0.02, "loss 21", 21)
    front = problem.pareto(6, rows=[row])
    total = np.array([plan.total_mw for plan in front])
    least = np.array([min(plan.by_site.values()) for plan in front])
    assert least[0] == 0
    assert len(front) < 6
    assert (np.diff(total) < -1e-3).all()
    assert (np.diff(least) > 1e-3).all()


def test_site_without_room_does_not_count_in_the_least_size(problem: HostingProblem) -> None:
    plan = problem.solve(bounds={21: (0.0, 0.0)}, objective=MaxMin())
    assert plan.by_site[21] == 0
    assert plan.objective > 20


def test_objectives_are_refused_with_all_faults(problem: HostingProblem) -> None:
    with pytest.raises(InputError) as error:
        problem.solve(objective=MaxTotal({76: 1.0, 75: -1.0}), rating=Rating(2.0, 1.0, -1.0), must_open=(5,))
    known = "Known: 21, 75, 106, 108."
    assert str(error.value) == (
        "objective: 5 problems\n"
        f"  weight names 76, which is not a site. {known}\n"
        "  weight of site 75 is -1; it must be finite and not negative.\n"
        "  rating ratios are 2 to 1; they must be ascending and not negative.\n"
        "  cost of ratings is -1; it must be finite and not negative.\n"
        f"  must_open names 5, which is not a site. Did you mean '75'? {known}"
    )
    with pytest.raises(InputError) as error:
        problem.solve([Row({5: 1.0}, 0.0, "odd")], {75: (5.0, 1.0)}, must_open=(6,))
    assert str(error.value) == (
        "hosting problem: 3 problems\n"
        "  bounds: the range of site 75 is 5 to 1 MW; it must be ascending and not negative.\n"
        f"  requirement rows: row 'odd' names 5, which is not a site. Did you mean '75'? {known}\n"
        f"  objective: must_open names 6, which is not a site. {known}"
    )
    for asked in (
        lambda: problem.solve(objective=MaxMin(dict.fromkeys(SITES, 0.0))),
        lambda: problem.pareto(3, bounds=dict.fromkeys(SITES, (0.0, 0.0))),
    ):
        with pytest.raises(InputError) as error:
            asked()
        assert str(error.value) == (
            "objective: no site counts in the least size: each has share 0, or a largest size of 0 MW."
        )
    with pytest.raises(InputError) as error:
        problem.pareto(1)
    assert str(error.value) == "pareto: 1 points; a front has at least 2."


# -- converter ratings -------------------------------------------------------------------------------------


def margins(shift: dict[int, float] | None = None) -> list[Row]:
    """A share of load that more rating per site raises and more hosting lowers. Made up."""
    return [
        Row(
            {bus: -5e-3 if bus == site else -1e-4 for bus in SITES},
            -0.10 - 0.05 * i - (shift or {}).get(site, 0.0),
            f"loss at {site}",
            site,
            "share of load",
            rating={site: 2e-3},
            fault=f"{20 + i}",
            mode="GFL",
            target="loss",
        )
        for i, site in enumerate(SITES)
    ]


def test_siting_and_rating_are_decided_together(problem: HostingProblem, tmp_path: Path) -> None:
    totals = []
    for cost in (0.0, 0.3, 0.8):
        rating = Rating(1.0, 1.5, cost)
        plan = problem.solve(margins(), rating=rating)
        mva, mw = (np.array(list(x.values())) for x in (plan.rating_mva, plan.by_site))
        assert (mva >= mw - 1e-6).all()
        assert (mva <= 1.5 * mw + 1e-6).all()
        assert plan.objective == pytest.approx(mw.sum() - cost * mva.sum(), abs=1e-6)
        problem.write_mps(tmp_path / "s.mps", rows=margins(), around=plan, rating=rating)
        assert plan.objective == pytest.approx(solve_file(tmp_path / "s.mps")[0], rel=1e-6)
        totals.append(plan.total_mw)
    assert totals[0] >= totals[1] >= totals[2]
    assert totals[0] > totals[2] + 1


def test_price_of_a_rating_equals_a_difference(problem: HostingProblem) -> None:
    ratio, step = Rating(1.2, 1.2), 1e-2
    plan = problem.solve(margins(), rating=ratio)
    priced = [b for b in plan.binding if b.kind == "rating"]
    assert priced
    assert {b.unit for b in priced} == {"MW/MVA"}
    for b in priced:  # one MVA more at the same capacity lifts the margin by its slope
        up, down = (
            problem.solve(margins({b.bus: sign * 2e-3 * step}), rating=ratio).total_mw  # type: ignore[dict-item]
            for sign in (1, -1)
        )
        assert (up - down) / (2 * step) == pytest.approx(b.price, rel=1e-4)


def test_price_of_a_criterion_and_of_a_budget_equal_differences(problem: HostingProblem) -> None:
    def plan(share: float = 0.0, mva: float = 0.0) -> tuple[float, dict[str, float]]:
        rows = margins(dict.fromkeys(SITES, share))
        budget = Row({}, -np.inf, "budget", unit="MVA", upper=250.0 + mva, rating=dict.fromkeys(SITES, 1.0))
        found = problem.solve([*rows, budget], rating=Rating(1.0, 1.5))
        return found.total_mw, {b.label: b.price for b in found.binding if b.kind == "row"}

    _, prices = plan()
    assert "budget" in prices
    step = 1e-4
    criterion = sum(price for label, price in prices.items() if label.startswith("loss"))
    assert criterion > 100
    assert (plan(step)[0] - plan(-step)[0]) / (2 * step) == pytest.approx(criterion, rel=1e-4)
    assert (plan(0.0, 0.01)[0] - plan(0.0, -0.01)[0]) / 0.02 == pytest.approx(prices["budget"], rel=1e-4)


def test_price_of_a_rating_within_a_budget_is_what_its_margins_gain(problem: HostingProblem) -> None:
    """The budget has a price of its own: a rating is not told to cost what it takes from there."""
    limit = {"unit": "MVA", "rating": dict.fromkeys(SITES, 1.0)}
    budget, ratio, step = Row({}, -np.inf, "budget", upper=250.0, **limit), Rating(1.0, 1.5), 1e-2
    plan = problem.solve([*margins(), budget], rating=ratio)
    priced = {b.bus: b.price for b in plan.binding if b.kind == "rating"}
    assert len(priced) >= 2
    for bus, price in priced.items():
        assert price > 0
        up, down = (
            problem.solve([*margins({bus: sign * 2e-3 * step}), budget], rating=ratio).total_mw
            for sign in (1, -1)
        )
        assert (up - down) / (2 * step) == pytest.approx(price, rel=1e-3)
    small = problem.solve([*margins(), replace(budget, upper=150.0)], rating=ratio)
    assert not [b for b in small.binding if b.kind == "rating"]
    closed = next(bus for bus, mw in small.by_site.items() if mw == 0)
    assert small.closed[closed] == "hosting here gains nothing within the shared limits (row budget)"


def test_what_binds_names_fault_mode_and_target(problem: HostingProblem) -> None:
    plan = problem.solve(margins(), rating=Rating(1.0, 1.0))
    (first, *_) = (b for b in plan.binding if b.kind == "row")
    assert (first.mode, first.target) == ("GFL", "loss")
    assert first.label == f"loss at {SITES[int(first.fault) - 20]}"
    assert plan.table().set_index("label").loc[first.label, "fault"] == first.fault


def test_rows_with_ratings_need_ratings(problem: HostingProblem) -> None:
    with pytest.raises(InputError) as error:
        problem.solve(margins()[:1])
    assert str(error.value) == (
        "requirement rows: row 'loss at 21' contains converter ratings, but none are asked for. "
        "Way out: solve(..., rating=Rating(...))."
    )


# -- limits in MW, sizes -----------------------------------------------------------------------------------


def test_aggregate_loss_in_mw_binds_with_its_price(problem: HostingProblem, tmp_path: Path) -> None:
    row = Row(
        {21: 0.1, 75: 0.3, 106: 0.2, 108: 0.4}, -np.inf, "loss, fault 79", unit="MW", upper=60.0, fault="79"
    )
    plan = problem.solve([row])
    (bound,) = (b for b in plan.binding if b.kind == "row")
    assert (bound.limit, bound.unit, bound.fault) == (60.0, "MW per MW", "79")
    more = problem.solve([replace(row, upper=60.01)]).total_mw
    assert (more - plan.total_mw) / 0.01 == pytest.approx(bound.price, rel=1e-3)
    problem.write_mps(tmp_path / "loss.mps", rows=[row], around=plan)
    assert plan.total_mw == pytest.approx(solve_file(tmp_path / "loss.mps")[0], rel=1e-6)


def test_upper_limit_of_a_site_holds_only_while_it_is_open(problem: HostingProblem) -> None:
    row = Row({21: 1.0, 75: 1.0, 106: 1.0, 108: 1.0}, -np.inf, "weak", 108, "MW", upper=20.0)
    plan = problem.solve([row])
    assert plan.by_site[108] == 0
    assert plan.total_mw > 200
    assert plan.closed[108].startswith("weak: ")


def test_smallest_sizes_that_do_not_fit_are_told_with_what_does() -> None:
    forced = HostingProblem(NETWORK, SITES, DAY, rating_scale=0.6, min_size=90.0, reactive_limits=False)
    with pytest.raises(InfeasibleError) as error:
        forced.solve(must_open=(75, 106, 21))
    text = str(error.value)
    head = (
        "The smallest sizes of the sites that must be open exceed the limits: 90 MW at 21, 90 MW at 75, "
        "90 MW at 106. At most "
    )
    assert text.startswith(head)
    share = float(text[len(head) :].split()[0]) / 100
    sizes = {bus: share * 90.0 * factor for bus in (21, 75, 106) for factor in (1.0,)}
    fits = HostingProblem(NETWORK, SITES, DAY, rating_scale=0.6, reactive_limits=False)
    assert fits.solve(bounds={b: (mw - 0.1, 500.0) for b, mw in sizes.items()}, must_open=(21, 75, 106))
    with pytest.raises(InfeasibleError):
        fits.solve(bounds={b: (mw + 0.1, 500.0) for b, mw in sizes.items()}, must_open=(21, 75, 106))


def test_smallest_size_that_a_margin_forbids_names_the_margin() -> None:
    sized = HostingProblem(NETWORK, SITES, DAY, rating_scale=0.6, min_size=20.0, reactive_limits=False)
    with pytest.raises(InfeasibleError) as error:
        sized.solve([Row({75: -1.0}, -10.0, "voltage at 75, fault 80", 75, "pu")], must_open=(75,))
    assert str(error.value) == (
        "The smallest sizes of the sites that must be open exceed the limits: 20 MW at 75. At most 50.0 % of "
        "them fit together, by row voltage at 75, fault 80. Ways out: smaller sizes, or let a site close."
    )


def test_sites_may_be_smaller_than_their_least_only_when_closed() -> None:
    small = HostingProblem(NETWORK, SITES, DAY, rating_scale=0.6, min_size=90.0, reactive_limits=False)
    plan = small.solve()
    assert all(mw == 0 or mw >= 90.0 - 1e-6 for mw in plan.by_site.values())
    assert (
        90 <= plan.total_mw < HostingProblem(NETWORK, SITES, DAY, 0.6, reactive_limits=False).solve().total_mw
    )


# -- any network -------------------------------------------------------------------------------------------


@settings(max_examples=15, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    scale=st.floats(0.5, 0.9),
    emergency=st.one_of(st.none(), st.floats(1.6, 2.5)),
)
def test_plan_equals_the_monolith_on_random_networks(
    seed: int, scale: float, emergency: float | None, tmp_path_factory: pytest.TempPathFactory
) -> None:
    rng = np.random.default_rng(seed)
    lines = NETWORK.branches
    rating = lines.rating * rng.uniform(0.8, 1.3, len(lines))
    x = lines.x * rng.uniform(0.7, 1.4, len(lines))
    shift = np.where(rng.random(len(lines)) < 0.05, rng.normal(size=len(lines)) * 0.05, 0.0)
    network = replace(NETWORK, branches=replace(lines, rating=rating, x=x, shift=shift))
    sites = tuple(int(b) for b in rng.choice(NETWORK.bus, 3, replace=False))
    year = profiles.ieee118().window(range(start := int(rng.integers(0, 8750)), start + 2))
    security = None if emergency is None else N1(emergency)
    problem = HostingProblem(network, sites, year, scale, None, h_max=300.0, security=security)
    path = tmp_path_factory.mktemp("random") / "r.mps"
    try:
        plan = problem.solve()
    except InfeasibleError:
        with pytest.raises(InfeasibleError, match="the base case has no dispatch"):
            problem.solve(bounds=dict.fromkeys(sites, (0.0, 0.0)))
        return
    problem.write_mps(path)
    assert plan.total_mw == pytest.approx(solve_file(path)[0], rel=1e-7, abs=1e-6)
