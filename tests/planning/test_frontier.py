"""The frontier on margins known in closed form: it finds the optimum, replays it, and says where it kept
back."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from dcvrt.errors import InputError
from dcvrt.planning.exact import Run
from dcvrt.planning.plan import Row
from dcvrt.planning.requirement import EverySite
from dcvrt.planning.search import Found
from tests.planning import closed_form
from tests.planning.closed_form import PERIOD, Margins, Oracle, Programme, passes


def search(
    programme: Programme,
    oracle: Oracle,
    box: Sequence[float],
    runs: Sequence[Run] = (("gfl", 1.2),),
    samples: np.ndarray | None = None,
    **options: float,
) -> list[Found]:
    """Plans whose every site meets its own margins."""
    wanted = [(run, EverySite(programme.sites)) for run in runs]
    return closed_form.search(programme, oracle, box, wanted, samples, **options)


def affine(a: np.ndarray, b: np.ndarray) -> Margins:
    """Loss margin a_i - b_i . H at every fault, voltage margin 0.1."""

    def margins(H: np.ndarray, fault: str, beta: float) -> tuple[np.ndarray, np.ndarray, list[str]]:
        n = len(H)
        value = np.column_stack([np.full(n, 0.1), a - b @ H])
        slope = np.zeros((n, 2, n))
        slope[:, 1] = -b
        return value, slope, ["NORMAL"] * n

    return margins


def test_rows_of_the_search_name_what_they_are_made_from() -> None:
    """A separation's row does, too: it stands for the same margin."""

    def margins(H: np.ndarray, fault: str, beta: float) -> tuple[np.ndarray, np.ndarray, list[str]]:
        value, slope, _ = affine(np.array([0.1]), np.array([[1e-4]]))(H, fault, beta)
        if H[0] <= 60.0:
            return value, slope, ["NORMAL"]
        return value - [0.0, 0.5], slope, ["BATTERY"]

    programme = Programme(1, 1e9)
    asked: list[Row] = []
    plain = programme.solve

    def solve(rows: Sequence[Row] = (), **others: object) -> closed_form.Answer:
        asked.extend(rows)
        return plain(rows, **others)

    programme.solve = solve
    search(programme, Oracle(programme, margins, ["a"]), [200.0])
    assert any(row.label.endswith("(by sequence)") for row in asked)
    named = {(row.site, row.period, row.fault, row.mode, row.target) for row in asked}
    assert named == {(1, PERIOD, "a", "gfl", "loss")}


def test_affine_margins_are_met_exactly_with_one_candidate() -> None:
    b = np.diag([1e-3, 2e-3, 1e-3])
    programme = Programme(3, 1e9)
    oracle = Oracle(programme, affine(np.array([0.1, 0.1, -0.05]), b), ["a"])
    (found,) = search(programme, oracle, [200.0] * 3)
    assert found.settled
    assert found.candidates == 1
    assert found.plan.by_site == pytest.approx({1: 100.0, 2: 50.0, 3: 0.0}, abs=0.02)
    assert found.gap < 0.005
    assert found.closed == {3: "loss at bus 3, fault a, peak, gfl, beta 1.2"}
    assert [one.place for one in found.certificate] == [(PERIOD, "a")]
    assert passes(found)
    assert {(b.site, b.target, b.fault, b.period) for b in found.binding} == {
        (1, "loss", "a", PERIOD),
        (2, "loss", "a", PERIOD),
    }
    assert sorted(b.price for b in found.binding) == pytest.approx([500.0, 1000.0])
    assert [b.by_beta for b in found.binding] == pytest.approx([b.price for b in found.binding])


def test_curved_margins_of_either_sign_are_met_to_the_gain_asked_for() -> None:
    """Concave at site 1, convex at site 2, where tangents of far points deny what is possible."""

    def margins(H: np.ndarray, fault: str, beta: float) -> tuple[np.ndarray, np.ndarray, list[str]]:
        x, y = H / 100.0
        value = np.array([[0.1, 0.1 * (1 - x**2)], [0.1, 0.1 * (np.exp(-2 * y) - np.exp(-1.6))]])
        slope = np.zeros((2, 2, 2))
        slope[0, 1, 0] = -0.2 * x / 100
        slope[1, 1, 1] = -0.2 * np.exp(-2 * y) / 100
        return value, slope, ["NORMAL"] * 2

    programme = Programme(2, 1e9)
    (found,) = search(programme, Oracle(programme, margins, ["a"]), [150.0, 150.0])
    assert found.settled
    assert found.plan.total_mw == pytest.approx(180.0, rel=0.005)
    assert passes(found)


