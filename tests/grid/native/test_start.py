"""Where runs start: equilibria of all units against ANDES, and a flat run from there."""

from __future__ import annotations

import numpy as np
import pytest

from dcvrt.grid import BusFault, Grid, Period
from dcvrt.grid.native.engine import groups, thetas
from dcvrt.grid.native.point import NativePoint
from tests.grid import live
from tests.grid.native.cases import NO_VRT, TIGHT, TIGHTEST, WINDY, run, states


@pytest.mark.parametrize("case", ["ieee118", "kundur", "ieee39", "ieee14"])
def test_states_and_setpoints_at_the_power_flow_of_andes(case: str) -> None:
    """Every unit by itself, at the very voltages and powers that ANDES started from."""
    ss = live.system(case)
    units = {unit.name: unit for unit in live.read_units(ss)}
    count = 0
    for group in groups(units.values()):
        dae = group.structure.dae
        own = [units[u.name] for u in group.units]
        v = np.array([live.voltage(ss, unit) for unit in own])
        s = np.array([live.power(ss, unit) for unit in own])
        rest = group.equilibrium(v, (s / v).conj(), case)
        assert rest.residual < 1e-9
        for k, unit in enumerate(own):
            np.testing.assert_allclose(rest.x[k], live.state(ss, unit, dae), rtol=0, atol=1e-6)
            given = live.values(ss, unit, dae)
            for path in group.structure.setpoints:
                if not path.startswith("exciter.") or "v_f0" in path:
                    column = group.structure.column(path)
                    assert rest.p[k, column] == pytest.approx(given[column], abs=1e-6)
            count += 1
    assert count == len(units)


@pytest.mark.parametrize("period", [Period(), WINDY], ids=["base", "windy"])
def test_the_start_is_an_equilibrium_to_rounding(grid: Grid, period: Period) -> None:
    point = grid.native.point(NO_VRT, period)
    assert point.residual < 1e-9
    # currents of the units, taken together, are what the network takes
    net, injected = grid.network, np.zeros(len(grid.network.bus), dtype=complex)
    for group, rest in zip(point.system.groups, point.rest, strict=True):
        np.add.at(injected, net.indices([u.bus for u in group.units]), rest.current)
    taken = net.admittance() @ point.v0 + (point.steady.load / point.v0).conj()
    assert np.abs(injected - taken).max() < 1e-9


@pytest.mark.parametrize("period", [Period(), WINDY], ids=["base", "windy"])
def test_without_a_disturbance_nothing_moves(grid: Grid, period: Period) -> None:
    none = BusFault(23, 0.1, 0.1, x_f=1e13)
    t, found, point = run(grid.native, NO_VRT, none, 3.0, ("H", "load"), period)
    at = point.system.points
    assert np.abs(found.v - point.v0[at]).max() < 1e-9
    assert np.abs(found.tangents - found.tangents[0]).max() < 1e-7 * np.abs(found.tangents).max()
    for x, rest in zip(states(point, found.end), point.rest, strict=True):
        assert np.abs(x - rest.x).max() < 1e-9
    assert found.events == ()
    assert t[-1] == 3.0


def test_derivatives_of_the_start_are_central_differences(grid: Grid) -> None:
    of, h = grid.native, 0.5
    by = thetas(("H_75", "load"), of.sites, of.network)
    point = of.point(NO_VRT, WINDY, by)

    def moved(k: int, s: float) -> NativePoint:
        if not k:
            return of.point(NO_VRT | {75: NO_VRT[75] + s * h}, WINDY)
        return of.point(NO_VRT, Period("x", WINDY.load_scale + 2e-4 * s, WINDY.wind, WINDY.dc_factor))

    for k, step in ((0, h), (1, 2e-4)):
        around = [moved(k, s) for s in (-2, -1, 1, 2)]
        for g in range(len(point.rest)):
            a, b, c, d = (p.rest[g].x for p in around)
            found = (8 * (c - b) - (d - a)) / (12 * step)
            exact = point._dx[g][:, :, k]
            assert np.abs(exact - found).max() < 1e-6 * np.abs(found).max()


def test_one_instant_after_the_fault_the_states_have_not_moved(grid: Grid) -> None:
    """Voltage right after inception: by the algebra of the full network, units as sources behind x''."""
    fault = BusFault(77)
    t, found, point = run(grid.native, NO_VRT, fault, 0.3, options=TIGHTEST)
    net = grid.network
    y = net.admittance().toarray() + np.diag(point._diagonal)
    source = y @ point.v0
    y[net.index(77), net.index(77)] += 1 / (1j * fault.x_f)
    expected = np.linalg.solve(y, source)[net.indices(grid.sites)]
    first = int(np.flatnonzero(t == fault.start)[1])
    assert np.abs(found.v[first] - expected).max() < 1e-10
    assert TIGHT.rtol > TIGHTEST.rtol
