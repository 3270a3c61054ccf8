"""Facilities that take steps of their own inside those of machines: order, events, where it is not done."""

from __future__ import annotations

import re
from dataclasses import replace
from importlib import resources
from typing import Any

import numpy as np
import pytest

from dcvrt import facility
from dcvrt.grid import BusFault, Grid, Period
from dcvrt.grid.native.engine import sample_times
from dcvrt.grid.native.run import Options, Simulated
from tests.grid.native.cases import NO_VRT, TIGHT, TIGHTEST, run
from tests.grid.native.test_closed_loop import small
from tests.integrators.test_rk54 import numbers, table

FIXED = Options(rtol=1e3, atol=1e3)
"""No step is refused or shortened: each is as long as it may be."""
MILD = BusFault(2, 0.1, 0.15, x_f=2.5)
"""A fault in which facilities stay on the grid."""
TEXT = (resources.files("dcvrt.grid.native") / "driver" / "nested.h").read_text(encoding="utf-8")


def seen(name: str, fault: BusFault, options: Options, mw: float = 20.0, until: float = 0.9) -> Simulated:
    found = run(
        small(), {3: mw}, fault, until, facilities={3: facility.get(name)}, options=options, step=1 / 100
    )[1]
    assert not found.status
    return found


def error(found: Simulated, reference: Simulated) -> float:
    return float(np.abs(found.v - reference.v).max())


def size_error(found: Simulated, reference: Simulated) -> float:
    """Of sizes, and of angles between buses: nothing depends on an angle that all have in common."""
    sizes, angles = (f(found.v) - f(reference.v) for f in (np.abs, np.angle))
    between = np.angle(np.exp(1j * (angles - angles[:, :1])))
    return float(max(np.abs(sizes).max(), np.abs(between).max()))


# -- the method --------------------------------------------------------------------------------------------


def test_stages_of_the_machines_stand_at_stages_of_the_links() -> None:
    node = table("NODE")
    (lists,) = re.findall(r"LINK_OF\[STAGES\] = \{(.*?)\}, STAGE_OF\[STAGES\] = \{(.*?)\};", TEXT)
    link, stage = ([int(n) for n in text.split(",")] for text in lists)
    assert [(at + node[s]) / 3 for at, s in zip(link, stage, strict=True)][1:] == node[1:]


def test_states_at_two_thirds_of_a_link_are_those_of_a_rule_of_order_four() -> None:
    node = table("NODE")
    (inside,) = re.findall(r"SIMPSON\[5\] = \{(.*?)\};", TEXT)
    weights = numbers(inside)
    for degree in range(4):
        integral = sum(w * c**degree for w, c in zip(weights, node[:5], strict=True))
        assert integral == node[4] ** (degree + 1) / (degree + 1)


@pytest.mark.parametrize("name", ["gfl", "gfm"])
def test_order(name: str) -> None:
    """The pair is of order 5, what facilities remember of the voltage on the way of order 3 with a small
    factor: from 20 to 2.5 ms errors fall as those of order 4 do."""
    reference = seen(name, MILD, replace(TIGHTEST, worth=np.inf))
    assert reference.events == ()
    errors = [
        error(seen(name, MILD, replace(FIXED, worth=0.0, longest=h)), reference) for h in (0.02, 0.01, 0.0025)
    ]
    assert errors[0] / errors[1] > 2.0**4
    assert errors[0] / errors[2] > 8.0**4
    assert errors[2] < 1e-8


@pytest.mark.parametrize("name", ["gfl", "gfm"])
def test_it_errs_less_than_steps_of_all_units_of_the_same_length(name: str) -> None:
    """Lags of 2 to 5 ms, in a step of 15 ms."""
    reference = seen(name, MILD, replace(TIGHTEST, worth=np.inf))
    nested, joint = (
        error(seen(name, MILD, replace(FIXED, worth=w, longest=0.015)), reference) for w in (0.0, np.inf)
    )
    assert nested < 0.1 * joint


@pytest.mark.parametrize("name", ["gfl", "gfm"])
def test_it_steps_beyond_the_stability_of_the_lags(name: str) -> None:
    """5.3 over a rate of 250 to 380 1/s is 14 to 21 ms."""
    reference = seen(name, MILD, replace(TIGHTEST, worth=np.inf))
    assert error(seen(name, MILD, replace(FIXED, worth=0.0, longest=0.03)), reference) < 1e-3


# -- its error and its events ------------------------------------------------------------------------------


