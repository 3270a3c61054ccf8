"""Two classical machines against the swing equation, and what is labelled when a run does not end well."""

from __future__ import annotations

import re
from math import acos, cos, pi, sin, sqrt

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from dcvrt.grid import BusFault, FaultSequence, LineTrip
from dcvrt.grid.native.engine import Engine
from dcvrt.grid.native.point import NativePoint
from tests.grid.native.cases import TIGHT, TIGHTEST, away, engine, network, run, states, unit

OMEGA = 2 * pi * 60.0
X_D1, X_LINE, M, P = 0.3, 0.4, 7.0, 0.8


def pair(load: complex = 0j) -> Engine:
    """A machine behind two lines and a bus between on one that hardly moves; a load there takes its power."""
    net = network(
        {1: "slack", 2: "pv", 3: "pq"},
        [(1, 3, 0.1j), (3, 2, (X_LINE - 0.1) * 1j)],
        {1: 100.0, 2: 100.0 * P},
        {1: 100.0 + 100 * P, 3: load},
        {2: 1.02},
    )
    big = unit(1, M=1e5, x_d1=1e-5)
    return engine(net, [big, unit(2, M=M, x_d1=X_D1)], (3,), rule="slack")


def reference(of: Engine, point: NativePoint, fault: BusFault, t: np.ndarray) -> np.ndarray:
    """Voltages at bus 3 by the swing equations of the reduced network, integrated by SciPy."""
    net = of.network
    volts = point.v0
    s = point.steady.generation
    machines = {1: (1e5, 1e-5), 2: (M, X_D1)}
    at = np.array([net.index(b) for b in machines])
    inertia, x = (np.array([m[k] for m in machines.values()]) for k in (0, 1))
    emf = volts[at] + 1j * x * (s[at] / volts[at]).conj()
    y = net.admittance().toarray() + np.diag((net.p_load - 1j * net.q_load) / 100.0 / abs(volts) ** 2)
    y[at, at] += 1 / (1j * x)

    def bus_voltages(delta: np.ndarray, shunt: complex) -> np.ndarray:
        full = y.copy()
        full[net.index(fault.bus), net.index(fault.bus)] += shunt
        source = np.zeros(len(y), dtype=complex)
        source[at] = abs(emf) * np.exp(1j * delta) / (1j * x)
        return np.linalg.solve(full, source)

    torque = s[at].real

    def swing(shunt: complex):
        def rate(_: float, z: np.ndarray) -> np.ndarray:
            e = abs(emf) * np.exp(1j * z[:2])
            i = (e - bus_voltages(z[:2], shunt)[at]) / (1j * x)
            return np.r_[OMEGA * (z[2:] - 1), (torque - (e * i.conj()).real) / inertia]

        return rate

    z = np.r_[np.angle(emf), 1.0, 1.0]
    found = np.full(len(t), volts[net.index(3)])
    for begin, end, shunt in (
        (fault.start, fault.cleared_at, 1 / (1j * fault.x_f)), (fault.cleared_at, t[-1], 0j)
    ):  # fmt: skip
        own = (t >= begin) & (t <= end)
        solved = solve_ivp(
            swing(shunt),
            (begin, end),
            z,
            "DOP853",
            np.unique(np.r_[begin, t[own], end]),
            rtol=1e-12,
            atol=1e-13,
        )
        for k in np.flatnonzero(own & (t > begin)):
            j = int(np.argmin(abs(solved.t - t[k])))
            found[k] = bus_voltages(solved.y[:2, j], shunt)[net.index(3)]
        z = solved.y[:, -1]
    return found


@pytest.mark.parametrize("load", [0j, 40.0 + 15.0j], ids=["lossless", "with a load"])
def test_first_swings_are_those_of_the_swing_equation(load: complex) -> None:
    of, fault = pair(load), BusFault(2, 0.1, 0.15, x_f=0.05)
    t, found, point = run(of, {}, fault, 2.0, options=TIGHTEST)
    assert not found.status
    expected = reference(of, point, fault, t)
    inside = away(t, fault.start, fault.cleared_at, by=1e-9)
    assert np.abs(found.v[inside, 0] - expected[inside]).max() < 1e-9
    t, found, _ = run(of, {}, fault, 2.0, options=TIGHT)
    assert np.abs(found.v[inside, 0] - expected[inside]).max() < 1e-6


