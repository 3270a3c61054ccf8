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


def asked(hosting: tuple[float, float], runs: list[list[object]], **more: object) -> dict[str, object]:
    return {
        "case": "ieee118", "dynamics": None, "sites": [75, 108], "pf": 0.98, "redispatch": "proportional",
        "reactive_limits": True, "step_s": 1 / 120, "t_end_s": 1.0, "hosting": list(hosting),
        "period": {"name": "base", "hour": None, "load_scale": 1.0, "dc_factor": 0.95, "wind": {}},
        "faults": [{"bus": 78, "t_start_s": 0.2, "t_clear_ms": 100.0, "x_pu": 1e-4}],
        "runs": runs, "parameters": {}, "criteria": {}, "engine": "native", "gradients": False, "keep": False,
        "coupling": "closed",
    } | more  # fmt: skip


def test_samples_in_closed_loop_have_the_margins_of_the_comparison() -> None:
    runs: list[list[object]] = [["gfl", 1.2], ["gfm", 1.4]]
    found = coupling.check_hosting(asked((120.0, 60.0), runs))
    assert (found["grid"], found["facility"]) == (2, 4)  # each mode and rating has its own simulation
    compared = coupling.compare_plan(asked((120.0, 60.0), runs))
    key = lambda row: (row["mode"], row["beta"], row["fault"], row["site"])  # noqa: E731
    closed = {key(row): row for row in compared}
    for row in found["rows"]:
        other = closed[key(row)]
        assert row["v_margin_pu"] == pytest.approx(other["voltage_closed"], abs=1e-9)
        assert row["loss_margin_share"] == pytest.approx(other["loss_closed"], abs=1e-9)
        assert row["v_poi_min_pu"] == other["v_poi_min_closed"]
    open_loop = coupling.check_hosting(asked((120.0, 60.0), runs, coupling="open"))
    moved = [
        a["loss_margin_share"] - b["loss_margin_share"]
        for a, b in zip(found["rows"], open_loop["rows"], strict=True)
    ]
    assert np.abs(moved).max() > 1e-3


@pytest.mark.parametrize("mode", ["gfl", "gfm"])
def test_margins_in_closed_loop_have_total_derivatives(mode: str) -> None:
    """By every site's size, one of them hosting nothing, and by the rating, which moves the voltage too."""
    H, beta = (120.0, 0.0), 1.25

    def margins(H: tuple[float, float], beta: float, gradients: bool = False) -> list[dict]:
        return coupling.check_hosting(asked(H, [[mode, beta]], gradients=gradients))["rows"]

    row, nothing = margins(H, beta, True)
    assert row["sequence"]
    steps = {
        "H_75": (margins((120.5, 0.0), beta), margins((119.5, 0.0), beta), 1.0),
        "H_108": (margins((120.0, 0.5), beta), margins((120.0, 0.0), beta), 0.5),
        "beta": (margins(H, beta + 0.005), margins(H, beta - 0.005), 0.01),
    }
    for name, (up, down, step) in steps.items():
        assert up[0]["sequence"] == down[0]["sequence"] == row["sequence"]
        for target, column in (("loss", "loss_margin_share"), ("voltage", "v_margin_pu")):
            slope = (up[0][column] - down[0][column]) / step
            assert row["gradients"][target][name] == pytest.approx(slope, rel=0.01, abs=5e-8), (name, target)
    assert nothing["ok"]


def test_a_rating_that_cannot_start_fails_for_all_sites_with_the_reason() -> None:
    found = coupling.check_hosting(asked((120.0, 60.0), [["gfl", 0.95], ["gfl", 1.3]]))
    lost, made = found["rows"][:2], found["rows"][2:]
    assert [row["ok"] for row in lost] == [0, 0]
    assert {row["failed_in"] for row in lost} == {"grid"}
    assert "no equilibrium" in lost[0]["status"]
    assert [row["ok"] for row in made] == [1, 1]
