"""Facilities as ports of the network: what the network saw is what a facility does on its waveform."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from dcvrt import Simulator, Waveform, facility
from dcvrt.errors import SimulationError
from dcvrt.grid import BusFault, Grid, Period
from dcvrt.grid.native.engine import Engine, sample_times
from dcvrt.grid.native.run import Options, Simulated
from tests.grid.native.cases import NO_VRT, TIGHT, TIGHTEST, away, run
from tests.grid.native.test_sensitivities import compare, even, same_events, with_limits

FAULT = BusFault(2, 0.1, 0.15, x_f=0.05)
FAST = ("gfl", "gfm", "no-ups")
EVERY = [pytest.param(n, marks=() if n in FAST else pytest.mark.slow) for n in facility.names()]


@cache
def small(x_q2: float = 0.25) -> Engine:
    """Two machines and a site; voltages of all three buses are recorded."""
    of = with_limits(5.0, x_q2)
    return replace(of, sites=(1, 2, 3))


def seen(of: Engine, found: Simulated, v0: np.ndarray, scale: float = 1.0) -> np.ndarray:
    """Current, pu, into the facility at bus 3, from the balance of the bus; the fault is elsewhere."""
    net = of.network
    load = scale * (net.p_load - 1j * net.q_load) / net.base_mva / abs(v0) ** 2
    return -(found.v @ (net.admittance().toarray() + np.diag(load)).T)[:, 2]


@pytest.mark.parametrize("name", EVERY)
def test_the_facility_alone_does_the_same_on_the_waveform(name: str) -> None:
    of, diagram, mw = small(), facility.get(name), 20.0
    t, found, point = run(of, {3: mw}, FAULT, 1.5, facilities={3: diagram}, step=1 / 2000)
    assert not found.status
    i = seen(of, found, point.v0)
    dae = diagram.compile()
    given = {k: x for k, x in {"H": 1.0, "d": 1.0, "pf": 1.0}.items() if k in dae.p_names}
    alone = Simulator(dae, save_at=1e-3)(Waveform.from_samples(t, found.v[:, 2]), **given)
    base = mw / of.network.base_mva
    keep = away(t, FAULT.start, FAULT.cleared_at, *(e[0] for e in found.events), by=2e-3)
    current = base * (alone.at("i.re", t) + 1j * alone.at("i.im", t))
    assert np.abs(current - i)[keep].max() < 2e-5
    power = (found.v[:, 2] * i.conj()).real
    assert np.abs(base * alone.at("p_g", t) - power)[keep].max() < 2e-5
    # the same modes at the same times
    own = [(when, text) for when, unit, text in found.events if unit.startswith("facility")]
    assert own
    times = [event.time for event in alone.events]
    assert len(times) == len(own)
    np.testing.assert_allclose(sorted(times), [when for when, _ in own], atol=5e-5)


@pytest.mark.parametrize("name", EVERY)
def test_before_the_fault_it_is_the_power_flow(name: str) -> None:
    of = small()
    t, found, point = run(of, {3: 20.0}, FAULT, 0.3, facilities={3: facility.get(name)})
    s = found.v[0, 2] * seen(of, found, point.v0)[0].conj()
    assert s == pytest.approx(point.steady.load[2] - 1.58 - 0.3j, abs=1e-10)
    assert s.real == pytest.approx(0.2, rel=0.1)
    np.testing.assert_array_equal(found.v[t < 0.1], np.tile(point.v0, ((t < 0.1).sum(), 1)))
    _, flat, _ = run(of, {3: 20.0}, BusFault(2, x_f=1e13), 1.0, facilities={3: facility.get(name)})
    assert np.abs(flat.v - point.v0).max() < 1e-9
    assert flat.events == ()


def test_a_facility_without_size_changes_nothing() -> None:
    of = small()
    _, nothing, _ = run(of, {3: 1e-6}, FAULT, 1.0, facilities={3: facility.gfl()})
    _, open_, _ = run(of, {3: 1e-6}, FAULT, 1.0)
    assert np.abs(nothing.v - open_.v).max() < 1e-7
    _, none, _ = run(of, {}, FAULT, 1.0, facilities={3: facility.gfl()})
    assert np.abs(none.v - open_.v).max() < 1e-7


def test_open_and_closed_loop_are_close(grid: Grid) -> None:
    hosting = {b: 0.5 * mw for b, mw in NO_VRT.items()}
    fault = BusFault(77)
    diagram = facility.gfl()
    open_ = grid.waveforms(hosting, fault, until=1.0)
    closed = grid.waveforms(hosting, fault, until=1.0, facilities=dict.fromkeys(hosting, diagram))
    for bus in grid.sites:
        difference = np.abs(abs(open_[bus].v) - abs(closed[bus].v)).max()
        assert 1e-6 < difference < 0.03
        assert open_[bus].v[0] == pytest.approx(closed[bus].v[0], abs=5e-3)


def test_two_facilities_of_one_diagram_and_of_two_are_the_same() -> None:
    of, hosting = small(), {1: 10.0, 3: 20.0}
    shared = facility.gfl()
    _, one, _ = run(of, hosting, FAULT, 0.6, facilities={1: shared, 3: shared}, options=TIGHTEST)
    _, two, _ = run(
        of, hosting, FAULT, 0.6, facilities={1: facility.gfl(), 3: facility.gfl()}, options=TIGHTEST
    )
    assert np.abs(one.v - two.v).max() < 1e-9


def test_a_rating_that_does_not_carry_the_load_is_told_with_the_way_out(grid: Grid) -> None:
    coupled = dict.fromkeys(NO_VRT, facility.gfl().compile())
    with pytest.raises(SimulationError) as failure:
        grid.waveforms(NO_VRT, BusFault(22), facilities=coupled, values={"beta": 0.85})
    text = str(failure.value)
    assert text.startswith(
        "ieee118, base: 4 unit(s) have no equilibrium; largest residuals of facility gfl at "
    )
    assert text.endswith(" Way out: a higher rating of the facility, or less load, or check its data.")


@pytest.mark.parametrize("name", ["gfl", "gfm"])
def test_the_default_tolerance_keeps_voltages_and_events(grid: Grid, name: str) -> None:
    """Facilities are allowed three times the error of machines, and step at the edge of stability."""
    coupled = dict.fromkeys(NO_VRT, facility.get(name).compile())
    point = grid.native.point(NO_VRT, Period(), (), coupled, {"beta": 1.3})
    for fault in (BusFault(22), BusFault(103), BusFault(17)):
        stages = fault.stages(grid.network)
        times = sample_times(stages, 3.0, 1 / 120)
        coarse, fine = (point.simulate(stages, times, o) for o in (Options(), TIGHT))
        assert not coarse.status
        assert len(coarse.events) >= 4
        assert [e[1:] for e in coarse.events] == [e[1:] for e in fine.events]
        shift = [a[0] - b[0] for a, b in zip(coarse.events, fine.events, strict=True)]
        assert np.abs(shift).max() < 5e-6
        assert np.abs(coarse.v - fine.v).max() < 1e-5


def modes(found: Simulated, around: list[Simulated]) -> None:
    own = [text for _, unit, text in found.events if unit.startswith("facility")]
    assert len(own) >= 2
    same_events(found, around)


SENSITIVE = [
    ("gfl", 0.25), ("gfm", 0.33), ("no-ups", 0.25),
    *(pytest.param(n, 0.25, marks=pytest.mark.slow) for n in facility.names() if n not in FAST),
]  # fmt: skip


@pytest.mark.parametrize(("name", "x_q2"), SENSITIVE)
def test_tangents_in_closed_loop_across_modes_and_timers(name: str, x_q2: float) -> None:
    of, diagram = small(x_q2), facility.get(name)
    times = even(FAULT, of, 0.9, 12)
    period = Period("x", 0.95, {3: 5.0}, 0.9)
    worst = compare(
        of, {3: 20.0}, period, FAULT, ("H_3", "load", "wind_3", "clear"), times, modes, 0.2,
        facilities={3: diagram},
    )  # fmt: skip
    assert max(worst.values()) < 1e-6, worst


@pytest.mark.parametrize(("name", "beta"), [("gfl", 1.3), ("gfl", 1.03), ("gfm", 1.3)])
def test_tangents_by_the_rating(name: str, beta: float) -> None:
    """At 1.03 the limiter stands at the edge of acting before the fault."""
    of, diagram = small(0.25 if name == "gfl" else 0.33), facility.get(name)
    times = even(FAULT, of, 0.9, 12)
    of_rating = {"values": {"beta": beta}}
    names = ("beta", "H_3")
    worst = compare(
        of, {3: 20.0}, Period(), FAULT, names, times, None, 0.1, facilities={3: diagram}, **of_rating
    )
    assert max(worst.values()) < 1e-6, worst


def test_tangent_of_the_first_megawatt() -> None:
    of, diagram = small(), facility.gfl()
    times, names = even(FAULT, of, 0.6, 8), ("H_3",)
    given = dict(times=times, facilities={3: diagram}, options=TIGHTEST)
    _, none, _ = run(of, {3: 0.0}, FAULT, wrt=names, **given)
    _, some, _ = run(of, {3: 1e-2}, FAULT, wrt=names, **given)
    difference = (some.v - none.v) / 1e-2
    middle = 0.5 * (none.tangents[:, 0] + some.tangents[:, 0])  # exact to the square of the step
    assert np.abs(difference - middle).max() < 1e-5 * np.abs(middle).max()


def test_derivatives_asked_for_do_not_change_the_run() -> None:
    of, diagram = small(), facility.gfm()
    _, plain, _ = run(of, {3: 20.0}, FAULT, 0.9, facilities={3: diagram}, options=TIGHT)
    _, more, _ = run(of, {3: 20.0}, FAULT, 0.9, ("H_3", "clear"), facilities={3: diagram}, options=TIGHT)
    assert np.abs(plain.v - more.v).max() < 1e-6
    assert [e[2] for e in plain.events] == [e[2] for e in more.events]
