"""The compiled system: its functions as calls on numpy arrays, and its stretches by size."""

from __future__ import annotations

from functools import lru_cache

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dcvrt.errors import ModelError
from dcvrt.integrators.casadi import Casadi, Stretch, bind
from dcvrt.integrators.compiler import compiled
from dcvrt.integrators.equations import Equations

Array = NDArray[np.float64]
BLOCKS = (1024, 256, 64, 16, 1)
"""Numbers of points that a function is mapped over in one call; the last block is padded."""
DERIVATIVES = (1, 4, 16)
"""Numbers of directions in which the Jacobian of an implicit method is assembled."""


class Mapped:
    """A function of (t, X, Z, P, C) on `count` points with common P; results hold until the next call."""

    def __init__(self, function: ca.Function, count: int) -> None:
        self.count = count
        mapped = (
            function if count == 1 else function.map(f"{function.name()}_{count}", "serial", count, [3], [])
        )
        self.arguments = [np.zeros(mapped.size_in(k)[::-1]) for k in range(mapped.n_in())]
        self.results = [np.zeros(mapped.size_out(k)[::-1]) for k in range(mapped.n_out())]
        self.buffer, self.call = bind(
            mapped,
            dict(zip(mapped.name_in(), self.arguments, strict=True)),
            dict(zip(mapped.name_out(), self.results, strict=True)),
        )

    def __call__(self, t: Array, X: Array, Z: Array, P: Array, C: Array) -> list[Array]:
        n = len(t)
        for own, given in zip(self.arguments, (t[:, None], X, Z, P, C), strict=True):
            if own.size:
                own[: min(n, len(own))] = given
                if n < self.count and own.shape[0] == self.count:
                    own[n:] = own[n - 1]
        self.call()
        return self.results


class Model:
    """Compiled functions of one set of :class:`Equations` for one solver."""

    def __init__(self, equations: Equations, solver: Casadi) -> None:
        if equations.nz and not solver.algebraic:
            raise ModelError(
                f"{equations.dae.name} has {equations.nz} algebraic variable(s); plugin {solver.plugin!r} "
                "takes none. Use Casadi(plugin='rosenbrock') or 'idas'."
            )
        self.equations, self.solver = equations, solver
        directions = DERIVATIVES if solver.implicit and not equations.nw else ()
        interpreted = solver.interpreted or (solver.implicit and equations.nw > 0)
        if interpreted:
            functions = {f.name(): f for f in equations.functions}
            self.backend = (
                "CasADi interpreter (asked for)"
                if solver.interpreted
                else ("CasADi interpreter (implicit method with sensitivities)")
            )
        else:
            functions, self.backend = compiled(equations.functions, directions)
        self.functions = functions
        self.rhs = functions["rhs"]
        rhs = equations.functions[0]
        self.sizes = {n: rhs.numel_in(n) for n in ("t", "x", "z", "p", "u")}
        self.mapped = lru_cache(maxsize=None)(lambda name, count: Mapped(functions[name], count))
        self.stretch = lru_cache(maxsize=64)(
            lambda points, groups: Stretch(self.rhs, self.sizes, solver, points, groups)
        )
        self.resets = {k for k, (_, row) in enumerate(equations.rows) if row.reset}

    def at(self, name: str, t: float, X: Array, Z: Array, P: Array, C: Array) -> list[Array]:
        """Results of a function at one point as columns-by-rows matrices, copied."""
        results = self.mapped(name, 1)(np.array([t]), X[None], Z[None], P[None], C[None])
        return [r.T.copy() for r in results]

    def on(self, name: str, t: Array, X: Array, Z: Array, P: Array, C: Array) -> list[Array]:
        """Results of a function on many points: arrays (points, rows, columns...)."""
        n, done = len(t), 0
        parts: list[list[Array]] = []
        function = self.functions[name]
        while done < n:
            left = n - done
            count = next((b for b in BLOCKS if b <= left), 1)
            if count < left and count < 64:  # pad rather than call many times
                count = next(b for b in reversed(BLOCKS) if b >= left)
            stop = min(done + count, n)
            s = slice(done, stop)
            results = self.mapped(name, count)(t[s], X[s], Z[s], P[None], C[s])
            shaped = []
            for k, r in enumerate(results):
                rows, columns = function.size_out(k)
                shaped.append(r.reshape(count, columns, rows)[: stop - done].transpose(0, 2, 1).copy())
            parts.append(shaped)
            done = stop
        return [np.concatenate(p) for p in zip(*parts, strict=True)]
