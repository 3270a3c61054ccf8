"""Bad input and runs that do not reach their end: one message with all of it, or a label."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from dcvrt import facility
from dcvrt.errors import InputError, SimulationError
from dcvrt.grid import BusFault, FaultSequence, Grid, LineTrip, Period, andes
from dcvrt.grid.native import build
from tests.grid.native.cases import NO_VRT, case, package

SITES = (21, 75, 106, 108)


def test_bad_request_names_everything_at_once(grid: Grid) -> None:
    with pytest.raises(InputError) as failure:
        grid.waveforms_of(
            {75: -1.0},
            Period(),
            [BusFault(1180), LineTrip(23, 26), FaultSequence((BusFault(75), LineTrip(1, 2, 0.5)))],
            until=0.55,
            wrt=("H", "H_22", "wind_690", "gamma"),
            facilities={22: object()},  # type: ignore[dict-item]
        )
    text = str(failure.value)
    assert text.startswith("ieee118: 9 problems\n")
    for line in (
        "wrt: 'H_22': bus 22 is not one of the sites 21, 75, 106, 108.",
        "wrt: 'wind_690': no bus 690.",
        "wrt: 'gamma' is not known. It takes H (all sites), H_<bus>, wind_<bus>, load (factor on every "
        "load), clear (s) and beta (rating of the facilities).",
        "facilities: bus 22 is not a candidate site.",
        "facilities: object at bus 22 is no diagram. Way out: facility.gfl() and its like.",
        "hosting at bus 75 = -1.0 MW must be a number of at least 0.",
        "fault: no bus 1180.",
        "no branch joins buses 23 and 26. Those at either end: ",
        "fault at bus 75: it is a candidate site",
    ):
        assert f"\n  {line}" in text


def test_a_rating_and_values_need_facilities_that_have_them(grid: Grid) -> None:
    with pytest.raises(InputError) as failure:
        grid.waveforms({75: 10.0}, BusFault(77), wrt=("beta",), values={"bess.tau": 0.01})
    assert str(failure.value) == (
        "ieee118: 2 problems\n  values: 'bess.tau': there are no facilities.\n"
        "  wrt: 'beta': there are no facilities that it could rate."
    )
    with pytest.raises(InputError) as failure:
        grid.waveforms({75: 10.0}, BusFault(77), facilities={75: facility.gfl()}, values={"bess.tauu": 0.01})
    assert str(failure.value).startswith(
        "ieee118: facility gfl at bus 75 has no parameter 'bess.tauu'. Did you mean 'bess."
    )


def test_more_derivatives_than_a_run_carries() -> None:
    sites = tuple(bus for bus in range(1, 70) if bus != 17)
    with pytest.raises(InputError) as failure:
        Grid.from_case("ieee118", sites=sites).waveforms({1: 5.0}, BusFault(77), wrt=("H",))
    assert str(failure.value) == (
        "ieee118: wrt: 68 quantities; one run carries derivatives by 64 at most. Way out: ask for them in "
        "several calls."
    )


def test_as_many_derivatives_as_a_run_carries() -> None:
    sites = tuple(range(1, 65))
    many = Grid.from_case("ieee118", sites=sites).waveforms({1: 5.0}, BusFault(77), until=0.25, wrt=("H",))
    one = Grid.from_case("ieee118", sites=sites).waveforms({1: 5.0}, BusFault(77), until=0.25, wrt=("H_64",))
    assert len(many[1].tangents) == 64
    largest = np.abs(one[1].tangents["H_64"]).max()
    assert np.abs(many[1].tangents["H_64"] - one[1].tangents["H_64"]).max() < 1e-3 * largest


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: BusFault(23, clear=-0.1), "the fault would be cleared before it starts"),
        (lambda: LineTrip(23, 24, start=0.0), "start = 0.0 s must be after 0 s."),
        (lambda: LineTrip(23, 24, reclose=0.0), "above 0"),
        (lambda: FaultSequence(()), "a sequence needs at least one fault."),
        (
            lambda: FaultSequence((BusFault(23, 0.1, 0.2), BusFault(24, 0.25))),
            "bus 24, 100 ms starts at 0.25 s, before bus 23, 200 ms ends at 0.3 s.",
        ),
    ],
)
def test_events_that_cannot_be(make: object, said: str) -> None:
    with pytest.raises(InputError) as failure:
        make()  # type: ignore[operator]
    assert said in str(failure.value)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"wrt": "load"}, "ieee118: wrt = 'load' must be a tuple of names: wrt=('load',)."),
        (
            {"facilities": {75: object()}},
            "ieee118: facilities: object at bus 75 is no diagram. Way out: facility.gfl() and its like.",
        ),
        (
            {"fault": FaultSequence((LineTrip(23, 24, 0.1), LineTrip(24, 23, 0.2)))},
            "ieee118: every branch that joins buses 24 and 23 is open already.",
        ),
    ],
)
def test_other_requests_that_cannot_be(grid: Grid, arguments: dict[str, object], message: str) -> None:
    with pytest.raises(InputError) as failure:
        grid.waveforms(NO_VRT, **({"fault": BusFault(77)} | arguments))  # type: ignore[arg-type]
    assert str(failure.value) == message


def test_parallel_lines_open_one_after_the_other(grid: Grid) -> None:
    net = grid.network
    both = FaultSequence((LineTrip(49, 54, 0.1), LineTrip(54, 49, 0.2)))
    one, two = (stage.out for stage in both.stages(net)[1:])
    assert len(one) == 1
    assert len(two) == 2
    assert all({net.branches.from_bus[k], net.branches.to_bus[k]} == {49, 54} for k in two)


def test_until_before_the_last_event(grid: Grid) -> None:
    with pytest.raises(InputError, match=r"until = 0.5 s ends before it is cleared at 0.6 s\."):
        grid.waveforms(NO_VRT, LineTrip(23, 24, reclose=0.5), until=0.5)


def test_no_compiler_names_the_way_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(build, "find_compiler", lambda: None)
    build.network_library.cache_clear()
    try:
        with pytest.raises(InputError) as failure:
            case("kundur/kundur_full.xlsx", (7,)).waveforms({7: 10.0}, BusFault(8), until=0.3)
    finally:
        build.network_library.cache_clear()
    assert str(failure.value) == (
        "the native engine needs a C compiler and found none. Way out: install gcc or clang, "
        "pip install 'dcvrt[compiler]', or ask for engine='andes'."
    )


def test_a_case_without_machines_says_what_to_add() -> None:
    with pytest.raises(InputError) as failure:
        case("matpower/case14.m", (9,)).waveforms({9: 5.0}, BusFault(4))
    assert str(failure.value).startswith(
        "case14: the case has no dynamic data, not one machine. Way out: add a machine (GENROU, GENCLS)"
    )


def test_models_that_the_engine_lacks_are_listed_with_devices_and_count() -> None:
    path = package() / "ieee14" / "ieee14_pvd1.xlsx"
    grid = Grid.from_case(path, sites=(9,))
    system = andes.read(path)
    with pytest.raises(InputError) as failure:
        grid.waveforms({9: 5.0}, BusFault(4))
    text = str(failure.value)
    assert text.startswith("ieee14_pvd1: the native engine lacks ")
    names = ", ".join(map(str, system.PVD1.idx.v))
    assert f"\n  PVD1: {system.PVD1.n} device(s): {names}" in text
    assert text.endswith("Way out: engine='andes', or replace these devices.")


def test_an_island_is_labelled_and_the_other_faults_go_on(grid: Grid) -> None:
    island, fine = LineTrip(9, 10), BusFault(77)  # bus 10, and its unit, hang on one line
    runs = grid.waveforms_of(NO_VRT, None, [island, fine], until=0.3)
    assert list(runs) == [island, fine]
    assert runs[fine].completed
    assert not runs[island].completed
    assert "with 9-10 open, 1 bus(es) are islanded: 10. Islands are not simulated." in runs[island].status
    with pytest.raises(SimulationError, match="islanded"):
        runs[island][75]


def test_loss_of_synchronism_is_labelled_with_the_machine(grid: Grid) -> None:
    long, short = BusFault(9, clear=0.6), BusFault(77)
    runs = grid.waveforms_of({}, None, [long, short], until=2.5)
    assert runs[short].completed
    assert not runs[long].completed
    assert "lost synchronism at t = " in runs[long].status
    assert "machine 10' at bus 10 is " in runs[long].status


def test_a_sequence_is_its_faults_one_after_the_other(grid: Grid) -> None:
    first, second = BusFault(77, 0.1, 0.07), BusFault(103, 0.5, 0.1)
    both = grid.waveforms(NO_VRT, FaultSequence((first, second)), until=0.8)
    alone = grid.waveforms(NO_VRT, first, until=0.8)
    for bus in SITES:
        w = both[bus]
        assert w.jumps == pytest.approx((0.1, 0.17, 0.5, 0.6))
        early = np.linspace(0.0, 0.499, 60)
        np.testing.assert_allclose(w.at(early), alone[bus].at(early), rtol=0, atol=2e-4)  # other samples
        assert abs(w.at(0.55) - alone[bus].at(0.55)) > 1e-3


def test_waveforms_have_the_layout_that_is_promised(grid: Grid) -> None:
    fault = BusFault(77)
    runs = grid.waveforms_of(NO_VRT, None, [fault], until=0.3, wrt=("H", "wind_69", "clear"))
    for bus, w in runs[fault].waveforms.items():
        assert w.jumps == (0.1, 0.2)
        assert set(w.tangents) == {"H_21", "H_75", "H_106", "H_108", "wind_69", "clear"}
        assert w.same_layout(runs[fault][75])
        before = np.flatnonzero(w.t <= 0.1)[:-1]
        np.testing.assert_array_equal(w.v[before], w.v[0])
        assert not w.tangents["clear"][w.t < 0.2].any()
        assert f"bus {bus}" in w.name
    assert runs[fault].status == "ieee118, base, fault at bus 77, 100 ms: completed."


def test_a_unit_that_starts_outside_a_limit_is_named(tmp_path: Path) -> None:
    path = package() / "ieee14" / "ieee14.raw"
    text = path.with_suffix(".dyr").read_text()
    line = next(line for line in text.splitlines() if "TGOV1" in line)
    fields = line.split()
    (tmp_path / "small.raw").write_text(path.read_text())
    narrow = " ".join([*fields[:5], "0.31", *fields[6:]])  # V_max
    (tmp_path / "small.dyr").write_text(text.replace(line, narrow))
    narrowed = Grid.from_case(tmp_path / "small.raw", sites=(9,))
    texts = []
    for by in ("native", "andes"):
        with pytest.raises(SimulationError) as failure:
            narrowed.waveforms({9: 10.0}, BusFault(4), engine=by)
        texts.append(str(failure.value))
        assert texts[-1].startswith("small, base: 1 limit(s) are exceeded before the fault: ")
    assert "at bus 1: governor" in texts[0]
    beyond, needed = (float(re.search(r"([\d.]+) pu(?: is needed)?\. ", text)[1]) for text in texts)
    assert 0.31 + beyond == pytest.approx(needed, abs=1e-3)


def test_a_facility_that_cannot_run_in_the_period_is_named() -> None:
    grid = Grid.from_case("ieee118", sites=(21, 75))
    with pytest.raises(InputError) as failure:
        grid.waveforms(
            {75: 10.0},
            BusFault(23),
            period=Period("empty", dc_factor=0.0),
            facilities={75: facility.gfl()},
        )
    assert str(failure.value) == (
        "ieee118, empty: facility gfl at bus 75 cannot run there: d = 0 is outside [0.1, 1.2]. "
        "Way out: another dc_factor or pf, or no facility at this bus."
    )
