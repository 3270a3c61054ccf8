"""Margins with facilities in the network against those of the open loop."""

from __future__ import annotations

import numpy as np
import pytest

from dcvrt import facility
from dcvrt.grid import BusFault, Grid
from dcvrt.planning import coupling

FAULTS = (BusFault(78), BusFault(110))


@pytest.fixture(scope="module")
def grid() -> Grid:
    return Grid.from_case("ieee118", sites=(75, 108))


def rated(beta: float = 1.3):
    f = facility.gfl()
    f.set("beta", beta)
    return f


def test_a_small_facility_has_the_margins_of_the_open_loop(grid: Grid) -> None:
    table = coupling.compare(grid, {75: 1e-3, 108: 0.0}, rated(), FAULTS, until=1.0)
    assert table.site.tolist() == [75, 75]  # a site without capacity has no facility
    assert (table.status == "").all()
    assert table.same_sequence.all()
    for name in ("v_poi_min", "voltage", "loss"):
        np.testing.assert_allclose(table[f"{name}_closed"], table[f"{name}_open"], atol=1e-5)


def test_a_large_one_moves_its_own_voltage_and_its_neighbour_s(grid: Grid) -> None:
    table = coupling.compare(grid, {75: 150.0, 108: 90.0}, rated(), FAULTS, until=1.0)
    assert len(table) == 4
    moved = (table.v_poi_min_closed - table.v_poi_min_open).abs()
    # under-voltage: a current that is held draws more than an impedance, so that the voltage is lower
    assert (table.v_poi_min_closed < table.v_poi_min_open).all()
    assert 1e-4 < moved.max() < 0.05


def test_a_fault_that_fails_keeps_its_row(grid: Grid) -> None:
    long = BusFault(10, clear=0.9)
    table = coupling.compare(grid, {75: 50.0}, rated(), [long], until=2.5)
    assert len(table) == 1
    assert table.status[0]
    assert not table.same_sequence[0]
