"""Power flow of the native engine: independent residual, shares, reactive limits, derivatives, ANDES."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dcvrt.errors import InfeasibleError, InputError, SimulationError
from dcvrt.grid import Grid, Period
from dcvrt.grid.native.engine import thetas
from dcvrt.grid.native.steady import Flow, Steady, directions, loads
from dcvrt.grid.network import Network
from tests.grid.native.cases import NO_VRT, WINDY, network

PER_MW = 1 + 1j * float(np.tan(np.arccos(0.98)))


def mismatch(net: Network, found: Steady, load: np.ndarray) -> float:
    """Largest mismatch, pu, by sums over the branches, which the engine does not know."""
    s = np.zeros(len(net.bus), dtype=complex)
    v, lines = found.v, net.branches
    for k in range(len(lines)):
        i, j = net.from_index[k], net.to_index[k]
        ratio = lines.tap[k] * np.exp(1j * lines.shift[k])
        series, charging = 1 / complex(lines.r[k], lines.x[k]), 0.5j * lines.b[k]
        inner = v[i] / ratio  # behind the ideal transformer
        s[i] += inner * ((inner - v[j]) * series + inner * charging).conj()
        s[j] += v[j] * ((v[j] - inner) * series + v[j] * charging).conj()
    s += abs(v) ** 2 * (net.g_shunt - 1j * net.b_shunt) / net.base_mva
    return float(np.abs(found.generation - load - s).max())


def load_of(net: Network, hosting: dict[int, float], period: Period) -> np.ndarray:
    hosted = {b: period.dc_factor * PER_MW * mw for b, mw in hosting.items()}
    return loads(net, hosted, period.wind, period.load_scale)


@pytest.mark.parametrize("rule", ["proportional", "slack"])
def test_the_solution_balances_every_bus(grid: Grid, rule: str) -> None:
    net = grid.network
    period = WINDY if rule == "proportional" else Period("windy", 1.0, {80: 50.0}, 0.95)
    load = load_of(net, NO_VRT if rule == "proportional" else {75: 50.0}, period)
    found = Flow(net).solve(load, rule)
    assert mismatch(net, found, load) < 1e-10
    held = [k for k, kind in enumerate(net.kind) if kind != "pq"]
    np.testing.assert_allclose(abs(found.v[held]), net.v_set[held], rtol=0, atol=1e-14)
    without = np.setdiff1d(np.arange(len(net.bus)), net.generator_index)
    np.testing.assert_allclose(found.generation[without], 0, atol=1e-10)


def test_every_unit_generates_its_share_losses_included(grid: Grid) -> None:
    net = grid.network
    load = load_of(net, NO_VRT, Period())
    found = Flow(net).solve(load)
    units = net.generators
    made = found.generation[net.generator_index].real * net.base_mva
    free = (units.p_set > 0) & (made < units.p_max - 1e-6)
    ratio = made[free] / units.p_set[free]
    np.testing.assert_allclose(ratio, ratio[0], rtol=1e-10)
    assert net.kind[net.generator_index[free][0]] != "slack"
    full = (units.p_set > 0) & ~free
    np.testing.assert_allclose(made[full], units.p_max[full], rtol=1e-10)
    np.testing.assert_allclose(made[units.p_set == 0], 0, atol=1e-8)
    losses = made.sum() - load.real.sum() * net.base_mva
    v, y = found.v, net.admittance()
    assert losses == pytest.approx((v * (y @ v).conj()).real.sum() * net.base_mva, abs=1e-7)
    assert losses > 50


def test_all_of_the_change_at_the_slack_bus(grid: Grid) -> None:
    net, units = grid.network, grid.network.generators
    found = Flow(net).solve(load_of(net, {75: 100.0}, Period()), "slack")
    made = found.generation[net.generator_index].real * net.base_mva
    away = net.generator_index != net.slack
    np.testing.assert_allclose(made[away], units.p_set[away], atol=1e-8)
    with pytest.raises(SimulationError, match=r"slack bus 69 would generate \d+ MW, outside 0 to 805 MW"):
        Flow(net).solve(load_of(net, NO_VRT, Period()), "slack")


def test_more_load_than_the_units_can_supply_is_infeasible(grid: Grid) -> None:
    with pytest.raises(
        InfeasibleError, match=r"units that follow the load can generate 0 to 6466\.2 MW together"
    ):
        Flow(grid.network).solve(load_of(grid.network, dict.fromkeys(NO_VRT, 700.0), Period()))
    with pytest.raises(InfeasibleError, match="more wind than load"):
        Flow(grid.network).solve(
            load_of(grid.network, {}, Period("gale", 0.2, {69: 600.0, 80: 600.0, 89: 600.0}))
        )


def test_no_solution_names_bus_and_mismatch(grid: Grid) -> None:
    with pytest.raises(SimulationError) as failure:
        Flow(grid.network).solve(load_of(grid.network, {21: 1500.0}, Period()), where="here")
    text = (
        "here: power flow has no solution; where Newton's method came nearest to one, the largest mismatch, "
    )
    assert str(failure.value).startswith(text)
    mismatch = float(str(failure.value).removeprefix(text).split(" MVA, is at bus ")[0])
    assert mismatch < 1500.0  # not that of a search that has run away


# -- reactive limits ---------------------------------------------------------------------------------------


def limited(q_max: float, q_min: float = -100.0, q_load: float = 60.0) -> Network:
    """A unit at bus 2 holds its voltage with a reactive load beside it."""
    return network(
        {1: "slack", 2: "pv", 3: "pq"}, [(1, 2, 0.01 + 0.1j), (2, 3, 0.05j)], {1: 50.0, 2: 40.0},
        {3: 90.0 + 1j * q_load}, {1: 1.02, 2: 1.02}, {2: (q_min, q_max)},
    )  # fmt: skip


@pytest.mark.parametrize(("q_max", "q_min", "q_load"), [(20.0, -100.0, 60.0), (100.0, 5.0, -60.0)])
def test_a_unit_at_its_reactive_limit_stays_there(q_max: float, q_min: float, q_load: float) -> None:
    net = limited(q_max, q_min, q_load)
    load = loads(net, {}, {}, 1.0)
    free = Flow(net).solve(load)
    upper = q_load > 0
    beyond = free.generation[1].imag * 100
    assert beyond > q_max + 1 if upper else beyond < q_min - 1
    found = Flow(net).solve(load, reactive_limits=True)
    assert found.at_limit == (2,)
    assert found.generation[1].imag * 100 == pytest.approx(q_max if upper else q_min, abs=1e-8)
    assert (abs(found.v[1]) < 1.02) == upper
    assert mismatch(net, found, load) < 1e-10


def test_a_unit_within_its_reactive_limits_holds_its_voltage() -> None:
    net = limited(200.0)
    load = loads(net, {}, {}, 1.0)
    with_, without = (Flow(net).solve(load, reactive_limits=on) for on in (True, False))
    assert with_.at_limit == ()
    np.testing.assert_array_equal(with_.v, without.v)


def back_switching() -> Network:
    """Two units close to each other: the limit of one takes the reason for the limit of the other away."""
    return network(
        {1: "slack", 2: "pv", 3: "pv", 4: "pq"},
        [(1, 2, 0.2j), (2, 3, 0.05j), (3, 4, 0.1j), (2, 4, 0.1j)],
        {1: 50.0, 2: 30.0, 3: 30.0}, {4: 100.0 + 40j},
        {1: 1.0, 2: 1.0, 3: 1.08}, {2: (-20.0, 300.0), 3: (-50.0, 30.0)},
    )  # fmt: skip


def test_a_unit_takes_its_voltage_back() -> None:
    net = back_switching()
    load = loads(net, {}, {}, 1.0)
    first = Flow(net).solve(load).generation.imag * 100
    assert first[1] < -20 - 1  # both are beyond a limit at first
    assert first[2] > 30 + 1
    found = Flow(net).solve(load, reactive_limits=True)
    assert found.at_limit == (3,)
    assert abs(found.v[1]) == pytest.approx(1.0, abs=1e-12)
    assert -20 <= found.generation[1].imag * 100 <= 300
    assert found.generation[2].imag * 100 == pytest.approx(30, abs=1e-8)
    assert mismatch(net, found, load) < 1e-10


def test_the_slack_bus_lets_its_voltage_go_and_keeps_its_angle() -> None:
    """The same as with the voltage that it then has as its set point."""
    narrow = network(
        {1: "slack", 2: "pv", 3: "pq"}, [(1, 2, 0.02 + 0.1j), (2, 3, 0.05j)], {1: 50.0, 2: 40.0},
        {3: 90.0 + 60j}, {1: 1.05, 2: 1.0}, {1: (-20.0, 30.0)},
    )  # fmt: skip
    assert Flow(narrow).solve(loads(narrow, {}, {}, 1.0)).generation[0].imag * 100 > 31
    load = loads(narrow, {}, {}, 1.0)
    found = Flow(narrow).solve(load, reactive_limits=True)
    assert found.at_limit == (1,)
    assert found.generation[0].imag * 100 == pytest.approx(30.0, abs=1e-8)
    assert 1.0 < abs(found.v[0]) < 1.05
    assert np.angle(found.v[0]) == 0.0
    assert mismatch(narrow, found, load) < 1e-10
    held = replace(narrow, v_set=abs(found.v))
    np.testing.assert_allclose(Flow(held).solve(load).v, found.v, atol=1e-9)
    change = np.array([[0.0], [0.0], [0.01 + 0.002j]])
    dv, dgeneration = found.derivatives(change)
    h = 1e-3
    after, before = (Flow(narrow).solve(load + s * h * change[:, 0], reactive_limits=True) for s in (1, -1))
    np.testing.assert_allclose((after.v - before.v) / (2 * h), dv[:, 0], atol=1e-7)
    assert abs(dgeneration[0, 0].imag) < 1e-12


def test_every_unit_of_a_large_case_is_consistent_with_its_limits(grid: Grid) -> None:
    net = grid.network
    load = load_of(net, NO_VRT, Period())
    found = Flow(net).solve(load, reactive_limits=True)
    assert mismatch(net, found, load) < 1e-10
    assert found.at_limit
    at, units = net.generator_index, net.generators
    q = found.generation[at].imag * net.base_mva
    size, v_set = abs(found.v[at]), net.v_set[at]
    assert (q <= units.q_max + 1e-6).all()
    assert (q >= units.q_min - 1e-6).all()
    low, high = size < v_set - 1e-9, size > v_set + 1e-9
    np.testing.assert_allclose(q[low], units.q_max[low], atol=1e-7)
    np.testing.assert_allclose(q[high], units.q_min[high], atol=1e-7)


# -- derivatives -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("reactive_limits", [False, True])
@pytest.mark.parametrize("rule", ["proportional", "slack"])
def test_derivatives_are_central_differences(grid: Grid, rule: str, reactive_limits: bool) -> None:
    net = grid.network
    hosting = {b: 0.3 * mw for b, mw in NO_VRT.items()}
    wrt = [(q.kind, q.bus) for q in thetas(("H", "wind_69", "load"), grid.sites, net)]
    base = load_of(net, hosting, WINDY)
    change = directions(net, wrt, WINDY.dc_factor * PER_MW, loads(net, {}, {}, 1.0))
    flow = Flow(net)

    def at(load: np.ndarray) -> Steady:
        return flow.solve(load, rule, reactive_limits)

    middle = at(base)
    dv, dgeneration = middle.derivatives(change)
    for k in range(len(wrt)):
        h = 1e-4 if wrt[k][0] == "load" else 0.2
        around = [at(base + s * h * change[:, k]) for s in (-2, -1, 1, 2)]
        assert {p.at_limit for p in around} == {middle.at_limit}

        def slope(values: list[np.ndarray], h: float = h) -> np.ndarray:
            a, b, c, d = values
            return (8 * (c - b) - (d - a)) / (12 * h)

        for exact, values in ((dv, [p.v for p in around]), (dgeneration, [p.generation for p in around])):
            found = slope(values)
            assert np.abs(exact[:, k] - found).max() <= 1e-7 * np.abs(found).max()


def test_directions_are_the_change_of_the_load(grid: Grid) -> None:
    net = grid.network
    base = loads(net, {}, {}, 1.0)
    found = directions(net, [("H", 75), ("wind", 69), ("load", None), ("clear", None)], PER_MW, base)
    np.testing.assert_allclose(found[:, 0], load_of(net, {75: 1.0}, Period()) - base, atol=1e-15)
    np.testing.assert_allclose(found[:, 1], load_of(net, {}, Period(wind={69: 1.0})) - base, atol=1e-15)
    np.testing.assert_allclose(found[:, 2], base)
    assert not found[:, 3].any()


def test_several_units_at_a_bus_are_refused() -> None:
    net = limited(20.0)
    g = net.generators
    twice = replace(
        net,
        generators=replace(g, bus=np.array([1, 1]), name=("a", "b")),
        kind=("slack", "pq", "pq"),
    )
    with pytest.raises(InputError) as failure:
        Flow(twice)
    assert str(failure.value) == (
        "sketch: bus 1 has several units; the native engine takes one a bus. Way out: join them into one "
        "unit, or engine='andes'."
    )
