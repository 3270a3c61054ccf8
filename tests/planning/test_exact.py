"""Total gradients of margins: through power flow, machines, fault and clearing, against simulating again."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from dcvrt.planning import replay
from dcvrt.planning.exact import exact_of
from dcvrt.planning.replay import check_hosting

SITES = (21, 75, 106, 108)
H = np.array([20.0, 120.0, 60.0, 70.0])
RUNS = [["gfl", 1.15], ["gfm", 1.2]]
FAULTS = (25, 80, 107)
NOISE = 2e-8
"""Error of a margin by the integrators' tolerances, pu or share: two of them over a step are a difference's
own."""


def request(hosting: np.ndarray, runs: list = RUNS, gradients: bool = True, **changes: object) -> dict:
    return {
        "case": "ieee118",
        "dynamics": None,
        "sites": list(SITES),
        "pf": 0.98,
        "redispatch": "proportional",
        "reactive_limits": True,
        "step_s": 1 / 120,
        "t_end_s": 1.2,
        "engine": "native",
        "gradients": gradients,
        "hosting": hosting.tolist(),
        "period": {"name": "peak", "hour": 1, "load_scale": 0.98, "wind": {"69": 4.0}, "dc_factor": 0.95},
        "faults": [{"bus": bus, "t_start_s": 0.2, "t_clear_ms": 100.0, "x_pu": 1e-4} for bus in FAULTS],
        "runs": runs,
        "parameters": {},
        "criteria": {},
        "keep": False,
        **changes,
    }


@pytest.fixture(scope="module", autouse=True)
def tight() -> Iterator[None]:
    """Facility runs to 1e-8: a difference of margins has to be better than what is claimed of the
    gradient."""
    from dcvrt.integrators import Kernel, simulator

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(simulator, "default_solver", lambda dae: Kernel(rtol=1e-8, atol=1e-10))
        replay._simulator.cache_clear()
        yield
        replay._simulator.cache_clear()


@pytest.fixture(scope="module")
def exact(tight: None) -> dict:
    return exact_of(check_hosting(request(H))["rows"], SITES, H)


def test_total_gradients_are_differences_of_simulated_margins(exact: dict) -> None:
    """By every H_j, at all sites, faults, both targets and both modes, where the sequence stays the same."""
    step, seen = 0.5, 0
    for j in range(len(SITES)):
        ends = []
        for sign in (1.0, -1.0):
            moved = H + sign * step * np.eye(len(SITES))[j]
            ends.append(exact_of(check_hosting(request(moved))["rows"], SITES, moved))
        for run, points in exact.items():
            for k, one in enumerate(points):
                plus, minus = ends[0][run][k], ends[1][run][k]
                assert plus.place == minus.place == one.place
                for i in range(len(SITES)):
                    if not plus.sequence[i] == minus.sequence[i] == one.sequence[i]:
                        continue
                    difference = (plus.value[i] - minus.value[i]) / (2 * step)
                    largest = abs(one.slope[i]).max(axis=1)
                    # A kink between the two (the active window moves) shows as unequal one-sided differences.
                    bend = abs(plus.value[i] + minus.value[i] - 2 * one.value[i]) / step
                    for t in range(2):
                        if largest[t] < 1e-5 or bend[t] > 0.02 * largest[t]:
                            continue
                        seen += 1
                        allowed = 1e-4 * largest[t] + NOISE / step
                        assert difference[t] == pytest.approx(one.slope[i, t, j], abs=allowed), (
                            run,
                            one.place,
                            SITES[i],
                            t,
                        )
    assert seen > 40


def test_gradient_by_the_rating_is_a_difference(exact: dict) -> None:
    step, seen = 1e-4, 0
    ends = [
        exact_of(check_hosting(request(H, [[m, b + s * step] for m, b in RUNS], False))["rows"], SITES, H)
        for s in (1, -1)
    ]
    for (mode, beta), points in exact.items():
        for k, one in enumerate(points):
            plus, minus = (end[mode, beta + s * step][k] for end, s in zip(ends, (1, -1), strict=True))
            bend = abs(plus.value + minus.value - 2 * one.value) / step
            difference = (plus.value - minus.value) / (2 * step)
            clear = (abs(one.by_beta) > 1e-2) & (bend < 1e-3)
            seen += int(clear.sum())
            np.testing.assert_allclose(difference[clear], one.by_beta[clear], rtol=1e-3)
    assert seen >= 4


def test_size_acts_through_the_voltage_alone() -> None:
    """A facility on its own base has the margins of one of any size, so that no term is missing."""
    from dcvrt import Criteria, Simulator, Waveform, facility

    sag = Waveform.sag(retained=0.7, start=0.1, length=0.1, until=0.8)
    for mode in ("gfl", "gfm"):
        found = (
            Simulator(facility.get(mode).compile(), wrt=("H",))
            .batch([sag], {"H": [1.0], "beta": 1.15}, criteria=Criteria())
            .margins[0]
        )
        assert abs(found.voltage.grad["H"]) < 1e-6
        assert abs(found.loss.grad["H"]) < 1e-6


def test_without_gradients_there_are_none_and_the_values_are_the_same(exact: dict) -> None:
    plain = exact_of(check_hosting(request(H, gradients=False))["rows"], SITES, H)
    for run, points in exact.items():
        for with_, without in zip(points, plain[run], strict=True):
            np.testing.assert_allclose(with_.value, without.value, atol=2e-5)
            assert with_.sequence == without.sequence
            assert np.isnan(without.slope).all()


def test_a_failed_run_has_no_numbers() -> None:
    found = exact_of(check_hosting(request(H, [["gfl", 0.9]]))["rows"], SITES, H)
    for one in found["gfl", 0.9]:
        assert np.isnan(one.value).all()
        assert np.isnan(one.slope).all()
        assert all("equilibrium" in status for status in one.status)
