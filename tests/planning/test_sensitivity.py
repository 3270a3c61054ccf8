"""Sensitivities to assumptions: margins by differences, prices against a programme that is solved again."""

from __future__ import annotations

import numpy as np
import pytest

from dcvrt import facility
from dcvrt.criteria import Criteria
from dcvrt.grid.network import Network
from dcvrt.integrators import Kernel, Simulator
from dcvrt.planning import HostingProblem, profiles
from dcvrt.planning.design import Exposure
from dcvrt.planning.exact import Exact
from dcvrt.planning.plan import Row
from dcvrt.planning.sensitivity import (
    CRITERIA,
    Priced,
    assumptions,
    first_order,
    illustrative,
    margin_gradient,
    resolved,
)
from dcvrt.waveform import Waveform

SITES = (21, 75)
STUDIED = {
    "criteria.v_it_min_pu": 0.9,
    "criteria.window_ms": 20.0,
    "criteria.loss_share": 0.25,
    "criteria.loss_window_ms": 40.0,
}


@pytest.mark.parametrize(
    ("variant", "target", "paths"),
    [
        ("gfl", "loss", ("lag.tau", "pll.K_p")),
        ("gfm", "loss", ("lag.tau", "dc.T_hold", "bess.K_b", "vsm.D", "vsm.X_v", "sup.V_dip")),
        ("gfm", "voltage", ("dc.T_hold", "bess.T_b", "bus.k_line")),
    ],
)
def test_margins_move_with_assumptions_as_their_gradients_say(
    variant: str, target: str, paths: tuple[str, ...]
) -> None:
    """Against central differences of runs two decades tighter, an event being gained or lost in none."""
    wave = Waveform.segments([(0.0, 1.0), (0.1, 0.62), (0.15, 0.65), (0.2, 0.96)], until=0.8)
    exposure, criteria = Exposure("peak", "a fault", wave, 0.95), Criteria(window=0.02)
    values = {"beta": 1.2, "pf": 0.98}
    gradient = margin_gradient(variant, [*paths, *CRITERIA], exposure, target, criteria, values)
    dae = facility.get(variant).compile()
    tight = Simulator(dae, Kernel(rtol=1e-10, atol=1e-12))

    def margin(criteria: Criteria, **changed: float) -> float:
        table = {**values, "H": 1.0, "d": 0.95, **changed}
        (found,) = tight.batch([wave], table, criteria=criteria).margins
        return float(getattr(found, target).value)

    for path in paths:
        value = next(row.value for row in dae.parameters if row.path == path)
        step = 2e-3 * value
        ends = [margin(criteria, **{path: value + sign * step}) for sign in (-1, 1)]
        assert gradient[path] == pytest.approx((ends[1] - ends[0]) / (2 * step), rel=5e-3, abs=1e-6), path
    for path, (_, field, scale, _) in CRITERIA.items():
        value = getattr(criteria, field)
        ends = [margin(Criteria(**{"window": 0.02, field: (1 + sign * 2e-3) * value})) for sign in (-1, 1)]
        slope = scale * (ends[1] - ends[0]) / (4e-3 * value)
        assert gradient[path] == pytest.approx(slope, rel=2e-2, abs=2e-6), path


def test_every_assumption_that_is_marked_is_among_them() -> None:
    table = facility.gfm().compile().parameters
    ranges = {"vsm.X_v": (0.1, 0.4), "dc.T_hold": (0.02, 0.04), "criteria.loss_share": (0.2, 0.3)}
    found = {a.path: a for a in assumptions(table, STUDIED, 0.2, ranges, ("H", "beta", "d", "pf"))}
    marked = {row.path for row in table if illustrative(row.source)} - {"H", "beta", "d", "pf"}
    assert set(found) == marked | {"vsm.X_v"} | set(STUDIED)
    assert not {"lim.eps", "vsm.f_B"} & set(found)
    ends = {path: (a.low, a.high) for path, a in found.items()}
    assert ends["vsm.X_v"] == (0.1, 0.4)
    assert ends["dc.T_hold"] == (0.02, 0.04)
    assert ends["criteria.loss_share"] == (0.2, 0.3)
    assert ends["bess.T_b"] == pytest.approx((0.008, 0.012))
    assert ends["sup.V_dip"] == pytest.approx((0.72, 1.0)), "kept within the bounds"