@pytest.mark.parametrize("worth", [0.0, 1.5, np.inf])
@pytest.mark.parametrize("name", ["gfl", "gfm"])
def test_voltages_and_events_are_those_of_a_tight_run(grid: Grid, name: str, worth: float) -> None:
    coupled = dict.fromkeys(NO_VRT, facility.get(name).compile())
    point = grid.native.point(NO_VRT, Period(), (), coupled, {"beta": 1.3})
    for fault in (BusFault(109), BusFault(80), BusFault(65)):
        stages = fault.stages(grid.network)
        times = sample_times(stages, 3.0, 1 / 120)
        found, tight = (
            point.simulate(stages, times, o) for o in (Options(worth=worth), replace(TIGHT, worth=np.inf))
        )
        assert not found.status
        assert len(found.events) >= 4
        assert [e[1:] for e in found.events] == [e[1:] for e in tight.events]
        assert max(abs(a[0] - b[0]) for a, b in zip(found.events, tight.events, strict=True)) < 5e-6
        assert np.abs(abs(found.v) - abs(tight.v)).max() < 1e-5


def test_fewer_steps_where_lags_bound_them(grid: Grid) -> None:
    coupled = dict.fromkeys(NO_VRT, facility.gfm().compile())
    point = grid.native.point(NO_VRT, Period(), (), coupled, {"beta": 1.3})
    stages = BusFault(22).stages(grid.network)
    times = sample_times(stages, 5.0, 1 / 120)
    nested, joint = (point.simulate(stages, times, Options(worth=w)) for w in (1.5, np.inf))
    assert nested.steps < 0.8 * joint.steps


@pytest.mark.parametrize("x_f", np.geomspace(0.05, 1.0, 8).round(3).tolist())
@pytest.mark.parametrize("name", ["gfl", "gfm"])
def test_timers_and_events_between_the_nodes(name: str, x_f: float) -> None:
    """Sags of many depths, so that guards turn true and false anywhere inside a step. In one of them a
    smoothed corner lies just before a sample; steps of all units are off by 6e-6 pu there."""
    fault = BusFault(2, 0.1, 0.13, x_f=x_f)
    reference = seen(name, fault, replace(TIGHT, worth=np.inf), until=1.0)
    for worth in (0.0, 1.5):
        found = seen(name, fault, Options(worth=worth), until=1.0)
        assert [e[1:] for e in found.events] == [e[1:] for e in reference.events]
        shift = [a[0] - b[0] for a, b in zip(found.events, reference.events, strict=True)]
        assert np.abs(shift).max(initial=0.0) < 1e-5
        assert size_error(found, reference) < 2e-5


def test_a_strong_coupling_shortens_the_step() -> None:
    """A facility nearly as large as a machine: the estimate sees what its current does to the machines.
    What is left is an angle that both machines have in common."""
    weak, strong = (seen("gfl", MILD, Options(worth=0.0), mw, 2.0) for mw in (1.0, 90.0))
    reference = seen("gfl", MILD, replace(TIGHT, worth=np.inf), 90.0, 2.0)
    assert strong.steps > weak.steps
    assert size_error(strong, reference) < 1e-5
    assert error(strong, reference) < 2e-4


# -- where it is not done ----------------------------------------------------------------------------------


def test_without_facilities_and_with_derivatives_it_changes_nothing() -> None:
    of = small()
    given: list[dict[str, Any]] = [
        dict(fault=MILD, until=0.5),
        dict(fault=MILD, until=0.5, facilities={3: facility.gfl()}, wrt=("H_3",)),
        dict(fault=MILD, until=0.5, facilities={3: facility.get("no-ups")}),
    ]
    for what in given:
        always, never = (run(of, {3: 20.0}, options=Options(worth=w), **what)[1] for w in (0.0, np.inf))
        np.testing.assert_array_equal(always.v, never.v)
        np.testing.assert_array_equal(always.tangents, never.tangents)
        assert always.steps == never.steps


def test_a_source_that_reads_its_voltage_is_stepped_with_the_machines() -> None:
    """Beside facilities that could step alone: the currents of others must not depend on voltages."""
    of, hosting = small(), {1: 10.0, 3: 20.0}
    both = {1: facility.get("no-ups"), 3: facility.gfl()}
    always, never = (
        run(of, hosting, MILD, 0.5, facilities=both, options=Options(worth=w))[1] for w in (0.0, np.inf)
    )
    np.testing.assert_array_equal(always.v, never.v)


def test_several_structures_of_facilities_step_together() -> None:
    of, hosting = small(), {1: 10.0, 2: 5.0, 3: 20.0}
    each = {1: facility.gfl(), 2: facility.gfm(), 3: facility.gfl()}
    fault = BusFault(2, 0.1, 0.15, x_f=0.3)
    found, tight = (
        run(of, hosting, fault, 1.0, facilities=each, options=o)[1]
        for o in (Options(worth=0.0), replace(TIGHT, worth=np.inf))
    )
    assert [e[1:] for e in found.events] == [e[1:] for e in tight.events]
    assert size_error(found, tight) < 1e-5