def test_more_capacity_may_help_a_margin() -> None:
    """A site that passes only when it is large: the tangent at next to nothing does not close it."""
    programme = Programme(1, 1e9)
    oracle = Oracle(programme, affine(np.array([-0.02]), np.array([[-5e-4]])), ["a"])
    (found,) = search(programme, oracle, [100.0])
    assert found.plan.total_mw == pytest.approx(100.0)


def test_a_jump_of_the_sequence_is_kept_on_the_safe_side_and_said() -> None:
    """Beyond 70 MW everything is lost, with no gradient that would tell."""

    def margins(H: np.ndarray, fault: str, beta: float) -> tuple[np.ndarray, np.ndarray, list[str]]:
        lost = H[0] > 70.0
        value = np.array([[0.1, -0.75 if lost else 0.2], [0.1, 0.2]])
        return value, np.zeros((2, 2, 2)), ["NORMAL>BATTERY" if lost else "NORMAL", "NORMAL"]

    programme = Programme(2, 1e9)
    oracle = Oracle(programme, margins, ["a", "b"])
    (found,) = search(programme, oracle, [100.0, 50.0])
    assert found.settled
    assert 66.0 < found.plan.by_site[1] <= 70.0  # five halvings of what lay between
    assert found.plan.by_site[2] == pytest.approx(50.0)
    assert found.by_sequence
    assert "loss at bus 1, fault a, peak, gfl, beta 1.2: NORMAL becomes NORMAL>BATTERY" in found.by_sequence


def test_a_failed_run_is_never_a_pass() -> None:
    """Runs fail beyond 60 MW at site 1, and everywhere at site 2."""

    def margins(H: np.ndarray, fault: str, beta: float) -> tuple[np.ndarray, np.ndarray, list[str]]:
        value = np.array([[0.1, 0.2], [np.nan, np.nan]])
        if H[0] > 60.0:
            value[0] = np.nan
        return value, np.zeros((2, 2, 2)), ["NORMAL" if H[0] <= 60 else "", ""]

    programme = Programme(2, 1e9)
    (found,) = search(programme, Oracle(programme, margins, ["a"]), [100.0, 50.0])
    assert 57.0 < found.plan.by_site[1] <= 60.0
    assert found.plan.by_site[2] == 0.0
    assert found.closed[2].startswith("no margin known")


def test_where_the_replay_finds_less_the_plan_gives_way_until_it_passes() -> None:
    programme = Programme(1, 1e9)
    oracle = Oracle(programme, affine(np.array([0.1]), np.array([[1e-3]])), ["a"], less=0.004)
    (found,) = search(programme, oracle, [200.0])
    assert found.plan.total_mw == pytest.approx(96.0, abs=0.5)
    assert found.plan.total_mw <= 96.0
    assert passes(found)
    oracle = Oracle(programme, affine(np.array([0.1]), np.array([[1e-3]])), ["a"], less=1.0)
    (found,) = search(programme, oracle, [200.0])
    assert found.plan.total_mw == 0.0
    assert not found.certificate


def test_nothing_that_passes_is_a_plan_of_nothing_with_reasons() -> None:
    programme = Programme(2, 1e9)
    oracle = Oracle(programme, affine(np.array([-0.1, -0.2]), 1e-4 * np.eye(2)), ["a"])
    (found,) = search(programme, oracle, [100.0, 100.0])
    assert found.plan.total_mw == 0.0
    assert set(found.closed) == {1, 2}
    assert found.settled
    assert found.candidates == 0


def test_searches_share_what_is_simulated_and_each_finds_its_own() -> None:
    def margins(H: np.ndarray, fault: str, beta: float) -> tuple[np.ndarray, np.ndarray, list[str]]:
        return affine(np.full(2, beta - 1.0), 1e-3 * np.eye(2))(H, fault, beta)

    programme = Programme(2, 1e9)
    oracle = Oracle(programme, margins, ["a", "b", "c"])
    runs = [("gfl", beta) for beta in (1.0, 1.05, 1.1, 1.3)]
    found = search(programme, oracle, [100.0, 100.0], runs)
    assert [f.plan.total_mw for f in found] == pytest.approx([0.0, 100.0, 200.0, 200.0], abs=0.1)
    assert len(oracle.simulated) == len(set(oracle.simulated))
    assert len(oracle.replayed) == len(set(oracle.replayed))


