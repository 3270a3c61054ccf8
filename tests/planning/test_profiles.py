"""Operating hours: published shapes, bookkeeping of windows, and one message for bad columns."""

from __future__ import annotations

import pytest

from dcvrt.errors import InputError
from dcvrt.grid.network import Network
from dcvrt.planning import profiles
from dcvrt.planning.profiles import Year


@pytest.fixture(scope="module")
def year() -> Year:
    return profiles.ieee118()


def test_year_has_8760_hours_within_their_ranges(year: Year) -> None:
    assert len(year) == 8760
    assert year.hours.tolist() == list(range(8760))
    assert (year.load.max(), year.dc.max()) == (1.0, 1.0)
    assert year.dc.min() > 0.8
    assert set(year.wind) == {69, 80, 89}
    for mw in year.wind.values():
        assert mw.min() >= 0
        assert 195 < mw.max() <= 200
    assert set(year.sources) == {"load", "wind", "dc"}


def test_rts79_tables_are_complete_and_peak_where_published() -> None:
    assert len(profiles.WEEKLY) == 52
    assert all(len(shape) == 24 and max(shape) == 100 for shape in profiles.HOURLY.values())
    load = profiles.rts79_load()
    peak = int(load.argmax())
    assert (peak // 168 + 1, peak // 24 % 7, peak % 24) == (51, 1, 17)  # week 51, Tuesday, 17-18 h
    assert load[12 * 168 + 24 + 8] == pytest.approx(
        0.704 * 1.00 * 0.95
    )  # week 13 of the ordering that is pinned
    assert load[8736:] == pytest.approx(load[:24])


def test_wind_factors_keep_their_source_statistics() -> None:
    wind = profiles.rts_gmlc_wind()
    assert wind.shape == (8760, 3)
    assert wind.min() == 0.0
    assert wind.max() <= 1.0
    # Means of the source file without 29 February, MW over installed MW.
    assert wind.mean(axis=0) * [148.3, 799.1, 847.0] == pytest.approx([41.738, 283.542, 237.519], rel=1e-4)


def test_window_keeps_the_numbers_of_its_hours(year: Year) -> None:
    week = year.window(range(8400, 8568))
    assert len(week) == 168
    assert week.at(8441) == year.at(8441)
    assert week.load == pytest.approx(year.load[8400:8568])


def test_hour_outside_a_window_is_refused(year: Year) -> None:
    with pytest.raises(InputError) as error:
        year.window(range(10)).at(10)
    assert str(error.value) == "hour 10 is not among the 10 operating hours (0 to 9)."


def test_representative_hours_are_extremes_and_median_of_net_load(year: Year) -> None:
    network = Network.ieee118()
    net = year.net_load(network)
    chosen = year.representative(network)
    assert list(chosen) == ["peak", "median", "light"]
    assert net[chosen["peak"]] == net.max()
    assert net[chosen["light"]] == net.min()
    assert (net < net[chosen["median"]]).sum() <= 4380 <= (net <= net[chosen["median"]]).sum() + 1
    assert sum(mw[chosen["light"]] for mw in year.wind.values()) > 400


def test_all_faults_of_the_columns_are_named_at_once() -> None:
    with pytest.raises(InputError) as error:
        Year([5, 6], [1.0, float("nan")], {3: [1.0, -1.0], 4: [1.0]}, [0.0, 1.2])  # type: ignore[arg-type]
    assert str(error.value) == (
        "operating hours: 4 problems\n"
        "  load must be a finite number above 0; it is nan in hour 6.\n"
        "  dc must be above 0 and at most 1; it is 0 in hour 5 (2 hours in all).\n"
        "  wind[3] must be a finite number of MW, 0 or more; it is -1 in hour 6.\n"
        "  wind[4] has 1 values for 2 hours."
    )


def test_too_many_wind_buses_are_refused() -> None:
    with pytest.raises(InputError) as error:
        profiles.ieee118({1: 10.0, 2: 10.0, 3: 10.0, 4: 10.0})
    assert str(error.value) == (
        "ieee118: 4 wind buses, but only 3 wind series ship. Way out: build a Year with your own series."
    )


def test_negative_wind_capacity_is_refused() -> None:
    with pytest.raises(InputError) as error:
        profiles.ieee118({69: -5.0})
    assert str(error.value) == "ieee118: wind capacity at bus 69 is -5 MW; it must be 0 or more."
