"""The largest plan under a limit on what is lost at once, on losses known in closed form."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from dcvrt.planning.frontier import Known, frontiers
from dcvrt.planning.requirement import EverySite, SystemLimit
from dcvrt.planning.search import Found, Options
from tests.planning import closed_form
from tests.planning.closed_form import LOSS_SHARE, PERIOD, Margins, Oracle, Programme, passes

RUN = ("gfl", 1.2)
D = {PERIOD: 0.9}


def shares(a: np.ndarray, b: np.ndarray) -> Margins:
    """Lost share a_f + b_f H at each site under fault f, the IT voltage always held."""

    def margins(H: np.ndarray, fault: str, beta: float) -> tuple[np.ndarray, np.ndarray, list[str]]:
        n, f = len(H), int(fault)
        value = np.column_stack([np.full(n, 0.1), LOSS_SHARE - a[f] - b[f] @ H])
        slope = np.zeros((n, 2, n))
        slope[:, 1] = -b[f]
        return value, slope, ["NORMAL"] * n

    return margins


def lost(H: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Aggregate loss of each fault, MW."""
    return D[PERIOD] * np.einsum("i,fi->f", H, a + np.einsum("fij,j->fi", b, H))


def limits(programme: Programme, mw: list[float]) -> list[tuple[tuple[str, float], SystemLimit]]:
    return [(RUN, SystemLimit(programme.sites, D, mw=limit)) for limit in mw]


def capacities(found: Found) -> np.ndarray:
    return np.array(list(found.plan.by_site.values()))