def known_optimum(n: int, seed: int) -> tuple[Programme, Margins, np.ndarray, float]:
    """Concave margins of own and other capacities, every tenth site hopeless; the optimum of an independent
    solver."""
    from scipy.optimize import LinearConstraint, NonlinearConstraint, minimize

    rng = np.random.default_rng(seed)
    cap = rng.uniform(50, 150, n)
    a = rng.uniform(0.05, 0.15, (3, n))
    a[:, ::10] = -0.05
    b = rng.uniform(0.0, 0.02 / n, (3, n, n)) + 0.1 * np.eye(n)

    def margins(H: np.ndarray, fault: str, beta: float) -> tuple[np.ndarray, np.ndarray, list[str]]:
        k, x = int(fault), H / cap
        v = np.column_stack([np.full(n, 0.1), a[k] - b[k] @ x**2])
        slope = np.zeros((n, 2, n))
        slope[:, 1] = -2.0 * b[k] * x / cap
        return v, slope, ["NORMAL"] * n

    is_open = a[0] > 0
    best = minimize(
        lambda H: -H.sum(),
        0.3 * cap * is_open,
        jac=lambda H: -np.ones(n),
        bounds=[(0, c * o) for c, o in zip(cap, is_open, strict=True)],
        constraints=[
            NonlinearConstraint(
                lambda H: np.concatenate([margins(H, str(k), 1.0)[0][is_open, 1] for k in range(3)]),
                0.0,
                np.inf,
                jac=lambda H: np.concatenate([margins(H, str(k), 1.0)[1][is_open, 1] for k in range(3)]),
            ),
            LinearConstraint(np.ones(n), -np.inf, 0.55 * cap.sum()),
        ],
        method="SLSQP",
        options={"ftol": 1e-10, "maxiter": 500},
    )
    assert best.success
    return Programme(n, 0.55 * float(cap.sum())), margins, cap, float(-best.fun)


@pytest.mark.parametrize("n", [20, 30])
def test_more_than_twenty_sites_reach_the_known_optimum(n: int) -> None:
    programme, margins, cap, best = known_optimum(n, 3)
    oracle = Oracle(programme, margins, ["0", "1", "2"])
    (found,) = search(programme, oracle, cap)
    assert found.settled
    assert best * (1 - 0.006) <= found.plan.total_mw <= best * (1 + 1e-6)
    assert {bus for bus, mw in found.plan.by_site.items() if mw == 0} == set(range(1, n + 1, 10))
    assert passes(found)
    assert found.candidates <= 10


def test_the_same_answer_in_whatever_order_the_questions_are_answered() -> None:
    programme, margins, cap, _ = known_optimum(6, 5)
    runs = [("gfl", 1.0), ("gfm", 1.0), ("gfl", 1.3)]
    totals = []
    for order in (1, -1):
        oracle = Oracle(programme, margins, ["0", "1", "2"])
        straight = oracle.simulate
        oracle.simulate = lambda q, s=straight, o=order: s(q[::o])[::o]  # type: ignore[method-assign]
        totals.append([f.plan.by_site for f in search(programme, oracle, cap, runs)])
    assert totals[0] == totals[1]


def test_an_exhausted_search_says_so() -> None:
    programme, margins, cap, _ = known_optimum(10, 1)
    (found,) = search(programme, Oracle(programme, margins, ["0"]), cap, candidates=1)
    assert not found.settled


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"runs": []}, "frontier: there are no runs."),
        ({"samples": np.zeros((0, 1))}, "frontier: there are no samples."),
        ({"samples": np.zeros((1, 2))}, "frontier: 2 and 1 capacities in samples and box for 1 sites."),
        ({"gain": 0.0}, "frontier: gain = 0 must be above 0."),
    ],
)
def test_bad_input_is_refused(change: dict, text: str) -> None:
    programme = Programme(1, 1e9)
    oracle = Oracle(programme, affine(np.array([0.1]), np.array([[1e-3]])), ["a"])
    with pytest.raises(InputError) as error:
        search(programme, oracle, [100.0], **change)
    assert str(error.value) == text
