"""Initial states of the native engine against those that ANDES finds, unit by unit, state by state.

ANDES adds 1e-8 pu to the resistance and the reactance of every line, and so does a grid here. Without that,
voltages would differ by up to 1e-6 pu, and the states of machines that are small beside what they feed by
some more.
"""

from __future__ import annotations

import numpy as np
import pytest

from dcvrt.grid import Grid, Period
from tests.grid import live

HOSTING = {21: 31.4, 75: 153.9, 106: 102.4, 108: 104.1}


def grid_of(case: str) -> Grid:
    if case == "ieee118":
        return Grid.from_case("ieee118", sites=tuple(HOSTING))
    path, dynamics = live.CASES[case]
    folder = live.package()
    given = folder / dynamics if dynamics else None
    return Grid.from_case(folder / path, (5,), dynamics=given, redispatch="slack")  # the schedule of the case


def largest_difference(grid: Grid, hosting: dict[int, float]) -> float:
    ours, theirs = grid.native.point(hosting, Period()), grid.operating_point(hosting, Period())
    described = {unit.name: unit for unit in grid.native.units}
    return max(
        float(np.abs(x - live.state(theirs.system, described[unit.name], rest.group.structure.dae)).max())
        for rest in ours.rest
        for unit, x in zip(rest.group.units, rest.x, strict=True)
    )


@pytest.mark.parametrize("case", ["ieee118", *live.CASES])
def test_both_programs_start_from_the_same_states(case: str) -> None:
    grid, hosting = grid_of(case), HOSTING if case == "ieee118" else {}
    assert largest_difference(grid, hosting) < 1e-7
    found, theirs = grid.native.point(hosting, Period()), grid.operating_point(hosting, Period())
    assert np.abs(found.v0 - theirs.v0).max() < 1e-8