# -- against the hosting programme ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def problem() -> HostingProblem:
    hours = profiles.ieee118().window(range(4000, 4024))
    return HostingProblem(Network.ieee118(), SITES, hours, rating_scale=0.6, voltage=(0.94, 1.06), pf=0.98)


def tangents(at: np.ndarray, value: list[float], slope: list[list[float]]) -> list[Exact]:
    """Loss margins of the two sites under one fault, and voltage margins that do not bind."""
    n = len(SITES)
    values = np.column_stack([np.full(n, 0.1), value])
    slopes = np.zeros((n, 2, n))
    slopes[:, 1] = slope
    none = np.zeros((n, n))
    lost = 0.25 - np.asarray(value)
    come = (("NORMAL",) * n, ("completed",) * n)
    return [Exact(at, ("peak", "f"), values, slopes, none, lost, none, *come)]


def test_prices_times_derivatives_are_what_a_programme_solved_again_gains(problem: HostingProblem) -> None:
    """Two margins hold the plan; an assumption moves one by c and relaxes or tightens the other."""
    slope = [[-6e-4, -1e-4], [-5e-5, -4e-4]]
    intercept = [0.03, 0.05]
    rows = [
        Row(dict(zip(SITES, a, strict=True)), -b, f"loss {bus}", site=bus)
        for a, b, bus in zip(slope, intercept, SITES, strict=True)
    ]
    plan = problem.solve(rows=rows)
    H = np.array([plan.by_site[bus] for bus in SITES])
    assert np.all(np.array(slope) @ H + intercept == pytest.approx(0.0, abs=1e-9)), "both bind"
    price = {b.label: b.price for b in plan.binding}
    wave = Waveform.sag(retained=0.7, start=0.1, length=0.1, until=0.6)
    binding = [Priced(bus, "loss", price[f"loss {bus}"], Exposure("peak", "f", wave, 1.0)) for bus in SITES]
    gradients = [{"a": 0.02}, {"a": -0.05}]
    by_unit = first_order(binding, gradients, "a")
    keys = [("peak", "f", site, 1) for site in range(2)]
    known = tangents(H, [0.0, 0.0], slope)

    def total(change: float) -> float:
        shifts = {key: g["a"] * change for key, g in zip(keys, gradients, strict=True)}
        return resolved(problem, H, known, keys, shifts, problem.upper)

    assert total(0.0) == pytest.approx(plan.total_mw, abs=1e-4)
    for change in (0.02, -0.02):
        shifted = [
            Row(row.coefficients, row.lower - g["a"] * change, row.label, site=row.site)
            for row, g in zip(rows, gradients, strict=True)
        ]
        again = problem.solve(rows=shifted).total_mw
        assert total(change) == pytest.approx(again, abs=1e-4)
        assert by_unit * change == pytest.approx(again - plan.total_mw, rel=1e-3)


def test_what_the_network_does_not_allow_and_what_closes_is_no_first_order_effect(
    problem: HostingProblem,
) -> None:
    """One margin holds site 21: far relaxed, the network holds it; far tightened, the site closes."""
    free = problem.solve()
    slope = [[-6e-4, 0.0], [0.0, -1e-9]]
    rows = [Row({21: -6e-4, 75: 0.0}, -0.012, "loss 21", site=21)]
    plan = problem.solve(rows=rows)
    H = np.array([plan.by_site[bus] for bus in SITES])
    assert H[0] == pytest.approx(20.0)
    keys = [("peak", "f", 0, 1)]
    known = tangents(H, [0.0, 0.5], slope)
    relaxed, tightened = (
        resolved(problem, H, known, keys, {keys[0]: shift}, problem.upper) for shift in (0.5, -0.5)
    )
    assert relaxed == pytest.approx(free.total_mw, abs=1e-4)
    assert tightened == pytest.approx(problem.solve(bounds={21: (0.0, 0.0)}).total_mw, abs=1e-4)


def test_a_site_that_the_plan_closes_stays_closed(problem: HostingProblem) -> None:
    H = np.array([0.0, 100.0])
    known = tangents(H, [-0.1, 0.0], [[0.0, 0.0], [0.0, -1e-3]])
    key = ("peak", "f", 1, 1)
    assert resolved(problem, H, known, [key], {key: 0.01}, problem.upper) == pytest.approx(110.0, abs=1e-4)
