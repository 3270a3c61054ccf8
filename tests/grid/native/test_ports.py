"""The network as its ports see it: updates of low rank, derivatives, phase shifters; lanes and precision."""

from __future__ import annotations

import re
from functools import partial
from importlib import resources

import numpy as np
import pytest
import scipy.sparse as sp

from dcvrt.grid import BusFault, Grid, Period
from dcvrt.grid.native import build
from dcvrt.grid.native.engine import sample_times
from dcvrt.grid.native.ports import Ports
from dcvrt.grid.native.run import Options
from dcvrt.models.machines import Tgov1
from tests.grid.native.cases import (
    NO_VRT,
    TIGHT,
    TIGHTEST,
    engine,
    network,
    round_rotor,
    run,
    unit,
)


def loaded(grid: Grid, skew: float = 0.0) -> tuple[sp.csc_matrix, np.ndarray]:
    """Admittance of a large case with loads; `skew` shifts the phase of every tenth entry."""
    net = grid.network
    held = np.bincount(net.generator_index, minlength=len(net.bus)) * -4j
    y = net.admittance() + sp.diags((net.p_load - 1j * net.q_load) / net.base_mva + held)
    if skew:
        coo = sp.coo_matrix(y)
        phase = np.where((coo.row < coo.col) & (coo.row % 10 == 0), np.exp(1j * skew), 1.0)
        y = sp.coo_matrix((coo.data * phase, (coo.row, coo.col)), shape=coo.shape)
    return sp.csc_matrix(y), np.sort(net.generator_index)


@pytest.mark.parametrize("skew", [0.0, 0.2], ids=["symmetric", "phase shifters"])
@pytest.mark.parametrize("shunts", [{}, {20: 1 / 1e-4j}, {3: 5 - 2j, 76: 1 / 1e-4j}])
def test_a_fault_is_an_update_of_low_rank(grid: Grid, skew: float, shunts: dict[int, complex]) -> None:
    y, buses = loaded(grid, skew)
    z, dz = Ports(y, buses).impedances(shunts)
    full = y.toarray()
    for k, shunt in shunts.items():
        full[k, k] += shunt
    expected = np.linalg.inv(full)[np.ix_(buses, buses)]
    assert np.abs(z - expected).max() < 1e-12 * max(1.0, np.abs(expected).max())
    assert list(dz) == []


@pytest.mark.parametrize("skew", [0.0, 0.2], ids=["symmetric", "phase shifters"])
@pytest.mark.parametrize("shunts", [{}, {20: 1 / 1e-4j}])
def test_derivatives_of_the_impedances(grid: Grid, skew: float, shunts: dict[int, complex]) -> None:
    y, buses = loaded(grid, skew)
    rng = np.random.default_rng(3)
    dy = np.zeros((y.shape[0], 3), dtype=complex)
    dy[40, 0] = 1 - 0.3j
    dy[:, 2] = rng.normal(size=y.shape[0]) * (1 + 1j)
    _, dz = Ports(y, buses).impedances(shunts, dy)
    assert not dz[1].size  # nothing moves
    for k in (0, 2):
        h = 1e-4
        a, b, c, d = (
            Ports((y + sp.diags(s * h * dy[:, k])).tocsc(), buses).impedances(shunts)[0]
            for s in (-2, -1, 1, 2)
        )
        found = (8 * (c - b) - (d - a)) / (12 * h)
        assert np.abs(dz[k] - found).max() < 1e-8 * np.abs(found).max()


def test_a_line_that_opens_is_out_of_the_matrix(grid: Grid) -> None:
    net = grid.network
    out = {0, 17}
    y, v = net.admittance_without(out), np.random.default_rng(5).normal(size=len(net.bus)) + 0.3j
    less = net.admittance() @ v - y @ v
    expected = np.zeros(len(v), dtype=complex)
    for k in out:
        i, j = net.from_index[k], net.to_index[k]
        series = 1 / complex(net.branches.r[k], net.branches.x[k])
        charging = 0.5j * net.branches.b[k]
        expected[i] += series * (v[i] - v[j]) + charging * v[i]
        expected[j] += series * (v[j] - v[i]) + charging * v[j]
    np.testing.assert_allclose(less, expected, atol=1e-12)


# -- idle lanes --------------------------------------------------------------------------------------------


