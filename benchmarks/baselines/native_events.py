"""CasADi's own event handling on what every fault does to a facility: does it fire at all?

Small systems in which a guard must fire once. In one an input jumps over the guard, as the voltage does at a
fault. In another the guard is already true when a mode is entered, as "voltage healthy" is when a battery
mode begins after the fault has cleared. CasADi's `zero` (a guard with its sign turned: it fires when it falls
through 0) watches for a change of sign along the solution; neither is one. The control, a guard that a state
crosses, fires. A run that loses an event without a word cannot be compared by its time, so these integrators
stand in the table as n/a with what they missed.
"""

from __future__ import annotations

import casadi as ca

from benchmarks.harness import Result, result

PLUGINS = ("erk", "rosenbrock", "cvodes")


def evidence() -> list[Result]:
    """One row a plugin and system: how many events fired; one must."""
    rows = []
    for plugin in PLUGINS:
        modes = _entry(plugin)
        for what, fired in (
            ("a state crosses a guard (control)", min(modes, 1)),
            ("a guard is true on entry", max(modes - 1, 0)),
            ("an input jumps over a guard", _jump(plugin)),
        ):
            verdict = "fires" if fired else "n/a: misses events"
            rows.append(
                result(
                    "small systems, 1 event", f"fired: {what}", float(fired), "events",
                    f"CasADi {plugin}, native events ({verdict})",
                )
            )  # fmt: skip
    return rows


def _jump(plugin: str) -> int:
    """u steps from 1 to 0.5 at t = 0.5; the guard 0.9 - u must set the mode m from 0 to 1."""
    x, m, u = ca.SX.sym("x"), ca.SX.sym("m"), ca.SX.sym("u")
    dae = {
        "x": ca.vertcat(x, m),
        "u": u,
        "ode": ca.vertcat(u - x, 0),
        "zero": ca.if_else(m < 0.5, u - 0.9, 1),
    }
    return _modes(plugin, dae, x, m, [1.0, 0.5], 1.0)


def _entry(plugin: str) -> int:
    """x falls through 0.5 and enters mode 1; there 0.9 - x is positive and must lead to mode 2."""
    x, m = ca.SX.sym("x"), ca.SX.sym("m")
    zero = ca.if_else(m < 0.5, x - 0.5, ca.if_else(m < 1.5, x - 0.9, 1))
    dae = {"x": ca.vertcat(x, m), "ode": ca.vertcat(-x, 0), "zero": zero}
    return _modes(plugin, dae, x, m, None, 2.0)


def _modes(
    plugin: str, dae: dict[str, ca.SX], x: ca.SX, m: ca.SX, inputs: list[float] | None, until: float
) -> int:
    """The mode at the end: how many events fired."""
    index, t, u = (ca.SX.sym(n) for n in ("index", "t", "u"))
    state = ca.SX.sym("state", 2)
    after = ca.Function(
        "after", {"index": index, "t": t, "x": state, "u": u, "post_x": state + ca.vertcat(0, 1)},
        ["index", "t", "x", "z", "p", "u"], ["post_x", "post_z"],
    )  # fmt: skip
    points = 64
    grid = [until * (k + 1) / points for k in range(points)]
    integrator = ca.integrator("native", plugin, dae, 0.0, grid, {"transition": after})
    arguments = {"x0": ca.DM([1.0, 0.0])}
    if inputs is not None:
        arguments["u"] = ca.horzcat(*[inputs[0]] * (points // 2), *[inputs[1]] * (points // 2))
    return round(float(integrator(**arguments)["xf"][1, -1]))
