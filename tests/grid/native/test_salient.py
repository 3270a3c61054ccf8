"""A machine with unequal subtransient reactances: its source reads the voltage that it helps to make."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline

from dcvrt.grid import BusFault
from dcvrt.grid.native.engine import Engine
from tests.grid.native.cases import TIGHTEST, run, states
from tests.grid.native.test_sensitivities import with_limits


@pytest.mark.parametrize("x_q2", [0.25, 0.33], ids=["round", "salient"])
def test_the_machine_alone_does_the_same_at_its_terminal(x_q2: float) -> None:
    """Its states, integrated by SciPy on the terminal voltage; its current against the balance of its bus."""
    made = with_limits(50.0, x_q2)
    of = Engine(made.network, made.units, (1, 2, 3), 1.0 + 0j)
    fault = BusFault(3, 0.1, 0.12, x_f=0.05)
    t, found, point = run(of, {3: 20.0}, fault, 0.6, options=TIGHTEST, step=5e-4)
    assert found.events == ()
    net, y = of.network, of.network.admittance().toarray()
    assert abs(y - y.T).max() > 0.1  # the transformer of this case shifts the phase
    injected = found.v @ y.T
    number = next(k for k, g in enumerate(of.system.groups) if g.units[0].bus == 2)
    group, rest = of.system.groups[number], point.rest[number]
    dae, s = group.structure.dae, group.structure
    assert s.affine == (x_q2 == 0.25)
    flags = np.array(s.flags).ravel()
    model = ca.Function("unit", [dae.x, dae.u, dae.p, dae.q], [dae.f, dae.y])
    p = rest.p[0, : dae.p.numel()]
    x, outputs = rest.x[0], [dae.y_names.index(n) for n in ("i.re", "i.im")]
    at = net.index(2)
    for begin, end in ((0.1, 0.22), (0.22, 0.6)):
        own = np.flatnonzero((t >= begin) & (t <= end))
        own = own[(own > 0) & ((t[own] > begin) | (t[np.maximum(own - 1, 0)] == begin))]
        own = own[: np.flatnonzero(t[own] == end)[0] + 1]
        assert (np.diff(t[own]) > 0).all()
        v = CubicSpline(t[own], found.v[own, at])

        def rate(now: float, x: np.ndarray, v: CubicSpline = v) -> np.ndarray:
            volts = complex(v(now))
            return np.array(model(x, [volts.real, volts.imag], p, flags)[0]).ravel()

        solved = solve_ivp(rate, (begin, end), x, "LSODA", t[own], rtol=1e-10, atol=1e-12)
        current = [
            np.array(model(solved.y[:, k], [found.v[j, at].real, found.v[j, at].imag], p, flags)[1]).ravel()
            for k, j in enumerate(own)
        ]
        i = np.array(current)[:, outputs] @ [1, 1j]
        assert np.abs(i - injected[own, at]).max() < 1e-7
        x = solved.y[:, -1]
    last = states(point, found.end)[number][0]
    np.testing.assert_allclose(x, last, rtol=0, atol=1e-7)
