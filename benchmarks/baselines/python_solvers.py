"""SciPy's and scikit-SUNDAE's solvers on the compiled right-hand side and its compiled Jacobian."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from benchmarks._case import POINTS, Case
from benchmarks.baselines import CannotRun, NotInstalled, Solver
from dcvrt.integrators.casadi import bind
from dcvrt.integrators.compiler import compiled

Array = NDArray[np.float64]
Call = Callable[[], None]


class RightHandSide:
    """f and df/dx of one stretch at a time as calls on arrays in place."""

    def __init__(self, case: Case) -> None:
        rhs = case.equations.functions[0]
        self.n = case.X0.size
        tau, x, P, group = (ca.SX.sym(m, rhs.numel_in(k)) for m, k in zip("txPg", (0, 1, 3, 4), strict=True))
        ode, _ = rhs(tau, x, ca.SX(0, 1), P, group)
        names = (["t", "x", "P", "g"], ["out"])
        f = ca.Function("f", [tau, x, P, group], [ode], *names)
        jacobian = ca.densify(ca.jacobian(ode, x))
        functions, _ = compiled([f, ca.Function("jacobian_x", [tau, x, P, group], [jacobian], *names)])
        self.t, self.x = np.zeros(1), np.zeros(self.n)
        self.P, self.group = np.zeros(rhs.numel_in("p")), np.zeros(rhs.numel_in("u"))
        self.f, self.jacobian = np.zeros(self.n), np.zeros((self.n, self.n))
        arguments = {"t": self.t, "x": self.x, "P": self.P, "g": self.group}
        self._keep, self.call_f = bind(functions["f"], arguments, {"out": self.f})
        self._keep_too, self.call_jacobian = bind(functions["jacobian_x"], arguments, {"out": self.jacobian})

    def at(self, t: float, x: Array) -> Array:
        self.t[0] = t
        self.x[:] = x
        self.call_f()
        return self.f

    def jacobian_at(self, t: float, x: Array) -> Array:
        self.t[0] = t
        self.x[:] = x
        self.call_jacobian()
        return self.jacobian.T


def _solver(case: Case, rhs: RightHandSide, stretch: Callable[[Array, int], Array]) -> Solver:
    """Go through the stretches; ``stretch(x0, points)`` integrates over normalised time 0 to 1."""

    def over(points: int) -> Array:
        kept = np.zeros((len(case.P), points, rhs.n))
        x = case.X0
        for k in range(len(case.P)):
            rhs.P[:], rhs.group[:] = case.P[k], case.group[k]
            kept[k] = stretch(x + case.jump[k], points)
            x = kept[k, -1]
        return kept

    return Solver(lambda: over(1), lambda: over(POINTS))


def scipy(case: Case, method: str) -> Callable[[float], Solver]:
    """``solve_ivp`` with one of its methods."""
    from scipy.integrate import solve_ivp

    rhs = RightHandSide(case)
    more: dict[str, Any] = {"jac": rhs.jacobian_at} if method in ("Radau", "BDF", "LSODA") else {}

    def make(rtol: float) -> Solver:
        def stretch(x: Array, points: int) -> Array:
            at = np.arange(1, points + 1) / points
            done = solve_ivp(
                lambda t, x: rhs.at(t, x).copy(),
                (0.0, 1.0),
                x,
                method,
                at,
                rtol=rtol,
                atol=rtol * 1e-2,
                **more,
            )
            if not done.success:
                raise CannotRun(str(done.message))
            return done.y.T

        return _solver(case, rhs, stretch)

    return make


def sundae(case: Case, method: str) -> Callable[[float], Solver]:
    """scikit-SUNDAE: ``cvode`` (BDF) or ``ida``, with the compiled Jacobian."""
    try:
        from sksundae import cvode, ida
    except ModuleNotFoundError:
        raise NotInstalled("scikit-sundae is not installed: pip install 'dcvrt[bench]'") from None

    rhs = RightHandSide(case)

    def f(t: float, y: Array, yp: Array) -> None:
        yp[:] = rhs.at(t, y)

    def residual(t: float, y: Array, yp: Array, res: Array) -> None:
        res[:] = yp - rhs.at(t, y)

    def jacobian(t: float, y: Array, yp: Array, J: Array) -> None:
        J[:] = rhs.jacobian_at(t, y)

    def residual_jacobian(t: float, y: Array, yp: Array, res: Array, cj: float, J: Array) -> None:
        J[:] = cj * np.eye(rhs.n) - rhs.jacobian_at(t, y)

    def make(rtol: float) -> Solver:
        shared: dict[str, Any] = {"rtol": rtol, "atol": rtol * 1e-2, "max_num_steps": 200_000}
        if method == "cvode":
            solver: Any = cvode.CVODE(f, method="BDF", jacfn=jacobian, **shared)
        else:
            solver = ida.IDA(residual, jacfn=residual_jacobian, **shared)

        def stretch(x: Array, points: int) -> Array:
            at = np.linspace(0.0, 1.0, points + 1)
            # two times mean 'every step' to this package: a third makes them output times
            span = at if points > 1 else np.array([0.0, 0.5, 1.0])
            done = (
                solver.solve(span, x) if method == "cvode" else solver.solve(span, x, rhs.at(0.0, x).copy())
            )
            if not done.success:
                raise CannotRun(str(done.message))
            return done.y[1:] if points > 1 else done.y[-1:]

        return _solver(case, rhs, stretch)

    return make
