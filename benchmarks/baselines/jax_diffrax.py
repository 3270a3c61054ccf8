"""diffrax: the whole run as one compiled scan over its stretches.

The right-hand side is translated from CasADi's expression graph, instruction by instruction. Forward
sensitivities are `jax.jvp` through the solver in all directions at once.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from benchmarks._case import POINTS, Case
from benchmarks.baselines import CannotRun, NotInstalled, Solver
from dcvrt.integrators.equations import Equations

Array = NDArray[np.float64]
MAX_STEPS = 16_384

UNARY = {
    ca.OP_ASSIGN: "{0}", ca.OP_NEG: "-{0}", ca.OP_EXP: "jnp.exp({0})", ca.OP_LOG: "jnp.log({0})",
    ca.OP_SQRT: "jnp.sqrt({0})", ca.OP_SQ: "{0} * {0}", ca.OP_TWICE: "2.0 * {0}", ca.OP_SIN: "jnp.sin({0})",
    ca.OP_COS: "jnp.cos({0})", ca.OP_TAN: "jnp.tan({0})", ca.OP_FABS: "jnp.abs({0})", ca.OP_INV: "1.0 / {0}",
    ca.OP_SIGN: "jnp.sign({0})", ca.OP_TANH: "jnp.tanh({0})", ca.OP_FLOOR: "jnp.floor({0})",
    ca.OP_NOT: "jnp.where({0} == 0, 1.0, 0.0)",
}  # fmt: skip
BINARY = {
    ca.OP_ADD: "{0} + {1}", ca.OP_SUB: "{0} - {1}", ca.OP_MUL: "{0} * {1}", ca.OP_DIV: "{0} / {1}",
    ca.OP_POW: "{0} ** {1}", ca.OP_CONSTPOW: "{0} ** {1}", ca.OP_FMIN: "jnp.minimum({0}, {1})",
    ca.OP_FMAX: "jnp.maximum({0}, {1})", ca.OP_ATAN2: "jnp.arctan2({0}, {1})",
    ca.OP_HYPOT: "jnp.sqrt({0} * {0} + {1} * {1})", ca.OP_LT: "jnp.where({0} < {1}, 1.0, 0.0)",
    ca.OP_LE: "jnp.where({0} <= {1}, 1.0, 0.0)", ca.OP_IF_ELSE_ZERO: "jnp.where({0} != 0, {1}, 0.0)",
}  # fmt: skip


def translate(function: ca.Function) -> Callable[..., Any]:
    """A jax function of the same arguments, each a vector; its one result is a vector."""
    import jax.numpy as jnp

    names = [f"a{k}" for k in range(function.n_in())]
    lines = [f"def f({', '.join(names)}):"]
    results: dict[int, str] = {}
    for k in range(function.n_instructions()):
        op, at, out = (
            function.instruction_id(k),
            function.instruction_input(k),
            function.instruction_output(k),
        )
        if op == ca.OP_INPUT:
            lines.append(f"    w{out[0]} = a{at[0]}[{at[1]}]")
        elif op == ca.OP_OUTPUT:
            lines.append(f"    r{out[1]} = w{at[0]}")
            results[out[1]] = f"r{out[1]}"
        elif op == ca.OP_CONST:
            lines.append(f"    w{out[0]} = {function.instruction_constant(k)!r}")
        elif op in UNARY or op in BINARY:
            form = UNARY.get(op) or BINARY[op]
            lines.append(f"    w{out[0]} = {form.format(*(f'w{i}' for i in at))}")
        else:
            raise NotImplementedError(f"no translation of CasADi operation {op} to jax")
    entries = ", ".join(results.get(k, "0.0") for k in range(function.nnz_out(0)))
    lines.append(f"    return jnp.stack([jnp.asarray(x, dtype=jnp.float64) for x in ({entries},)])")
    space: dict[str, Any] = {"jnp": jnp}
    exec("\n".join(lines), space)
    return space["f"]


class Diffrax:
    """One case for one of diffrax's solvers; `compile_seconds` is the first call less the second.

    `augmented` carries sensitivities within the equations, and so in the error norm, in place of
    differentiating the solver.
    """

    def __init__(self, case: Case, solver: str, augmented: bool = False) -> None:
        try:
            import diffrax
            import jax
        except ModuleNotFoundError:
            raise NotInstalled("diffrax is not installed: pip install 'dcvrt[bench]'") from None
        jax.config.update("jax_enable_x64", True)
        self.jax, self.diffrax, self.case, self.name = jax, diffrax, case, solver
        self.compile_seconds = 0.0
        equations = case.equations if augmented else Equations(case.dae, (), False)
        rhs = equations.functions[0]
        tau, x, P, group = (ca.SX.sym(m, rhs.numel_in(k)) for m, k in zip("txPg", (0, 1, 3, 4), strict=True))
        ode, _ = rhs(tau, x, ca.SX(0, 1), P, group)
        self.n, self.n_P = x.numel(), P.numel()
        self.nw = 0 if augmented else case.equations.nw
        self.f = translate(ca.Function("f", [tau, x, ca.vertcat(P, group)], [ode]))
        self.nominal = jax.numpy.asarray(np.hstack((case.P[:, : self.n_P], case.group)))

    def _stretch(self, points: int, rtol: Any) -> Callable[[Any, Any], Any]:
        diffrax, jnp = self.diffrax, self.jax.numpy
        term = diffrax.ODETerm(lambda t, y, p: self.f(jnp.asarray([t]), y, p))
        method = getattr(diffrax, self.name)()
        at = jnp.arange(1, points + 1) / points
        save = diffrax.SaveAt(t1=True) if points == 1 else diffrax.SaveAt(ts=at)
        adjoint = diffrax.ForwardMode() if self.nw else diffrax.RecursiveCheckpointAdjoint()

        def stretch(x: Any, p: Any) -> Any:
            control = diffrax.PIDController(rtol=rtol, atol=rtol * 1e-2, pcoeff=0.3, icoeff=0.4)
            done = diffrax.diffeqsolve(
                term, method, 0.0, 1.0, None, x, p, stepsize_controller=control, saveat=save,
                max_steps=MAX_STEPS, adjoint=adjoint,
            )  # fmt: skip
            return done.ys

        return stretch

    def _whole(self, points: int) -> Callable[..., Any]:
        jax, jnp, n, nw = self.jax, self.jax.numpy, self.n, self.nw

        def whole(rtol: Any, X0: Any, nominal: Any, seeds: Any, jump: Any) -> Any:
            stretch = self._stretch(points, rtol)

            def plain(x: Any, given: Any) -> Any:
                p, _, change = given
                ys = stretch(x + change, p)
                return ys[-1], ys

            def with_sensitivities(X: Any, given: Any) -> Any:
                p, dp, change = given
                X = X + change
                x, S = X[:n], X[n:].reshape(nw, n)
                ys = stretch(x, p)
                pushed = jax.vmap(lambda s, d: jax.jvp(stretch, (x, p), (s, d))[1])(S, dp)
                columns = jnp.concatenate([ys[:, None, :], jnp.swapaxes(pushed, 0, 1)], axis=1)
                flat = columns.reshape(points, -1)
                return flat[-1], flat

            return jax.lax.scan(with_sensitivities if nw else plain, X0, (nominal, seeds, jump))[1]

        return jax.jit(whole)

    def make(self) -> Callable[[float], Solver]:
        """``make(rtol)``; the compiled run serves every tolerance."""
        jnp, case = self.jax.numpy, self.case
        zero = np.zeros((*case.seeds.shape[:2], case.group.shape[1]))
        seeds = np.concatenate((case.seeds, zero), axis=2)
        arguments = [jnp.asarray(a) for a in (case.X0, self.nominal, seeds, case.jump)]
        compiled = {points: self._whole(points) for points in (1, POINTS)}

        def call(points: int, rtol: float) -> Array:
            try:
                return np.asarray(compiled[points](rtol, *arguments))
            except Exception as error:
                raise CannotRun(str(error).strip().splitlines()[0][:200]) from None

        def solver(rtol: float) -> Solver:
            if not self.compile_seconds:
                start = time.perf_counter()
                call(1, rtol)
                again = time.perf_counter()
                call(1, rtol)
                self.compile_seconds = (again - start) - (time.perf_counter() - again)
            return Solver(lambda: call(1, rtol), lambda: call(POINTS, rtol))

        return solver
