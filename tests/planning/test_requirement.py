"""What a plan has to meet: margins of the sites and of the system, on numbers worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from dcvrt.errors import InputError
from dcvrt.planning.exact import Exact, exact_of
from dcvrt.planning.requirement import EverySite, SystemLimit, lost_whole

SITES = (21, 75, 106)
D = {"peak": 0.8}


def exact(H, value, loss, slope=None, sequence=("NORMAL",) * 3) -> Exact:
    n = len(SITES)
    value = np.asarray(value, dtype=float)
    return Exact(
        np.asarray(H, dtype=float),
        ("peak", "a"),
        value,
        np.zeros((n, 2, n)) if slope is None else slope,
        np.full((n, 2), 2.0),
        np.asarray(loss, dtype=float),
        np.zeros((n, n)),
        sequence,
        ("completed",) * n,
    )


def test_aggregate_loss_is_the_sum_over_open_sites_of_load_times_share() -> None:
    one = exact([100.0, 50.0, 0.0], [[0.1, 0.15], [0.1, 0.05], [0.1, -0.3]], [0.10, 0.20, 0.55])
    m = SystemLimit(SITES, D, mw=30.0).margins(one)
    assert m.value == pytest.approx([30.0 - 0.8 * (10.0 + 10.0)])
    assert m.size == pytest.approx([0.8 * 150.0])
    # Opening the closed site costs its own share, although it loses nothing yet.
    assert m.slope[0] == pytest.approx([-0.08, -0.16, -0.44])
    assert m.by_beta == pytest.approx([0.8 * 150.0 * 2.0])
    m = SystemLimit(SITES, D, share=0.1).margins(one)
    assert m.value == pytest.approx([0.1 * 120.0 - 16.0])
    assert m.slope[0] == pytest.approx([0.0, -0.08, -0.36])


def test_the_gradient_of_the_aggregate_loss_is_total() -> None:
    """Against differences of a loss whose shares move with every capacity."""
    rng = np.random.default_rng(4)
    a, b = rng.uniform(0.05, 0.2, 3), rng.uniform(0.0, 1e-3, (3, 3))
    H = np.array([20.0, 60.0, 40.0])
    limit = SystemLimit(SITES, D, mw=5.0, share=0.07)

    def at(H: np.ndarray) -> np.ndarray:
        share = a + b @ H
        slope = np.zeros((3, 2, 3))
        slope[:, 1] = -b
        return limit.margins(exact(H, np.column_stack([np.full(3, 0.1), 0.25 - share]), share, slope))

    difference = [(at(H + 0.1 * e).value - at(H - 0.1 * e).value)[0] / 0.2 for e in np.eye(3)]
    assert at(H).slope[0] == pytest.approx(difference, rel=1e-9)


def test_a_site_lost_whole_counts_with_all_of_its_load() -> None:
    """The IT voltage of the first is not held, the run of the second ended early, the third draws on."""
    one = exact([10.0, 20.0, 40.0], [[-0.01, 0.2], [np.nan, np.nan], [0.1, 0.2]], [0.05, 1.0, 0.05])
    assert lost_whole(one).tolist() == [True, True, False]
    m = SystemLimit(SITES, D, mw=30.0).margins(one)
    assert m.value == pytest.approx([30.0 - 0.8 * (10.0 + 20.0 + 2.0)])
    assert m.slope[0] == pytest.approx([-0.8, -0.8, -0.04])
    assert m.missed() == []
    assert EverySite(SITES).margins(one).missed() == [0, 2, 3]


def test_a_site_without_a_load_that_could_be_lost_is_no_pass() -> None:
    """Whatever the limit: what never ran before the fault, or was never simulated, cannot be open."""
    value, loss = [[0.1, 0.2], [np.nan, np.nan], [0.1, 0.2]], [0.05, np.nan, 0.05]
    limit = SystemLimit(SITES, D, mw=1e6)
    closed, opened = exact([10.0, 0.0, 40.0], value, loss), exact([10.0, 1.0, 40.0], value, loss)
    assert limit.margins(closed).missed() == []
    assert limit.margins(closed).unknown.tolist() == [False, True, False]
    assert np.isfinite(limit.margins(closed).slope).all()
    assert limit.margins(opened).missed() == [0]


def test_rows_tell_what_was_lost_from_what_never_ran() -> None:
    row = dict(mode="gfl", beta=1.1, period="peak", fault="a", ok=0, sequence="", status="why", gradients={})
    rows = [
        row | {"site": 21, "failed_in": "facility"},
        row | {"site": 75, "failed_in": "start"},
        row | {"site": 106, "failed_in": "grid"},
    ]
    (one,) = exact_of(rows, SITES, [1.0, 1.0, 1.0])["gfl", 1.1]
    assert one.loss[0] == 1.0
    assert np.isnan(one.loss[1:]).all()


def test_a_visit_to_battery_is_another_course_of_the_whole_system() -> None:
    value = [[0.1, 0.2]] * 3
    before = exact([1.0, 1.0, 1.0], value, [0.1] * 3, sequence=("NORMAL", "NORMAL", "NORMAL"))
    after = exact([1.0, 1.0, 1.0], value, [0.1] * 3, sequence=("NORMAL", "NORMAL", "NORMAL>BATTERY"))
    every, system = EverySite(SITES), SystemLimit(SITES, D, mw=1.0)
    assert not system.margins(before).same_course(system.margins(after), 0)
    assert every.margins(before).same_course(every.margins(after), 0)
    assert not every.margins(before).same_course(every.margins(after), 5)


def test_only_open_sites_count_and_the_system_always_does() -> None:
    H = np.array([1.0, 0.0, 2.0])
    assert EverySite(SITES).counts(H).tolist() == [True, True, False, False, True, True]
    assert SystemLimit(SITES, D).counts(np.zeros(3)).tolist() == [True]
    nothing = exact(np.zeros(3), [[-1.0, -1.0]] * 3, [1.0] * 3)
    assert SystemLimit(SITES, D, mw=0.0).margins(nothing).missed() == []


def test_labels_and_units() -> None:
    every, system = EverySite(SITES), SystemLimit(SITES, D, mw=12.5, share=0.05)
    assert [every.label(k) for k in (0, 3)] == ["voltage at bus 21", "loss at bus 75"]
    assert [every.unit(k) for k in (0, 3)] == ["pu", "share of load"]
    assert (system.label(0), system.target(0), system.unit(0)) == (
        "loss of all sites",
        "aggregate loss",
        "MW",
    )
    assert system.name == "12.5 MW and 5 % of the load"
    assert SystemLimit(SITES, D).name == "0 MW"


def test_limits_that_cannot_be_are_refused() -> None:
    with pytest.raises(InputError) as error:
        SystemLimit(SITES, D, mw=-1.0, share=1.5)
    assert str(error.value) == (
        "system limit: 2 problems\n"
        "  mw = -1 must be finite and at least 0.\n"
        "  share = 1.5 must lie in [0, 1]."
    )
