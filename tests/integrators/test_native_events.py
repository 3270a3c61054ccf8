"""Sensitivities across events beside those of CasADi's own event handling, where that fires every event."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from dcvrt.integrators import Casadi, Kernel, Simulator, find_compiler
from tests.integrators.systems import Sketch, ball, flat, go

pytestmark = [
    pytest.mark.skipif(find_compiler() is None, reason="no C compiler"),
    pytest.mark.filterwarnings("ignore::UserWarning"),
]
UNTIL = 2.0
GRID = np.linspace(0.0, UNTIL, 201)[1:].tolist()
"""CasADi finds an event to the accuracy that its output grid allows."""


def native(
    plugin: str, dae: dict[str, ca.SX], post_x: ca.SX, start: list[float], values: list[float]
) -> ca.DM:
    """Final states beside their derivatives by the parameters, by CasADi's event handling."""
    index, t, u = (ca.SX.sym(n) for n in ("index", "t", "u"))
    after = ca.Function(
        "after",
        {"index": index, "t": t, "x": dae["x"], "p": dae["p"], "u": u, "post_x": post_x},
        ["index", "t", "x", "z", "p", "u"], ["post_x", "post_z"],
    )  # fmt: skip
    options = {"transition": after, "reltol": 1e-10, "abstol": 1e-12}
    integrator = ca.integrator("native", plugin, dae, 0.0, GRID, options)
    p = ca.MX.sym("p", len(values))
    end = integrator(x0=ca.DM(start), p=p)["xf"][:, -1]
    return ca.Function("end", [p], [ca.horzcat(end, ca.jacobian(end, p))])(ca.DM(values))


SOLVERS = [Kernel("dp5", 1e-10, 1e-12), Kernel("rosenbrock", 1e-10, 1e-12), Casadi("erk", 1e-10, 1e-12)]


@pytest.mark.parametrize("solver", SOLVERS, ids=["dp5", "rosenbrock", "casadi"])
@pytest.mark.parametrize("plugin", ["erk", "rosenbrock", "cvodes"])
def test_bouncing_ball(plugin: str, solver: Kernel | Casadi) -> None:
    h, w, g, e = (ca.SX.sym(n) for n in ("h", "w", "g", "e"))
    dae = {"x": ca.vertcat(h, w), "p": ca.vertcat(g, e), "ode": ca.vertcat(w, -g), "zero": h}
    theirs = np.array(native(plugin, dae, ca.vertcat(h, -e * w), [1.0, 0.0], [9.81, 0.8]))
    ours = Simulator(ball(), solver, wrt=("g", "e"), start="given")(flat(UNTIL))
    assert len(ours.events) == 3
    assert ours.states.value[-1] == pytest.approx(theirs[:, 0], rel=1e-5)
    assert ours.states.sens is not None
    assert ours.states.sens[-1] == pytest.approx(theirs[:, 1:], rel=1e-5)


@pytest.mark.parametrize("solver", SOLVERS, ids=["dp5", "rosenbrock", "casadi"])
def test_a_nonlinear_relay(solver: Kernel | Casadi) -> None:
    """x' = r - x^3 rises to `high`, x' = -k x^2 falls to `low`: both thresholds are thetas."""
    x, m = ca.SX.sym("x"), ca.SX.sym("m")
    r, k, low, high = (ca.SX.sym(n) for n in ("r", "k", "low", "high"))
    dae = {
        "x": ca.vertcat(x, m), "p": ca.vertcat(r, k, low, high),
        "ode": ca.vertcat(ca.if_else(m < 0.5, r - x**3, -k * x**2), 0),
        "zero": ca.if_else(m < 0.5, high - x, x - low),
    }  # fmt: skip
    values = {"r": 2.0, "k": 3.0, "low": 0.5, "high": 0.9}
    theirs = np.array(native("erk", dae, ca.vertcat(x, 1 - m), [0.6, 0.0], list(values.values())))[0]
    s = Sketch({"x": 0.6}, values)
    q, _, rows = s.automaton("relay", {"up": (1.0, 0.0), "down": (0.0, 1.0)}, "up")
    rows += [go("up", "down", s.x["x"] - s.p["high"]), go("down", "up", s.p["low"] - s.x["x"])]
    rate = q[0] * (s.p["r"] - s.x["x"] ** 3) - q[1] * s.p["k"] * s.x["x"] ** 2
    ours = Simulator(s.dae({"x": rate}, {"x_out": s.x["x"]}), solver, wrt=tuple(values), start="given")(
        flat(UNTIL)
    )
    assert len(ours.events) >= 6
    assert ours["x_out"][-1] == pytest.approx(theirs[0], rel=1e-5)
    found = [ours.sens["x_out", n][-1] for n in values]
    assert found == pytest.approx(theirs[1:], rel=1e-4)
