"""The least value of a parameter: roots known in closed form, jumps, margins that do not grow, the real
facility."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dcvrt.criteria import Criteria
from dcvrt.errors import InputError
from dcvrt.planning.design import SCAN, TOLERANCE, Exposure, Least, Trial, least_value, need
from dcvrt.waveform import Waveform

Margin = Callable[[float], tuple[float, float, str]]
"""Value, slope and event sequence of one loss margin at a value of the parameter."""


class Made:
    """Exposures whose loss margins are known functions; it counts and remembers what it was asked."""

    def __init__(self, *margins: Margin) -> None:
        self.margins, self.tried = margins, []

    def __call__(self, values: Sequence[float]) -> list[Trial]:
        self.tried += values
        return [self._trial(value) for value in values]

    def _trial(self, value: float) -> Trial:
        found = [margin(value) for margin in self.margins]
        loss = np.array([m for m, *_ in found])
        slopes = np.array([slope for _, slope, _ in found])
        return Trial(
            value,
            np.column_stack([np.full(len(loss), 0.1), loss]),
            np.column_stack([np.zeros(len(loss)), slopes]),
            tuple((sequence,) if sequence else () for *_, sequence in found),
            tuple("completed" if sequence else "failed" for *_, sequence in found),
            loss >= 0,
        )


def line(root: float, slope: float) -> Margin:
    return lambda p: (slope * (p - root), slope, "NORMAL")


def hyperbola(root: float) -> Margin:
    """1/root - 1/p: steep below, flat above."""
    return lambda p: (1.0 / root - 1.0 / p, 1.0 / p**2, "NORMAL")


def step(at: float, below: float = -0.75, above: float = 0.2) -> Margin:
    """Another sequence of events below a value; no slope on either side."""
    return lambda p: (above, 0.0, "NORMAL>MIXED") if p >= at else (below, 0.0, "NORMAL>MIXED>BATTERY")


def found_at(found: Least, root: float) -> None:
    """The answer lies at the root or a tolerance above it, and was run; just below it fails."""
    assert found.value is not None
    assert found.passes is not None
    assert found.fails is not None
    assert found.passes.passed
    assert not found.fails.passed
    assert found.fails.value < root <= found.value
    assert found.value - found.fails.value <= TOLERANCE * max(found.value, 0.01 * (found.high - found.low))


@pytest.mark.parametrize("margin", [line(1.2345, 0.7), hyperbola(1.2345)])
def test_a_smooth_margin_is_solved_in_a_handful_of_steps(margin: Margin) -> None:
    """Bisection from the scan of 0.15 to the tolerance would take seven steps."""
    made = Made(margin)
    found = least_value(made, 0.8, 2.0)
    found_at(found, 1.2345)
    assert found.ends_at == "margin"
    assert len(made.tried) - SCAN <= 4
    assert found.runs == len(made.tried)


def test_the_worst_of_several_margins_decides() -> None:
    """Steep and flat ones: the root of the least margin is the largest of the roots."""
    made = Made(line(1.1, 3.0), hyperbola(1.301), line(1.3, 0.01), line(0.5, 1.0))
    found = least_value(made, 0.8, 2.0)
    found_at(found, 1.301)
    assert found.at == (1, 1)


def test_a_jump_is_found_from_the_safe_side_and_named() -> None:
    found = least_value(Made(line(0.9, 1.0), step(1.4142)), 0.8, 2.0)
    found_at(found, 1.4142)
    assert found.ends_at == "sequence"
    assert found.at == (1, 1)


def test_a_jump_without_other_events_is_named_as_well() -> None:
    found = least_value(Made(lambda p: (0.2 if p >= 1.4142 else -0.75, 0.1, "NORMAL")), 0.8, 2.0)
    found_at(found, 1.4142)
    assert found.ends_at == "jump"


def test_a_slope_that_misleads_costs_steps_and_no_answer() -> None:
    """Its tangents point away from the root or far beyond it."""
    for wrong in (-1.0, 1e-3, 1e3, 0.0, math.nan):
        made = Made(lambda p, wrong=wrong: (p - 1.37, wrong, "NORMAL"))
        found_at(least_value(made, 0.8, 2.0), 1.37)
        assert len(made.tried) - SCAN <= 25


def test_a_run_without_a_result_is_not_a_pass() -> None:
    found = least_value(
        Made(lambda p: (math.nan, math.nan, "") if p < 1.4 else (0.1, 0.0, "NORMAL")), 0.8, 2.0
    )
    found_at(found, 1.4)
    assert found.ends_at == "sequence"


def test_the_low_end_is_an_answer_of_its_own_kind() -> None:
    made = Made(line(0.5, 1.0))
    found = least_value(made, 0.8, 2.0)
    assert (found.value, found.ends_at, found.fails) == (0.8, "range", None)
    assert len(made.tried) == SCAN


def test_where_nothing_passes_the_nearest_value_is_told() -> None:
    found = least_value(Made(line(3.0, 1.0), line(0.5, 1.0)), 0.8, 2.0)
    assert (found.value, found.ends_at, found.passes) == (None, "none", None)
    assert found.fails is not None
    assert found.fails.value == 2.0
    assert found.at == (0, 1)


def test_a_margin_that_falls_again_is_seen() -> None:
    """Passing between 1.2 and 1.5 only: the answer is 1.2, and what fails above is said."""
    found = least_value(Made(lambda p: ((p - 1.2) * (1.5 - p), 2.7 - 2 * p, "NORMAL")), 0.8, 2.0)
    found_at(found, 1.2)
    assert found.fails_above == pytest.approx((1.55, 1.7, 1.85, 2.0))


def test_a_wide_range_is_scanned_by_ratios() -> None:
    made = Made(line(0.004, 1.0))
    found_at(least_value(made, 0.001, 1.0), 0.004)
    ratios = np.array(made.tried[1:SCAN]) / np.array(made.tried[: SCAN - 1])
    assert ratios == pytest.approx(1000.0 ** (1 / (SCAN - 1)))


@settings(deadline=None)
@given(
    roots=st.lists(st.floats(0.5, 1.95), min_size=1, max_size=6),
    slopes=st.lists(st.floats(1e-3, 1e3), min_size=6, max_size=6),
    jump=st.floats(0.5, 1.95),
)
def test_any_mixture_of_lines_and_a_jump_is_found_to_the_tolerance(
    roots: list[float], slopes: list[float], jump: float
) -> None:
    margins = [line(root, slope) for root, slope in zip(roots, slopes, strict=False)]
    found = least_value(Made(step(jump), *margins), 0.8, 2.0)
    least = max(0.8, jump, *roots)
    assert found.value is not None
    assert least <= found.value <= least * (1 + TOLERANCE) + 1e-12


@pytest.mark.parametrize(
    ("low", "high", "tolerance"), [(1.5, 1.5, 1e-3), (2.0, 1.0, 1e-3), (0.8, math.inf, 1e-3), (0.8, 2.0, 0.0)]
)
def test_what_cannot_be_searched_is_refused(low: float, high: float, tolerance: float) -> None:
    with pytest.raises(InputError) as caught:
        least_value(Made(line(1.0, 1.0)), low, high, tolerance)
    assert str(caught.value) == (
        f"design: nothing to search from {low:g} to {high:g} with a tolerance of {tolerance:g}. Way out: a "
        "finite range whose low end is below the high one, and a tolerance above 0."
    )


# -- the real facility ---------------------------------------------------------------------------------------


def exposed(*retained: float, length: float = 0.1, d: float = 1.0) -> list[Exposure]:
    return [
        Exposure("peak", f"to {v:g} pu", Waveform.sag(retained=v, start=0.1, length=length, until=0.6), d)
        for v in retained
    ]


@pytest.mark.parametrize(("retained", "loss_share"), [(0.55, 0.25), (0.6, 0.2), (0.65, 0.1)])
def test_a_rectangular_sag_needs_what_the_static_law_says(retained: float, loss_share: float) -> None:
    """At full load P = beta V against P0 = 1: a loss of at most lambda needs beta = (1 - lambda)/V."""
    found = need("gfl", exposed(retained), pf=1.0, criteria=Criteria(loss_share=loss_share))
    # The limiter rounds its corner over 0.001 pu, and sheds that much earlier.
    assert found.least.value == pytest.approx((1.0 - loss_share) / retained, rel=3e-3)
    assert found.least.ends_at == "margin"
    assert found.confirmed


def test_it_is_the_load_that_must_be_carried_not_the_capacity() -> None:
    full, part = (need("gfl", exposed(0.5, d=d), pf=1.0).least.value for d in (1.0, 0.8))
    assert full is not None
    assert part is not None
    assert part / full == pytest.approx(0.8, rel=3e-3)


@pytest.mark.parametrize(("variant", "parameter"), [("gfl", "beta"), ("gfm", "beta"), ("gfm", "dc.T_hold")])
def test_the_answer_passes_and_one_percent_below_fails(variant: str, parameter: str) -> None:
    """Of several waveforms together, by runs of a simulator that no search has used."""
    from dcvrt import Simulator, facility

    exposures = exposed(0.8, 0.62, 0.7)
    criteria = Criteria(loss_share=0.2)
    values = {} if parameter == "beta" else {"beta": 1.6}
    found = need(variant, exposures, parameter, criteria=criteria, values=values)
    assert found.least.value is not None
    assert found.confirmed
    simulator = Simulator(facility.get(variant).compile())
    for factor, passes in ((1.0, True), (0.99, False), (1.05, True)):
        table = values | {"H": 1.0, "d": 1.0, "pf": 0.98, parameter: factor * found.least.value}
        result = simulator.batch([e.waveform for e in exposures], table, criteria=criteria)
        assert all(m is not None and m.passed for m in result.margins) is passes


def test_too_small_a_battery_lets_the_link_collapse() -> None:
    """An answer at a change of events: the run below it does not reach its end."""
    found = need("gfl", exposed(0.62), "bess.P_dis", values={"beta": 1.25})
    least = found.least
    assert least.ends_at == "sequence"
    assert found.confirmed
    assert least.fails is not None
    assert least.fails.status[0].startswith("DC link voltage left")
    # What the converter does not bring has to come from the battery: 1 - beta V, less what the link holds.
    short = 1.0 - 1.25 * 0.62
    held = 0.03 * (1.0 - 0.36) / 0.1
    assert least.value is not None
    assert short - held < least.value < short


def test_no_rating_helps_a_facility_that_leaves_the_grid() -> None:
    """A dip that outlasts the tolerated time sends the supervisor to BATTERY: the whole import is lost."""
    exposures = [*exposed(0.9, d=0.9), *exposed(0.7, length=0.3, d=0.9)]
    found = need("gfl", exposures)
    assert found.least.value is None
    assert not found.confirmed
    assert found.replayed == ()
    assert "BATTERY" in " ".join(found.least.fails.sequence[1])  # type: ignore[union-attr]
    assert need("gfl", exposures, values={"sup.T_dip": 0.5}).least.value is not None


def test_everything_wrong_with_a_question_is_told_at_once() -> None:
    with pytest.raises(InputError) as caught:
        need("gfl", [], "bess.P_disc", low=0.1)
    assert str(caught.value).startswith(
        "design: 2 problems\n"
        "  there is no waveform to ride through.\n"
        "  bess.P_disc: variant 'gfl' has no such parameter. Did you mean 'bess.P_dis'? Known: beta, "
    )
    for wrong, told in (
        (dict(parameter="dc.T_hold", low=0.0), "dc.T_hold = 0 s is outside [0.001, 1]."),
        (dict(parameter="beta", low=1.6, high=1.2), "beta: nothing to search from 1.6 to 1.2."),
        (
            dict(parameter="d"),
            "d: is set by the site, the period and the grid, and cannot be sought.",
        ),
        (
            dict(parameter="beta", values={"beta": 1.2}),
            "beta: is sought and given. Way out: leave it out of the values.",
        ),
    ):
        with pytest.raises(InputError) as caught:
            need("gfl", exposed(0.8), **wrong)  # type: ignore[arg-type]
        assert str(caught.value) == f"design: {told}"


def test_a_parameter_without_bounds_needs_a_range(monkeypatch: pytest.MonkeyPatch) -> None:
    from dataclasses import replace

    from dcvrt import facility
    from dcvrt.planning.design import parameter_problems

    dae = facility.gfl().compile()
    rows = tuple(
        replace(row, bounds=(-math.inf, math.inf)) if row.path == "bess.P_dis" else row
        for row in dae.parameter_rows
    )
    unbounded = replace(dae, parameter_rows=rows)
    assert parameter_problems(unbounded, "gfl", "bess.P_dis", None, None) == [
        "bess.P_dis: has no low bound. Way out: give the low end of its range.",
        "bess.P_dis: has no high bound. Way out: give the high end of its range.",
    ]
    assert parameter_problems(unbounded, "gfl", "bess.P_dis", 0.0, 2.0) == []