def star(count: int, split: int = 0, salient: bool = False):
    """`count` machines around a hub, of which the first `split` have another order of numbers."""
    kinds = {1: "slack", **{b: "pv" for b in range(2, count + 1)}, 100: "pq", 101: "pq"}
    lines = [(b, 100, (0.05 + 0.01 * b) * 1j + 0.005) for b in range(1, count + 1)] + [(100, 101, 0.05j)]
    net = network(kinds, lines, {b: 50.0 + 3 * b for b in range(1, count + 1)},
                  {100: 50.0 * count + 10j, 101: 3.0 * count * (count + 1) / 2})  # fmt: skip
    more = dict(x_d2=0.25, x_q2=0.32) if salient else {}
    units = [round_rotor(b, M=4.0 + b, **more) for b in range(1, count + 1)]
    order = units[split:] + units[:split]
    return engine(net, order, (101,))


@pytest.mark.parametrize("salient", [False, True], ids=["explicit", "coupled"])
@pytest.mark.parametrize("count", [1, 8, 9])
def test_idle_lanes_feed_nothing(count: int, salient: bool) -> None:
    fault = BusFault(100, 0.1, 0.1, x_f=0.05)
    of = star(count, salient=salient)
    _, found, point = run(of, {101: 10.0}, fault, 0.5, ("H", "load"), options=TIGHTEST)
    assert not found.status
    assert point.system.layout.ports == 8 * (1 + (count > 8))
    _, other, _ = run(
        star(count, count // 2, salient), {101: 10.0}, fault, 0.5, ("H", "load"), options=TIGHTEST
    )
    np.testing.assert_allclose(found.v, other.v, rtol=0, atol=1e-10)
    np.testing.assert_allclose(found.tangents, other.tangents, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("count", [2, 9])
def test_machines_of_two_structures_are_those_of_one(count: int) -> None:
    """Classical machines in one group, and split in two groups by a governor that never moves."""
    kinds = {1: "slack", **{b: "pv" for b in range(2, count + 1)}, 100: "pq"}
    lines = [(b, 100, (0.05 + 0.01 * b) * 1j) for b in range(1, count + 1)]
    net = network(kinds, lines, {b: 50.0 for b in range(1, count + 1)}, {100: 50.0 * count + 10j})
    fault = BusFault(1, 0.1, 0.1, x_f=0.1)
    together = [unit(b, M=4.0 + b) for b in range(1, count + 1)]
    slow = dict(R=1e3, D_t=0.0)
    split = [
        unit(b, governor=partial(Tgov1, V_max=5.0, V_min=0.0, **slow) if b % 2 else None, M=4.0 + b)
        for b in range(1, count + 1)
    ]
    a, b = (engine(net, units, (100,)) for units in (together, split))
    assert len(a.system.groups) == 1
    assert len(b.system.groups) == 2
    _, one, _ = run(a, {}, fault, 0.6, options=TIGHT)
    _, two, _ = run(b, {}, fault, 0.6, options=TIGHT)
    assert np.abs(one.v - two.v).max() < 1e-4  # R = 1000: the governor moves by 1e-5 of the speed
    assert np.abs(one.v - one.v[0]).max() > 0.1


@pytest.mark.parametrize("salient", [False, True], ids=["explicit", "coupled"])
@pytest.mark.parametrize("count", [1, 3, 4])
def test_few_units_in_narrow_packs_are_those_in_wide_ones(
    count: int, salient: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    fault, asked = BusFault(100, 0.1, 0.1, x_f=0.05), ("H", "load")
    _, narrow, few = run(star(count, 0, salient), {101: 10.0}, fault, 0.5, asked, options=TIGHTEST)
    monkeypatch.setattr(build, "FEW", 0)
    _, wide, many = run(star(count, 0, salient), {101: 10.0}, fault, 0.5, asked, options=TIGHTEST)
    assert few.system.layout.lanes == [min(4, *many.system.layout.lanes)]
    np.testing.assert_allclose(narrow.v, wide.v, rtol=0, atol=1e-10)
    np.testing.assert_allclose(narrow.tangents, wide.tangents, rtol=1e-6, atol=1e-9)


# -- precision ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("bus", [22, 17, 74])
def test_single_precision_in_the_stages_stays_far_below_the_tolerance(grid: Grid, bus: int) -> None:
    """On both sides of the tolerance from which on it is used, voltages are the same."""
    text = (resources.files("dcvrt.grid.native") / "driver" / "pair.h").read_text(encoding="utf-8")
    (limit,) = (float(n) for n in re.findall(r"#define NEAR_FROM (\S+)", text))
    point, stages = grid.native.point(NO_VRT, Period()), BusFault(bus).stages(grid.network)
    times = sample_times(stages, 1.5, 1 / 120)
    single, double = (
        point.simulate(stages, times, Options(rtol=r, atol=limit)) for r in (limit, 0.9999 * limit)
    )
    assert not single.status
    difference = np.abs(single.v - double.v).max()
    assert 1e-12 < difference < 0.1 * limit