def test_small_swings_have_the_frequency_of_the_closed_form() -> None:
    of = pair()
    fault = BusFault(3, 0.1, 0.01, x_f=20.0)
    t, found, point = run(of, {}, fault, 4.0, options=TIGHTEST, step=1e-3)
    angle = np.unwrap(np.angle(found.v[:, 0]))[t > 0.2]
    s, v = point.steady.generation[1], point.v0[1]
    emf = v + 1j * X_D1 * (s / v).conj()
    slope = abs(emf) * abs(point.v0[0]) / (X_D1 + X_LINE) * cos(np.angle(emf) - np.angle(point.v0[0]))
    expected = sqrt(OMEGA * slope * (1 / M + 1 / 1e5)) / (2 * pi)
    crossed = np.flatnonzero(np.diff(np.sign(angle - 0.5 * (angle.max() + angle.min()))) > 0)
    when = t[t > 0.2]
    periods = (when[crossed[-1]] - when[crossed[0]]) / (len(crossed) - 1)
    assert len(crossed) >= 4
    assert 1 / periods == pytest.approx(expected, rel=1e-3)


def test_critical_clearing_time_is_that_of_equal_areas() -> None:
    of = pair()
    _, _, point = run(of, {}, BusFault(2), 0.3)
    s, v = point.steady.generation[1], point.v0[1]
    emf = v + 1j * X_D1 * (s / v).conj()
    delta = float(np.angle(emf) - np.angle(point.v0[0]))
    critical = acos((pi - 2 * delta) * sin(delta) - cos(delta))
    expected = sqrt(2 * M * (critical - delta) / (OMEGA * P))
    below, above = 0.9 * expected, 1.1 * expected
    for _ in range(10):
        middle = 0.5 * (below + above)
        _, found, _ = run(of, {}, BusFault(2, 0.1, middle, x_f=1e-6), 4.0)
        below, above = (below, middle) if found.status else (middle, above)
    assert below == pytest.approx(expected, rel=1e-3)


def test_loss_of_synchronism_names_the_machine() -> None:
    _, found, _ = run(pair(), {}, BusFault(2, 0.1, 0.6), 4.0)
    assert found.status.startswith("lost synchronism at t = ")
    said = re.fullmatch(r".*: machine 2 at bus 2 is (\d+) deg from the centre of inertia\.", found.status)
    assert said is not None
    assert 180 <= int(said[1]) < 200


def test_without_a_disturbance_nothing_moves() -> None:
    of = pair(40.0 + 15.0j)
    _, found, point = run(of, {}, BusFault(3, 0.1, 0.1, x_f=1e12), 2.0)
    assert np.abs(found.v[:, 0] - point.v0[2]).max() < 1e-9
    (x,) = states(point, found.end)
    assert np.abs(x - point.rest[0].x).max() < 1e-9


def test_a_line_that_opens_and_closes_again() -> None:
    net = network(
        {1: "slack", 2: "pv", 3: "pq"},
        [(1, 3, 0.1j), (3, 2, 0.5j), (3, 2, 0.5j)],
        {1: 100.0, 2: 80.0}, {1: 180.0, 3: 20.0},
    )  # fmt: skip
    of = engine(net, [unit(1, M=1e5, x_d1=1e-5), unit(2, M=M, x_d1=X_D1)], (3, 2), rule="slack")
    t, open_, _ = run(of, {}, LineTrip(3, 2, 0.2), 1.0, step=1e-3)
    t2, closed, _ = run(of, {}, LineTrip(2, 3, 0.2, reclose=0.3), 1.0, step=1e-3)
    same = (t < 0.5) & (t > 0)
    both = np.flatnonzero(same)[:-1]
    np.testing.assert_allclose(open_.v[both], closed.v[both], rtol=0, atol=1e-7)
    jump = np.flatnonzero(t2 == 0.5)
    assert abs(closed.v[jump[1], 1] - closed.v[jump[0], 1]) > 1e-3
    # a sequence is its parts one after the other
    shots = FaultSequence((LineTrip(3, 2, 0.2, reclose=0.3), BusFault(2, 0.7, 0.05)))
    _, both_, _ = run(of, {}, shots, 1.0, step=1e-3)
    early = np.flatnonzero(t2 < 0.7 - 1e-9)
    np.testing.assert_allclose(both_.v[early], closed.v[early], rtol=0, atol=1e-8)
