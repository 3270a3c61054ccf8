"""Units beyond their reactive limits: told with numbers that an own computation, bus by bus, gives too."""

from __future__ import annotations

import cmath
import math
from dataclasses import asdict, replace

import numpy as np
import pytest

from dcvrt.grid.network import Network
from dcvrt.planning import HostingProblem, Plan, profiles
from dcvrt.planning.profiles import Year
from dcvrt.planning.reactive import Beyond, ReactiveExcess, UnitBuses, excess

SITES = (21, 75, 106, 108)
PF = 0.98
NETWORK = Network.ieee118()
YEAR = profiles.ieee118()


def solved(year: Year, network: Network = NETWORK) -> tuple[HostingProblem, Plan]:
    problem = HostingProblem(network, SITES, year, rating_scale=0.6, pf=PF, reactive_limits=False)
    return problem, problem.solve()


def unit_outputs(problem: HostingProblem, H: dict[int, float], hour: int) -> dict[int, float]:
    """Mvar of the units at each bus: what leaves the bus over its branches and shunt, and its demand."""
    network, now = NETWORK, YEAR.at(hour)
    at = int(problem.year.positions([hour])[0])
    voltage = problem.ac.solve(np.array(list(H.values())), np.array([at])).v[:, 0]
    v = dict(zip(network.bus.tolist(), voltage.tolist(), strict=True))
    power = {bus: 0j for bus in v}
    for b, load, g_shunt, b_shunt in zip(
        network.bus.tolist(), network.q_load, network.g_shunt, network.b_shunt, strict=True
    ):
        power[b] += 1j * now.load * load + abs(v[b]) ** 2 * complex(g_shunt, -b_shunt)
    lines = network.branches
    for k in range(len(lines)):
        f, t = int(lines.from_bus[k]), int(lines.to_bus[k])
        y = 1 / complex(lines.r[k], lines.x[k])
        inner = v[f] / cmath.rect(lines.tap[k], lines.shift[k])
        half = 0.5j * lines.b[k]
        power[f] += network.base_mva * inner * (y * (inner - v[t]) + half * inner).conjugate()
        power[t] += network.base_mva * v[t] * (y * (v[t] - inner) + half * v[t]).conjugate()
    for bus, mw in H.items():
        power[bus] += 1j * now.dc * mw * math.tan(math.acos(PF))
    units = set(network.generators.bus.tolist())
    return {bus: power[bus].imag for bus in units}


@pytest.mark.parametrize("hosted", [True, False])
def test_excess_equals_the_sum_over_the_branches_of_each_bus(hosted: bool) -> None:
    hours = range(8440, 8443)
    problem, plan = solved(YEAR.window(hours))
    verdict = problem.check_ac(plan)
    found = verdict.reactive if hosted else verdict.reactive_unhosted
    assert found is not None
    units = NETWORK.generators
    q_max = dict(zip(units.bus.tolist(), units.q_max.tolist(), strict=True))  # one unit at each of its buses
    q_min = dict(zip(units.bus.tolist(), units.q_min.tolist(), strict=True))
    assert len(q_max) == len(units)
    H = plan.by_site if hosted else dict.fromkeys(SITES, 0.0)
    outputs = {hour: unit_outputs(problem, H, hour) for hour in hours}
    for side, distance in (
        (found.above, lambda bus, q: q - q_max[bus]),
        (found.below, lambda bus, q: q_min[bus] - q),
    ):
        far = {(bus, hour): distance(bus, q) for hour, of in outputs.items() for bus, q in of.items()}
        counts = {hour: sum(mvar > 1e-3 for (_, h), mvar in far.items() if h == hour) for hour in hours}
        assert side.units == max(counts.values()) == counts[side.hour] > 0
        assert side.excess_mvar == pytest.approx(max(far.values()), abs=1e-4)
        assert far[side.bus, side.excess_hour] == pytest.approx(side.excess_mvar, abs=1e-4)


def test_hosted_load_changes_what_the_units_give() -> None:
    problem, plan = solved(YEAR.window(range(8440, 8443)))
    verdict = problem.check_ac(plan)
    assert verdict.reactive is not None
    assert verdict.reactive_unhosted is not None
    before, after = verdict.reactive_unhosted.above, verdict.reactive.above
    assert after.excess_mvar > before.excess_mvar + 1.0


def test_the_verdict_is_about_voltages_and_its_sentence_names_the_excess() -> None:
    problem, plan = solved(YEAR.window(range(8440, 8443)))
    verdict = problem.check_ac(plan)
    assert verdict.passed
    assert verdict.status == (
        "All 3 hours solve with every voltage within its limits. Units beyond their reactive limits in the "
        f"worst hours (the limits are not enforced): {verdict.reactive}. "
        f"With nothing hosted: {verdict.reactive_unhosted}."
    )


def test_where_limits_are_wide_nothing_is_said() -> None:
    units = NETWORK.generators
    wide = np.full(len(units), 1e4)
    network = replace(NETWORK, generators=replace(units, q_min=-wide, q_max=wide))
    problem, plan = solved(YEAR.window(range(8440, 8443)), network)
    verdict = problem.check_ac(plan)
    assert verdict.reactive == ReactiveExcess()
    assert verdict.status == "All 3 hours solve with every voltage within its limits."


def test_units_of_one_bus_share_its_output_and_limits() -> None:
    units = NETWORK.generators
    twice = {name: np.repeat(getattr(units, name), 2) for name in ("bus", "p_set", "p_min", "p_max")}
    halves = {name: np.repeat(0.5 * getattr(units, name), 2) for name in ("q_min", "q_max")}
    names = tuple(f"{name}{part}" for name in units.name for part in "ab")
    split = replace(NETWORK, generators=replace(units, **twice, **halves, name=names))
    one, two = UnitBuses.of(NETWORK), UnitBuses.of(split)
    assert two.count.tolist() == [2] * len(units)
    output = one.high[:, None] + np.linspace(-1.0, 5.0, 7)
    hours = np.arange(7)
    single, double = excess(NETWORK, one, output, hours), excess(split, two, output, hours)
    assert double.above == replace(single.above, units=2 * len(units))
    assert single.above.units == len(units)
    assert single.above.excess_mvar == pytest.approx(5.0)
    assert single.below == double.below == Beyond()


def test_sentence_says_how_many_where_and_when() -> None:
    some = ReactiveExcess(Beyond(3, 17, 12.345, 77, 19), Beyond())
    assert str(some) == ("3 above q_max (hour 17), by up to 12.3 Mvar (bus 77, hour 19); none below q_min")
    assert some
    assert ReactiveExcess(Beyond(), Beyond(1, 5, 1.5, 8, 5))
    assert not ReactiveExcess()
    assert ReactiveExcess.of(asdict(some)) == some
