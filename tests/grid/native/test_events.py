"""Limits of units: located where they are reached, kept while they hold; voltage collapse; determinism."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest

from dcvrt.grid import BusFault, Grid
from dcvrt.grid.native.engine import Engine
from dcvrt.models import Block, Diagram, Equations, Input, Output, Phasor, State
from dcvrt.models.machines import GenRou, Ieeet1, Tgov1
from tests.grid.native.cases import NO_VRT, TIGHT, TIGHTEST, case, engine, network, run, states, unit
from tests.grid.native.test_sensitivities import with_limits

E_MAX = 3.2
FAULT = BusFault(3, 0.1, 0.12, x_f=0.05)


def test_a_state_on_its_limit_stays_on_it() -> None:
    of = with_limits(E_MAX)
    _, whole, _ = run(of, {3: 20.0}, FAULT, 2.5)
    reached = {name: t for t, name, text in whole.events if "FREE -> UPPER" in text}
    left = {name: t for t, name, text in whole.events if "UPPER -> FREE" in text}
    assert set(reached) == set(left) == {"machine 1", "machine 2"}
    for group_number, group in enumerate(of.system.groups):
        column = group.structure.dae.x_names.index("exciter.e_f")
        for k, name in enumerate(u.name for u in group.units):
            for until, where in (
                (0.5 * (reached[name] + left[name]), 0.0),
                (left[name] - 1e-3, 0.0),
                (left[name] + 0.02, -1e-4),
            ):
                if until < FAULT.cleared_at:
                    continue
                _, found, point = run(of, {3: 20.0}, FAULT, until)
                e_f = states(point, found.end)[group_number][k, column]
                assert e_f <= E_MAX + 1e-8
                assert (abs(e_f - E_MAX) < 1e-8) == (where == 0.0)


def test_the_instant_of_a_limit_does_not_depend_on_the_tolerance() -> None:
    of = with_limits(E_MAX)
    coarse, fine, finest = (
        [e[0] for e in run(of, {3: 20.0}, FAULT, 2.5, options=o)[1].events]
        for o in (replace(TIGHT, rtol=1e-6, atol=1e-6), TIGHT, TIGHTEST)
    )
    assert len(coarse) == len(fine) == len(finest) >= 4
    np.testing.assert_allclose(fine, finest, atol=1e-7)
    np.testing.assert_allclose(coarse, finest, atol=1e-4)


def governed() -> Engine:
    """A machine whose valve closes fully when a load goes away, beside one that does not move."""
    net = network(
        {1: "slack", 2: "pv", 3: "pq"}, [(1, 3, 0.1j), (2, 3, 0.01 + 0.15j)], {1: 300.0, 2: 60.0},
        {3: 360.0 + 50j}, {1: 1.02, 2: 1.01},
    )  # fmt: skip
    made = [
        unit(1, M=20.0, x_d1=0.1),
        unit(
            2, exciter=partial(Ieeet1, K_A=50.0, V_Rmax=6.0, V_Rmin=-6.0, T_A=0.05, S_B=0.0, K_E=1.0),
            governor=partial(Tgov1, V_max=0.65, V_min=0.55, R=0.05, T_1=0.1), kind=GenRou, M=6.0,
        ),
    ]  # fmt: skip
    return engine(net, made, (3,), rule="slack")


def test_a_valve_never_goes_beyond_its_limits() -> None:
    of = governed()
    fault = BusFault(3, 0.1, 0.25, x_f=0.1)
    _, whole, _ = run(of, {}, fault, 6.0)
    assert not whole.status
    texts = [text for _, _, text in whole.events]
    assert any("LOWER" in text for text in texts)
    number = next(n for n, g in enumerate(of.system.groups) if "governor.g" in g.structure.dae.x_names)
    names = of.system.groups[number].structure.dae.x_names
    for until in np.linspace(0.4, 6.0, 12):
        _, found, point = run(of, {}, fault, float(until))
        g = states(point, found.end)[number][0, names.index("governor.g")]
        assert 0.55 - 1e-8 <= g <= 0.65 + 1e-8


class ConstantPower(Block):
    """Draws power that depends on nothing, at unity power factor, pu of its size."""

    v = Input("pu(V)", "terminal voltage", kind=Phasor)
    i = Output("pu(I)", "current that it draws", kind=Phasor)
    seen = State(1.0, "1", "squared voltage, a cycle late")

    def equations(self, s: Any) -> Equations:
        return Equations(
            out=dict(i=Phasor(s.v.re / s.v.abs2(), s.v.im / s.v.abs2())),
            der=dict(seen=(s.v.abs2() - s.seen) / 0.02),
        )

    def rest(self, s: Any) -> dict[str, Any]:
        return dict(seen=s.v.abs2())


def constant_power() -> Diagram:
    d = Diagram("stiff")
    block = d.add("load", ConstantPower())
    d.connect(d.input("v_poi", "pu(V)", Phasor), block.v)
    d.output("i", block.i)
    return d


X_SOURCE, X_SITE = 0.25, 0.1


def behind_a_line() -> Engine:
    net = network(
        {1: "slack", 2: "pq", 3: "pq"}, [(1, 2, X_SOURCE * 1j), (2, 3, X_SITE * 1j)], {1: 100.0}
    )  # fmt: skip
    return engine(net, [unit(1, M=1e5, x_d1=1e-6)], (3,))


@pytest.mark.parametrize(("x_f", "holds"), [(2.0, True), (0.8, True), (0.3, False)])
def test_constant_power_is_drawn_up_to_the_nose_and_collapses_beyond(x_f: float, holds: bool) -> None:
    """V^4 - E^2 V^2 + (X P)^2 = 0 with the source that the fault leaves: no root where E^2 < 2 X P."""
    p = 0.8
    of = behind_a_line()
    fault = BusFault(2, 0.1, 0.1, x_f=x_f)
    t, found, _ = run(of, {3: 100 * p}, fault, 0.3, facilities={3: constant_power()}, options=TIGHTEST)
    e = x_f / (x_f + X_SOURCE)
    x = X_SITE + X_SOURCE * x_f / (x_f + X_SOURCE)
    root = e**4 - 4 * (x * p) ** 2
    assert (root > 0) == holds
    if not holds:
        assert found.status == (
            "voltage collapse or numerical failure: no voltages satisfy the network's equations "
            "at t = 0.1000 s."
        )
        return
    assert not found.status
    expected = np.sqrt((e**2 + np.sqrt(root)) / 2)
    inside = (t > 0.1) & (t < 0.2)
    assert np.abs(abs(found.v[inside, 0]) - expected).max() < 1e-5  # the source has 1e-6 pu of reactance
    assert np.ptp(abs(found.v[inside, 0])) < 1e-6


# -- determinism -------------------------------------------------------------------------------------------


def test_two_runs_are_equal_to_the_last_bit(grid: Grid) -> None:
    faults = [BusFault(77), BusFault(103), BusFault(23, clear=0.15)]
    one = grid.waveforms_of(NO_VRT, None, faults, until=0.4, wrt=("H_75", "clear"))
    two = grid.waveforms_of(NO_VRT, None, faults[::-1], until=0.4, wrt=("H_75", "clear"))
    for fault in faults:
        alone = grid.waveforms(NO_VRT, fault, until=0.4, wrt=("H_75", "clear"))
        for bus in grid.sites:
            for other in (two[fault][bus], alone[bus]):
                np.testing.assert_array_equal(one[fault][bus].v, other.v)
                for name, tangent in other.tangents.items():
                    np.testing.assert_array_equal(one[fault][bus].tangents[name], tangent)


def test_a_run_that_fails_leaves_nothing_behind(grid: Grid) -> None:
    alone = grid.waveforms({}, BusFault(77), until=1.0)
    runs = grid.waveforms_of({}, None, [BusFault(9, clear=0.6), BusFault(77)], until=1.0)
    assert not runs[BusFault(9, clear=0.6)].completed
    for bus in grid.sites:
        np.testing.assert_array_equal(alone[bus].v, runs[BusFault(77)][bus].v)


def test_two_threads_do_not_touch_each_other() -> None:
    hosting, faults = {7: 30.0}, [BusFault(8, clear=c) for c in (0.05, 0.06, 0.07, 0.08)]

    def all_of(grid: Grid) -> list[np.ndarray]:
        return [grid.waveforms(hosting, fault, until=1.0, wrt=("H", "load"))[7].v for fault in faults]

    grids = [case("kundur/kundur_full.xlsx", (7,)) for _ in range(2)]
    expected = all_of(grids[0])
    assert len(grids[1].native.system.groups) > 0
    with ThreadPoolExecutor(2) as pool:
        found = list(pool.map(all_of, grids * 3))
    with ThreadPoolExecutor(2) as pool:  # and where they share one
        found += list(pool.map(all_of, [grids[0]] * 4))
    for values in found:
        for a, b in zip(values, expected, strict=True):
            np.testing.assert_array_equal(a, b)


@pytest.mark.slow
def test_the_step_control_keeps_the_tolerance(grid: Grid) -> None:
    """The error falls with the tolerance, and at the one of use it is small."""
    _, best, _ = run(grid.native, NO_VRT, BusFault(74), 2.5, options=TIGHTEST)
    errors = []
    for tol in (1e-5, 1e-6, 1e-7, 1e-8):
        _, found, _ = run(grid.native, NO_VRT, BusFault(74), 2.5, options=replace(TIGHT, rtol=tol, atol=tol))
        errors.append(np.abs(found.v - best.v).max())
    assert errors[1] < 1e-5
    assert errors[-1] < 1e-7
    assert sorted(errors, reverse=True) == errors