def random_shares(n: int, faults: int, seed: int, curved: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    cap = rng.uniform(50, 150, n)
    a = rng.uniform(0.0, 0.1, (faults, n)) + 0.5 * (rng.integers(0, faults, n) == np.arange(faults)[:, None])
    b = rng.uniform(0.0, curved, (faults, n, n)) / cap.sum() + curved * np.eye(n) / cap
    return cap, a, b


@pytest.mark.parametrize("seed", range(6))
def test_constant_shares_are_a_linear_programme(seed: int) -> None:
    from scipy.optimize import linprog

    cap, a, b = random_shares(5, 3, seed, 0.0)
    programme = Programme(5, 0.8 * float(cap.sum()))
    oracle = Oracle(programme, shares(a, b), ["0", "1", "2"])
    for limit in (10.0, 30.0):
        (found,) = closed_form.search(programme, oracle, cap, limits(programme, [limit]))
        best = linprog(
            -np.ones(5),
            np.vstack([D[PERIOD] * a, np.ones(5)]),
            np.r_[np.full(3, limit), programme.budget],
            bounds=[(0, c) for c in cap],
        )
        assert found.settled
        assert passes(found)
        assert found.plan.total_mw == pytest.approx(-best.fun, rel=2e-3)
        assert found.plan.total_mw <= -best.fun + 1e-6
        assert (lost(capacities(found), a, b) <= limit + 1e-9).all()


@pytest.mark.parametrize("seed", range(4))
def test_shares_that_rise_with_the_load_reach_the_optimum_of_an_independent_solver(seed: int) -> None:
    from scipy.optimize import LinearConstraint, NonlinearConstraint, minimize

    cap, a, b = random_shares(8, 3, seed, 0.1)
    limit, programme = 40.0, Programme(8, 0.9 * float(cap.sum()))
    best = minimize(
        lambda H: -H.sum(),
        0.1 * cap,
        bounds=[(0, c) for c in cap],
        constraints=[
            NonlinearConstraint(lambda H: limit - lost(H, a, b), 0.0, np.inf),
            LinearConstraint(np.ones(8), -np.inf, programme.budget),
        ],
        method="SLSQP",
        options={"ftol": 1e-10, "maxiter": 500},
    )
    assert best.success
    oracle = Oracle(programme, shares(a, b), ["0", "1", "2"])
    (found,) = closed_form.search(programme, oracle, cap, limits(programme, [limit]))
    assert found.settled
    assert passes(found)
    assert (lost(capacities(found), a, b) <= limit).all()
    assert found.plan.total_mw == pytest.approx(-best.fun, rel=0.006)
    binding = found.binding[0]
    assert (binding.target, binding.site) == ("aggregate loss", None)
    assert binding.label == f"loss of all sites, fault {binding.fault}, peak, gfl, beta 1.2"


def test_the_frontier_rises_with_the_limit_from_nothing_to_all_that_the_network_takes() -> None:
    cap, a, b = random_shares(6, 3, 3, 0.2)
    programme = Programme(6, 0.7 * float(cap.sum()))
    oracle = Oracle(programme, shares(a, b), ["0", "1", "2"])
    mw = [0.0, 1.0, 5.0, 20.0, 40.0, 80.0, 1e4]
    found = closed_form.search(programme, oracle, cap, limits(programme, mw))
    totals = [one.plan.total_mw for one in found]
    assert totals[0] == 0.0
    assert found[0].settled
    assert set(found[0].closed) == set(programme.sites)
    assert all(low <= high for low, high in itertools.pairwise(totals))
    assert totals[1] > 0.0
    assert totals[-1] == pytest.approx(programme.budget)
    assert len(oracle.simulated) == len(set(oracle.simulated))
    assert len(oracle.replayed) == len(set(oracle.replayed))


def test_the_price_of_a_limit_is_the_slope_of_the_curve() -> None:
    """One site that loses a tenth: 1/(0.9 * 0.1) hosted MW for each MW that may be lost."""
    programme = Programme(1, 1e9)
    oracle = Oracle(programme, shares(np.array([[0.1]]), np.zeros((1, 1, 1))), ["0"])
    low, high = closed_form.search(programme, oracle, [500.0], limits(programme, [10.0, 20.0]))
    (binding,) = low.binding
    assert binding.price == pytest.approx(1 / 0.09, rel=1e-3)
    assert high.plan.total_mw - low.plan.total_mw == pytest.approx(10.0 / 0.09, rel=1e-3)
    # A larger rating saves share: dL = -H d ds, with the stand-in's derivative of 1 by beta.
    assert binding.by_beta == pytest.approx(binding.price * 0.9 * low.plan.total_mw, rel=1e-3)


def test_a_share_of_the_load_lets_mild_sites_make_up_for_severe_ones() -> None:
    """0.2 H1 + 0.05 H2 <= 0.1 (H1 + H2) gives H1 <= H2 / 2, where each by itself would close site 1."""
    programme = Programme(2, 1e9)
    oracle = Oracle(programme, shares(np.array([[0.2, 0.05]]), np.zeros((1, 2, 2))), ["0"])
    wanted = [(RUN, SystemLimit(programme.sites, D, share=share)) for share in (0.01, 0.1, 0.2)]
    none, some, every = closed_form.search(programme, oracle, [100.0, 100.0], wanted)
    assert none.plan.total_mw == 0.0
    assert some.plan.by_site == pytest.approx({1: 50.0, 2: 100.0}, rel=1e-3)
    assert every.plan.by_site == pytest.approx({1: 100.0, 2: 100.0})


def test_with_the_share_of_every_site_the_system_never_hosts_less() -> None:
    """Sites that each lose at most a share lose at most that share together; some may now lose more."""
    a, b = np.array([[0.30, 0.05], [0.02, 0.20]]), 1e-4 * np.ones((2, 2, 2))
    programme = Programme(2, 1e9)
    oracle, known = Oracle(programme, shares(a, b), ["0", "1"]), Known()
    samples = np.array([[60.0, 60.0], [1.0, 1.0]])

    def found(requirement: EverySite | SystemLimit) -> Found:
        return frontiers(
            programme, [(RUN, requirement)], [100.0, 100.0], samples, oracle.places,
            oracle.simulate, oracle.replay, Options(), known=known,
        )[0]  # fmt: skip

    each = found(EverySite(programme.sites))
    simulated = len(oracle.simulated)
    together = found(SystemLimit(programme.sites, D, share=LOSS_SHARE))
    assert each.plan.by_site[1] == 0.0
    assert together.plan.total_mw > each.plan.total_mw
    assert passes(together)
    samples_again = [H for H, _ in oracle.simulated[simulated:] if H in map(tuple, samples.tolist())]
    assert not samples_again


def voltage_not_held(H: np.ndarray, fault: str, beta: float) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Site 1 drops its servers under fault 'a' whatever is hosted; both lose 5 % of their import."""
    value = np.array([[-0.02 if fault == "a" else 0.1, 0.2], [0.1, 0.2]])
    return value, np.zeros((2, 2, 2)), ["NORMAL", "NORMAL"]


def no_result(H: np.ndarray, fault: str, beta: float) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Site 1 has no result under fault 'a'."""
    value = np.array([[np.nan if fault == "a" else 0.1, np.nan if fault == "a" else 0.2], [0.1, 0.2]])
    return value, np.zeros((2, 2, 2)), ["" if fault == "a" else "NORMAL", "NORMAL"]


@pytest.mark.parametrize(("margins", "failed"), [(voltage_not_held, np.nan), (no_result, 1.0)])
def test_a_site_may_fail_whole_within_the_limit(margins: Margins, failed: float) -> None:
    """With d = 0.9: 0.9 (H1 + 0.05 H2) <= 45 leaves 50 - 0.05 * 100 MW to the site that is lost."""
    programme = Programme(2, 1e9)
    oracle = Oracle(programme, margins, ["a", "b"], failed=failed)
    (each,) = closed_form.search(programme, oracle, [200.0, 100.0], [(RUN, EverySite(programme.sites))])
    assert each.plan.by_site[1] == 0.0
    (found,) = closed_form.search(programme, oracle, [200.0, 100.0], limits(programme, [45.0]))
    assert found.plan.by_site == pytest.approx({1: 45.0, 2: 100.0}, rel=2e-3)
    assert found.settled
    assert passes(found)


def test_a_site_that_never_ran_is_closed_under_any_limit() -> None:
    programme = Programme(2, 1e9)
    (found,) = closed_form.search(
        programme, Oracle(programme, no_result, ["a", "b"]), [200.0, 100.0], limits(programme, [1e4])
    )
    assert found.plan.by_site == pytest.approx({1: 0.0, 2: 100.0})
    assert found.closed == {1: "no margin known, bus 1, fault a, peak, gfl, beta 1.2: completed"}


def jump_at(edge: float) -> Margins:
    """Site 1 loses a tenth up to an edge and everything beyond, with no gradient that would tell."""

    def margins(H: np.ndarray, fault: str, beta: float) -> tuple[np.ndarray, np.ndarray, list[str]]:
        gone = H[0] > edge
        value = np.array([[0.1, LOSS_SHARE - (1.0 if gone else 0.1)], [0.1, LOSS_SHARE - 0.02]])
        return value, np.zeros((2, 2, 2)), ["NORMAL>BATTERY" if gone else "NORMAL", "NORMAL"]

    return margins


@pytest.mark.parametrize("first", [50.0, 100.0])
def test_at_a_jump_of_the_sequence_the_search_keeps_to_the_safe_side_and_says_so(first: float) -> None:
    """At 70 MW the loss jumps from 6 to 63 MW, beyond the limit of 36 MW. Seen from beyond the jump alone, 40
    MW at site 1 would be the most: the tangent there is not believed on this side."""
    programme = Programme(2, 1e9)
    oracle = Oracle(programme, jump_at(70.0), ["a"])
    samples = np.array([[first, 50.0], [1.0, 1.0]])
    (found,) = closed_form.search(programme, oracle, [100.0, 50.0], limits(programme, [36.0]), samples)
    assert 66.0 < found.plan.by_site[1] <= 70.0
    assert found.plan.by_site[2] == pytest.approx(50.0)
    assert passes(found)
    assert found.by_sequence == (
        "loss of all sites, fault a, peak, gfl, beta 1.2: bus 1: NORMAL becomes NORMAL>BATTERY",
    )


def test_beyond_a_jump_that_the_limit_allows_its_own_tangent_counts() -> None:
    """The jump at 10 MW stays within the limit: 0.9 (H1 + 0.02 H2) <= 36 decides."""
    programme = Programme(2, 1e9)
    oracle = Oracle(programme, jump_at(10.0), ["a"])
    (found,) = closed_form.search(programme, oracle, [100.0, 50.0], limits(programme, [36.0]))
    assert found.plan.by_site == pytest.approx({1: 39.0, 2: 50.0}, rel=2e-3)
    assert found.settled
    assert passes(found)


def test_where_the_replay_finds_more_loss_the_plan_gives_way_until_it_passes() -> None:
    """Every share is 0.01 larger in the replay: 0.9 * 0.11 H <= 9."""
    programme = Programme(1, 1e9)
    oracle = Oracle(programme, shares(np.array([[0.1]]), np.zeros((1, 1, 1))), ["0"], less=0.01)
    (found,) = closed_form.search(programme, oracle, [500.0], limits(programme, [9.0]))
    assert found.plan.total_mw == pytest.approx(9.0 / 0.099, rel=0.02)
    assert found.plan.total_mw <= 9.0 / 0.099
    assert passes(found)


def test_what_some_search_has_replayed_is_a_plan_for_every_requirement_that_it_meets() -> None:
    """Without candidates of its own a search takes the largest vector that was replayed and passes."""
    programme = Programme(1, 1e9)
    oracle, known = Oracle(programme, shares(np.array([[0.1]]), np.zeros((1, 1, 1))), ["0"]), Known()
    samples = np.array([[50.0], [1.0]])
    for limit in (18.0, 27.0):
        (found,) = frontiers(
            programme, limits(programme, [limit]), [500.0], samples, oracle.places,
            oracle.simulate, oracle.replay, Options(candidates=1), known=known,
        )  # fmt: skip
    asked = len(oracle.replayed)
    (found,) = frontiers(
        programme, limits(programme, [20.0]), [500.0], samples, oracle.places,
        oracle.simulate, oracle.replay, Options(gain=10.0), known=known,
    )  # fmt: skip
    assert found.plan.total_mw == pytest.approx(200.0, rel=1e-3)
    assert len(oracle.replayed) == asked
    assert passes(found)


def test_the_same_answer_in_whatever_order_the_questions_are_answered() -> None:
    cap, a, b = random_shares(5, 3, 8, 0.2)
    programme = Programme(5, 0.8 * float(cap.sum()))
    wanted = limits(programme, [5.0, 20.0, 40.0])
    wanted += [(("gfm", 1.2), requirement) for _, requirement in wanted]
    plans = []
    for order in (1, -1):
        oracle = Oracle(programme, shares(a, b), ["0", "1", "2"])
        for name in ("simulate", "replay"):
            straight = getattr(oracle, name)
            setattr(oracle, name, lambda q, s=straight, o=order: s(q[::o])[::o])
        found = closed_form.search(programme, oracle, cap, wanted)
        plans.append([one.plan.by_site for one in found])
    assert plans[0] == plans[1]
    assert plans[0][:3] == plans[0][3:]  # the stand-in knows no modes


def test_a_sample_that_the_network_does_not_allow_is_no_plan() -> None:
    """It was replayed and would meet the limit; its total is beyond what the programme hosts."""
    programme = Programme(2, 60.0)
    oracle = Oracle(programme, shares(np.array([[0.1, 0.1]]), np.zeros((1, 2, 2))), ["0"])
    (found,) = closed_form.search(programme, oracle, [100.0, 100.0], limits(programme, [1e4]))
    assert found.plan.total_mw == pytest.approx(60.0)
    assert found.settled


def test_nothing_hosted_is_never_excluded() -> None:
    """Shares that fall as load is added: tangents, taken at their word, would deny even an empty system."""
    programme = Programme(2, 1e9)
    b = -1e-3 * np.ones((1, 2, 2))
    oracle = Oracle(programme, shares(np.array([[0.5, 0.5]]), b), ["0"])
    found = closed_form.search(programme, oracle, [100.0, 100.0], limits(programme, [0.0, 2.0]))
    assert found[0].plan.total_mw == 0.0
    assert found[1].plan.total_mw > 0.0
    assert passes(found[1])
