"""The least rating: the static law on rectangular sags, what no rating can do, margins that do not grow."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dcvrt.criteria import Criteria
from dcvrt.errors import InputError
from dcvrt.planning.rating import least_rating
from dcvrt.planning.replay import simulator_of
from dcvrt.waveform import Waveform

CRITERIA = Criteria(loss_share=0.25, loss_window=0.04)


def sag(retained: float, length: float = 0.1) -> Waveform:
    return Waveform.sag(retained=retained, start=0.1, length=length, until=0.6)


@pytest.mark.parametrize(("retained", "loss_share"), [(0.55, 0.25), (0.6, 0.25), (0.6, 0.2), (0.65, 0.1)])
def test_a_rectangular_sag_needs_what_the_static_law_says(retained: float, loss_share: float) -> None:
    """At full load P = beta V against P0 = 1: a loss of at most lambda needs beta = (1 - lambda)/V."""
    found = least_rating(
        simulator_of("gfl", {}),
        [sag(retained)],
        1.0,
        1.0,
        Criteria(loss_share=loss_share),
        tolerance=1e-4,
    )
    # The limiter rounds its corner over 0.001 pu, and sheds that much earlier.
    assert found == pytest.approx((1.0 - loss_share) / retained, rel=3e-3)


def test_it_is_the_load_that_must_be_carried_not_the_capacity() -> None:
    simulator = simulator_of("gfl", {})
    full, part = (least_rating(simulator, [sag(0.5)], d, 1.0, CRITERIA, tolerance=1e-4) for d in (1.0, 0.8))
    assert full is not None
    assert part is not None
    assert part / full == pytest.approx(0.8, rel=3e-3)


def test_several_waveforms_need_what_the_worst_of_them_needs() -> None:
    simulator = simulator_of("gfm", {})
    waveforms = [sag(0.8), sag(0.62), sag(0.7), sag(0.9)]
    loads = [1.0, 0.85, 1.0, 0.9]
    alone = [
        least_rating(simulator, [w], d, 0.98, CRITERIA, tolerance=1e-3)
        for w, d in zip(waveforms, loads, strict=True)
    ]
    together = least_rating(simulator, waveforms, loads, 0.98, CRITERIA, tolerance=1e-3)
    assert None not in alone
    assert together == pytest.approx(max(a for a in alone if a is not None), abs=1e-3)


def test_a_rating_that_is_enough_is_not_undercut() -> None:
    assert least_rating(simulator_of("gfl", {}), [sag(0.97)], 0.9, 0.98, CRITERIA, low=1.3) == 1.3


def test_no_rating_helps_a_facility_that_leaves_the_grid() -> None:
    """A dip that outlasts the tolerated time sends the supervisor to BATTERY: the whole import is lost."""
    simulator = simulator_of("gfl", {})
    outlasting = sag(0.7, length=0.3)
    assert least_rating(simulator, [sag(0.9), outlasting], 0.9, 0.98, CRITERIA) is None
    tolerant = least_rating(
        simulator, [sag(0.9), outlasting], 0.9, 0.98, CRITERIA, parameters={"sup.T_dip": 0.5}
    )
    assert tolerant is not None


def test_too_narrow_a_search_is_told_from_a_result() -> None:
    assert least_rating(simulator_of("gfl", {}), [sag(0.5)], 1.0, 1.0, CRITERIA, high=1.2) is None


class Made:
    """A simulator whose runs pass between given ratings, by waveform; it counts and remembers its runs."""

    def __init__(self, passing: list[list[tuple[float, float]]], failing_below: float = 0.0) -> None:
        self.passing, self.failing_below = passing, failing_below
        self.passed: dict[float, set[int]] = {}

    def batch(self, waveforms: list[Waveform], table: dict[str, float], criteria: Criteria) -> object:
        beta, k = table["beta"], int(waveforms[0].name)
        if beta < self.failing_below:
            return SimpleNamespace(margins=(None,))
        good = any(a <= beta <= b for a, b in self.passing[k])
        if good:
            self.passed.setdefault(beta, set()).add(k)
        return SimpleNamespace(margins=(SimpleNamespace(passed=good),))

    def waveforms(self) -> list[Waveform]:
        return [Waveform.from_samples([0.0, 1.0], [1.0, 1.0], name=str(k)) for k in range(len(self.passing))]


@given(st.lists(st.floats(0.5, 2.0), min_size=1, max_size=8))
def test_thresholds_are_found_to_the_tolerance_in_any_order(thresholds: list[float]) -> None:
    made = Made([[(least, 9.0)] for least in thresholds])
    found = least_rating(made, made.waveforms(), 1.0, 1.0, CRITERIA, tolerance=0.01)  # type: ignore[arg-type]
    least = max(1.0, *thresholds)
    assert found is not None
    assert least <= found <= max(least + 0.01, 1.0)


@given(
    st.lists(
        st.lists(st.tuples(st.floats(0.9, 2.0), st.floats(0.0, 0.5)), min_size=0, max_size=3),
        min_size=1,
        max_size=5,
    )
)
def test_the_result_was_run_and_passed_on_every_waveform_whatever_the_margins_do(
    windows: list[list[tuple[float, float]]],
) -> None:
    made = Made([[(a, a + width) for a, width in some] + [(1.95, 2.0)] for some in windows])
    found = least_rating(made, made.waveforms(), 1.0, 1.0, CRITERIA)  # type: ignore[arg-type]
    assert found is not None
    assert made.passed[found] == set(range(len(windows)))


def test_a_failed_run_is_not_a_pass() -> None:
    made = Made([[(0.0, 9.0)]], failing_below=1.4)
    found = least_rating(made, made.waveforms(), 1.0, 1.0, CRITERIA)  # type: ignore[arg-type]
    assert found == pytest.approx(1.4, abs=0.005)
    assert found >= 1.4


def test_what_cannot_be_searched_is_told() -> None:
    simulator, one = simulator_of("gfl", {}), sag(0.7)
    for call, told in (
        (lambda: least_rating(simulator, [], 1.0, 1.0, CRITERIA), "there is no waveform to ride through."),
        (
            lambda: least_rating(simulator, [one], np.ones(2).tolist(), 1.0, CRITERIA),
            "2 load factors for 1 waveforms. Give one for all or one each.",
        ),
        (
            lambda: least_rating(simulator, [one], 1.0, 1.0, CRITERIA, low=1.5, high=1.5),
            "nothing to search between low = 1.5 and high = 1.5 with a tolerance of 0.005.",
        ),
    ):
        with pytest.raises(InputError) as caught:
            call()
        assert str(caught.value) == f"least rating: {told}"
