"""Tangents of every POI waveform against central differences, between limit events and across them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from dcvrt.grid import BusFault, Grid, LineTrip, Period
from dcvrt.grid.faults import FaultSequence
from dcvrt.grid.native.engine import Engine
from dcvrt.grid.native.run import Simulated
from dcvrt.models.machines import GenRou, Sexs, Tgov1
from tests.grid.native.cases import NO_VRT, TIGHTEST, WINDY, away, case, engine, network, run, unit

STEP = {"H": 0.5, "wind": 0.5, "load": 1e-4, "clear": 2e-5, "beta": 1e-3}


def shifted(fault: BusFault | LineTrip | FaultSequence, by: float):
    """The fault with its last change later."""
    if isinstance(fault, BusFault):
        return replace(fault, clear=fault.clear + by)
    if isinstance(fault, LineTrip) and fault.reclose is None:
        return replace(fault, start=fault.start + by)
    if isinstance(fault, LineTrip):
        return replace(fault, reclose=fault.reclose + by)
    return FaultSequence((*fault.events[:-1], shifted(fault.events[-1], by)))


def differences(
    of: Engine,
    hosting: dict[int, float],
    period: Period,
    fault: BusFault | LineTrip | FaultSequence,
    name: str,
    times: list[np.ndarray],
    scale: float = 1.0,
    values: Mapping[str, float] | None = None,
    **more: object,
) -> tuple[np.ndarray, list[Simulated]]:
    """Derivative of the voltages by four runs, fourth order in the step."""
    kind, _, bus = name.partition("_")
    h, values = STEP[kind] * scale, dict(values or {})

    def at(s: float) -> Simulated:
        own_hosting, own_period, own_fault, own_times = dict(hosting), period, fault, times
        own_values = dict(values)
        if kind == "H":
            own_hosting[int(bus)] = hosting.get(int(bus), 0.0) + s * h
        elif kind == "wind":
            own_period = replace(
                period, wind={**period.wind, int(bus): period.wind.get(int(bus), 0.0) + s * h}
            )
        elif kind == "load":
            own_period = replace(period, load_scale=period.load_scale + s * h)
        elif kind == "beta":
            own_values["beta"] = values["beta"] + s * h
        else:
            own_fault = shifted(fault, s * h)
            own_times = [t.copy() for t in times]
            own_times[-2][-1] = own_times[-1][0] = own_fault.cleared_at
        _, found, _ = run(
            of, own_hosting, own_fault, period=own_period, times=own_times, options=TIGHTEST,
            values=own_values, **more,
        )  # type: ignore[arg-type]  # fmt: skip
        assert not found.status
        return found

    a, b, c, d = runs = [at(s) for s in (-2, -1, 1, 2)]
    return (8 * (c.v - b.v) - (d.v - a.v)) / (12 * h), runs


def compare(
    of: Engine,
    hosting: dict[int, float],
    period: Period,
    fault: BusFault | LineTrip | FaultSequence,
    names: tuple[str, ...],
    times: list[np.ndarray],
    check: Callable[[Simulated, list[Simulated]], None] | None = None,
    scale: float = 1.0,
    **more: object,
) -> dict[str, float]:
    """Largest difference of tangents and central differences, over the largest tangent."""
    t, found, _ = run(of, hosting, fault, wrt=names, period=period, times=times, options=TIGHTEST, **more)  # type: ignore[arg-type]
    assert not found.status
    worst = {}
    for k, name in enumerate(names):
        expected, around = differences(of, hosting, period, fault, name, times, scale, **more)
        if check is not None:
            check(found, around)
        # samples at the clearing itself move with it
        keep = away(t, fault.cleared_at, by=1e-9) if name == "clear" else np.full(len(t), True)
        error = np.abs(found.tangents[:, k] - expected)[keep].max()
        worst[name] = error / np.abs(expected[keep]).max()
    return worst


def same_events(found: Simulated, around: list[Simulated]) -> None:
    """All runs go through the same limits, in the same order."""
    for other in around:
        assert [e[1:] for e in other.events] == [e[1:] for e in found.events]


def even(fault: BusFault | LineTrip | FaultSequence, of: Engine, until: float, count: int = 15):
    stages = fault.stages(of.network)
    ends = [*(s.begin for s in stages[1:]), until]
    return [np.linspace(s.begin, end, count) for s, end in zip(stages, ends, strict=True)]


@pytest.mark.parametrize("bus", [77, 103])
def test_of_a_large_case_between_limits(grid: Grid, bus: int) -> None:
    of, fault = grid.native, BusFault(bus, 0.1, 0.1)
    names = ("H_75", "wind_69", "load", "clear") if bus == 77 else ("H_106", "wind_80", "clear")
    worst = compare(of, NO_VRT, WINDY, fault, names, even(fault, of, 0.6), same_events)
    assert max(worst.values()) < 1e-6, worst


@pytest.mark.parametrize(
    "fault",
    [
        LineTrip(76, 77, 0.1),
        LineTrip(76, 77, 0.1, reclose=0.2),
        FaultSequence((BusFault(77, 0.1, 0.08), LineTrip(76, 77, 0.3), BusFault(80, 0.5, 0.05))),
    ],
    ids=["trip", "reclosing", "sequence"],
)
def test_through_trips_and_sequences(grid: Grid, fault: LineTrip | FaultSequence) -> None:
    of = grid.native
    worst = compare(of, NO_VRT, WINDY, fault, ("H_75", "clear"), even(fault, of, 0.8), same_events)
    assert max(worst.values()) < 1e-6, worst


def with_limits(E_max: float = 3.2, x_q2: float = 0.25) -> Engine:
    """Two machines whose field voltages reach their ceiling in a fault and leave it again."""
    values = dict(
        M=8.0,
        x_d=1.8,
        x_q=1.7,
        x_d1=0.3,
        x_q1=0.55,
        x_d2=0.25,
        x_q2=x_q2,
        x_l=0.2,
        r_a=0.002,
        S_A=0.8,
        S_B=0.1,
    )
    net = network(
        {1: "slack", 2: "pv", 3: "pq"},
        [(1, 3, 0.01 + 0.1j), (2, 3, 0.02 + 0.15j), (1, 2, 0.3j)],
        {1: 100.0, 2: 60.0},
        {3: 158.0 + 30j},
        {1: 1.02, 2: 1.01},
        taps={1: 0.98 * np.exp(0.1j)},
    )
    made = [
        unit(
            b, exciter=partial(Sexs, K=100.0, E_min=0.0, E_max=E_max, T_A=1.0, T_B=10.0, T_E=0.05),
            governor=partial(Tgov1, V_max=2.0, V_min=0.0, T_1=0.2) if b == 1 else None, kind=GenRou,
            **(values | {"M": 6.0 + b}),
        )
        for b in (1, 2)
    ]  # fmt: skip
    return engine(net, made, (3,))


@pytest.mark.parametrize("x_q2", [0.25, 0.33], ids=["explicit", "coupled"])
def test_across_limits(x_q2: float) -> None:
    of, fault = with_limits(x_q2=x_q2), BusFault(3, 0.1, 0.12, x_f=0.05)
    assert of.system.groups[0].structure.affine == (x_q2 == 0.25)

    def through(found: Simulated, around: list[Simulated]) -> None:
        texts = [e[2] for e in found.events]
        assert any("UPPER" in text for text in texts)
        assert sum("-> FREE" in text for text in texts) >= 2
        same_events(found, around)

    worst = compare(
        of, {3: 20.0}, Period(), fault, ("H_3", "load", "clear"), even(fault, of, 2.5, 40), through, scale=0.2
    )
    assert max(worst.values()) < 1e-6, worst


def test_tangents_of_the_default_tolerances_are_close(grid: Grid) -> None:
    fault, names = BusFault(77), ("H", "load", "clear")
    of = grid.native
    _, tight, _ = run(of, NO_VRT, fault, 1.0, names, WINDY, TIGHTEST)
    _, usual, _ = run(of, NO_VRT, fault, 1.0, names, WINDY, of.options)
    largest = np.abs(tight.tangents).max(axis=(0, 2))
    error = np.abs(usual.tangents - tight.tangents).max(axis=(0, 2))
    assert (error < 1e-3 * largest).all(), error / largest


def test_derivatives_asked_for_do_not_change_the_voltages(grid: Grid) -> None:
    of, fault = grid.native, BusFault(77)
    _, plain, _ = run(of, NO_VRT, fault, 1.0)
    _, more, _ = run(of, NO_VRT, fault, 1.0, ("H", "load"))
    assert np.abs(plain.v - more.v).max() < 1e-7  # other steps


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "site", "bus"), [("kundur/kundur_full.xlsx", 7, 8), ("ieee39/ieee39_full.xlsx", 15, 16)]
)
def test_of_other_cases(name: str, site: int, bus: int) -> None:
    of, fault = case(name, (site,)).native, BusFault(bus, 0.1, 0.08)
    names = (f"H_{site}", "load", "clear")
    worst = compare(of, {site: 10.0}, Period(), fault, names, even(fault, of, 1.0), same_events)
    assert max(worst.values()) < 1e-6, worst


def test_with_units_at_their_reactive_limits(grid: Grid) -> None:
    of, fault = replace(grid.native, reactive_limits=True), BusFault(77)
    hosting = {b: 0.5 * mw for b, mw in NO_VRT.items()}
    assert of.point(hosting, WINDY).steady.at_limit
    worst = compare(of, hosting, WINDY, fault, ("H_75",), even(fault, of, 0.5), same_events)
    assert max(worst.values()) < 1e-6, worst
