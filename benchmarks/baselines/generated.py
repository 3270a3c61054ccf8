"""CasADi's integrators as generated C, integrator included: the strongest baseline.

The integrator of one stretch is generated with CasADi's code generator. A loop over the stretches of many
runs in the same C file calls it, so that no Python runs between the first stretch and the last. Tolerances
are parameters of that loop: the constants in the generated text are replaced, one compile serves all.
"""

from __future__ import annotations

import ctypes
import re
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from benchmarks._case import POINTS, Case
from benchmarks._precision import Curve, walk
from benchmarks.baselines import CannotRun, Solver
from benchmarks.harness import spent
from dcvrt.integrators import find_compiler
from dcvrt.integrators.equations import Equations

Array = NDArray[np.float64]

FLAGS = ("-O3", "-march=native", "-fno-math-errno", "-fno-trapping-math", "-fPIC", "-shared")
HEAD = """
#include <stdlib.h>
static double bench_reltol, bench_abstol;
"""
LOOP = """
/* `runs` runs of count[r] stretches one after the other; X gets `width` numbers a stretch, of which the last
   n are the state at its end. Returns the number of the first stretch that failed, from 1; 0: none. */
__attribute__((visibility("default")))
long long bench_loop(long long runs, const long long* count, double reltol, double abstol, long long n,
                     const double* x0, long long np, const double* p, const double* jump, const double* table,
                     long long width, double* X) {
  casadi_int na, nr, ni, nw;
  long long r, k, i, done = 0;
  bench_reltol = reltol; bench_abstol = abstol;
  stretch_incref();
  stretch_work(&na, &nr, &ni, &nw);
  const double** arg = calloc(na + 1, sizeof(double*));
  double** res = calloc(nr + 1, sizeof(double*));
  casadi_int* iw = malloc((ni + 1) * sizeof(casadi_int));
  double* w = malloc((nw + 1) * sizeof(double));
  double* x = malloc(n * sizeof(double));
  int mem = stretch_checkout();
  long long failed = 0;
  for (r = 0; r < runs && !failed; ++r) {
    for (i = 0; i < n; ++i) x[i] = x0[r*n + i];
    for (k = 0; k < count[r] && !failed; ++k, ++done) {
      if (jump) for (i = 0; i < n; ++i) x[i] += jump[done*n + i];
      for (i = 0; i < na; ++i) arg[i] = 0;
      for (i = 0; i < nr; ++i) res[i] = 0;
      arg[0] = x; arg[2] = p + done*np; arg[3] = table;
      res[0] = X + done*width;
      if (stretch(arg, res, iw, w, mem)) failed = done + 1;
      for (i = 0; i < n; ++i) x[i] = X[done*width + width - n + i];
    }
  }
  stretch_release(mem);
  free(arg); free(res); free(iw); free(w); free(x);
  return failed;
}
"""


FAR = 1e3
"""Further than any guard is from zero."""


class Generated:
    """A CasADi integrator in C for all cases of one system.

    Parameters
    ----------
    equations : of the system; with sensitivities they are part of the state and of its error norm.
    plugin : ``erk`` or ``rosenbrock``.
    points : samples of a stretch.
    forward : sensitivities by CasADi's own forward mode of the integrator (it leaves them out of the error
        norm) in place of those in the equations.
    table : number of pieces of the inputs: looked up in a table inside a stretch, in place of a stretch a
        piece.
    watching : whether it also looks at every guard of the system, as its own event handling does in each
        step. None fires: the stretches end where events are.
    """

    def __init__(
        self,
        equations: Equations,
        plugin: str,
        points: int = 1,
        forward: bool = False,
        table: int = 0,
        watching: bool = False,
        flags: Sequence[str] = FLAGS,
    ) -> None:
        self.points, self.forward, self.nw, self.table = points, forward, equations.nw, table
        if forward:
            equations = Equations(equations.dae, (), False)
        dae = _table_dae(equations, table) if table else _dae(equations)
        grid = (np.arange(1, points + 1) / points).tolist()
        options: dict[str, Any] = {"reltol": 1.2345e-6, "abstol": 5.4321e-9, "max_num_steps": 100_000}
        if watching:
            dae["zero"] = _quiet_guards(equations, dae)
        if table:
            options["control_group_size"] = [points]
        if forward:
            options["nfwd"] = self.nw
        start = spent()
        integrator = ca.integrator("stretch", plugin, dae, 0.0, grid, options)
        generator = ca.CodeGenerator("baseline.c", {"with_header": False})
        generator.add(integrator)
        text = generator.dump() + LOOP
        text, found = re.subn(r"p\.(rel|abs)tol = [^;]+;", r"p.\1tol = bench_\1tol;", text)
        if found != 2:
            raise RuntimeError("the generated C sets its tolerances elsewhere: adapt this baseline")
        text = HEAD + text
        self.library = _compile(text, flags)
        self.total_seconds = spent() - start
        self.text_length = len(text)

    def arguments(self, cases: Sequence[Case]) -> tuple[Any, ...]:
        """Arrays of many cases as the loop takes them."""
        count = np.array([len(c.P) for c in cases], dtype=np.int64)
        x0 = np.ascontiguousarray([c.X0 for c in cases])
        p = np.ascontiguousarray(np.concatenate([self._parameters(c) for c in cases]))
        jump = np.ascontiguousarray(np.concatenate([c.jump for c in cases]))
        return count, x0, p, jump

    def _parameters(self, case: Case) -> Array:
        plain = case.P if not self.forward else case.P[:, : case.seeds.shape[2]]
        nominal = np.hstack((plain, case.group))
        if not self.forward:
            return nominal
        k, nw, _ = case.seeds.shape
        seeds = np.concatenate((case.seeds, np.zeros((k, nw, case.group.shape[1]))), axis=2)
        return np.hstack((nominal, seeds.reshape(k, -1)))

    def call(
        self, count: Array, x0: Array, p: Array, jump: Array, rtol: float, table: Array | None = None
    ) -> Array:
        """States (stretches, points, n)."""
        n, total = x0.shape[1], int(count.sum())
        X = np.empty((total, self.points, n))
        failed = self.library.bench_loop(
            len(count), _at(count), ctypes.c_double(rtol), ctypes.c_double(rtol * 1e-2), n, _at(x0),
            p.shape[1], _at(p), _at(jump) if jump.any() else None,
            None if table is None else _at(table), self.points * n, _at(X),
        )  # fmt: skip
        if failed:
            raise CannotRun(f"stretch {failed} of {total} failed at rtol {rtol:g}")
        return X


def single(
    equations: Equations, plugin: str, case: Case, forward: bool = False, watching: bool = False
) -> Any:
    """``make(rtol)`` for one case: plain stretches for the time, samples inside for the error."""
    fast = Generated(equations, plugin, 1, forward, watching=watching)
    fine = Generated(equations, plugin, POINTS, forward)
    given = fast.arguments([case])

    def make(rtol: float) -> Solver:
        return Solver(lambda: fast.call(*given, rtol), lambda: fine.call(*given, rtol))

    return make


def sampled(
    name: str, equations: Equations, plugin: str, case: Case, targets: Sequence[float], which: int
) -> Curve:
    """As many samples of the states as one every ms makes; `which`: 0 path error, 1 sensitivity error."""
    points = int(np.ceil(1e3 * float(case.length.sum()) / len(case.P)))
    many, fine = Generated(equations, plugin, points), Generated(equations, plugin, POINTS)
    given = many.arguments([case])

    def measure(rtol: float) -> tuple[Callable[[], object], float]:
        return lambda: many.call(*given, rtol), case.errors(fine.call(*given, rtol))[which]

    return walk(f"{name}, {points} samples a stretch", "CasADi, generated C", measure, targets)


def _at(array: Array) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


def _dae(equations: Equations) -> dict[str, ca.SX]:
    """Right-hand side in normalised time with everything else as parameters."""
    rhs = equations.functions[0]
    tau = ca.SX.sym("tau")
    x, P, group = (ca.SX.sym(n, rhs.numel_in(n)) for n in ("x", "p", "u"))
    ode, _ = rhs(tau, x, ca.SX(0, 1), P, group)
    return {"t": tau, "x": x, "p": ca.vertcat(P, group), "ode": ode}


def _quiet_guards(equations: Equations, dae: dict[str, Any]) -> ca.SX:
    """Every guard, shifted so far that none fires: what is left is the work of looking at them."""
    look = next(f for f in equations.functions if f.name() == "look")
    P, group = dae["p"][: look.numel_in(3)], dae["p"][look.numel_in(3) :]
    t = group[1] + group[2] * dae["t"]
    return FAR - look(t, dae["x"], ca.SX(0, 1), P, group[3:])[0]


def _table_dae(equations: Equations, pieces: int) -> dict[str, ca.MX]:
    """The same with the coefficients of the inputs looked up in a table with one column a piece.

    Parameters end with [begin, duration, origin, step, first, last]: from the time `origin` of piece `first`
    on pieces are `step` long; at the end of the stretch piece `last`, the one inside, counts.
    """
    rhs = equations.functions[0]
    width, n_P = rhs.numel_in("u") - 3, rhs.numel_in("p")
    tau, x, p = ca.MX.sym("tau"), ca.MX.sym("x", rhs.numel_in("x")), ca.MX.sym("p", n_P + 6)
    table = ca.MX.sym("table", width * pieces)
    begin, length, origin, step, first, last = (p[n_P + k] for k in range(6))
    t = begin + tau * length
    piece = ca.fmin(first + ca.floor((t - origin) / step), last)
    column = ca.reshape(table, width, pieces)[:, piece]
    ode, _ = rhs(tau, x, ca.MX(0, 1), p[:n_P], ca.vertcat(0, begin, length, column))
    return {"t": tau, "x": x, "p": p, "u": table, "ode": ode}


def tabled(case: Case, stepped: Case) -> tuple[Array, Array, Array, Array, Array]:
    """Arguments of the loop for a sampled waveform with the stretches of the stepped one, and the table.

    `case` is cut at every sample; between two jumps its pieces are equally long.
    """
    table = np.ascontiguousarray(case.group[:, 3:])
    middle = stepped.begin + 0.5 * stepped.length
    p = []
    for k, t in enumerate(middle):
        edge = max((j for j in case.waveform.jumps if j <= t), default=case.waveform.start)
        first = int(np.searchsorted(table[:, 0], edge - 1e-9))
        last = int(np.searchsorted(table[:, 0], stepped.begin[k] + stepped.length[k] - 1e-9)) - 1
        step = float(table[first, 1])
        more = [stepped.begin[k], stepped.length[k], table[first, 0], step, first, last]
        p.append(np.concatenate((stepped.P[k], more)))
    return np.array([len(p)]), case.X0[None].copy(), np.array(p), stepped.jump, table


def _compile(text: str, flags: Sequence[str]) -> ctypes.CDLL:
    compiler = find_compiler()
    if compiler is None:
        raise CannotRun("no C compiler")
    folder = Path(tempfile.mkdtemp(prefix="dcvrt-baseline-"))
    source, made = folder / "baseline.c", folder / "baseline.so"
    source.write_text(text, encoding="utf-8")
    subprocess.run([*compiler.command, *flags, str(source), "-o", str(made), "-lm"], check=True)
    library = ctypes.CDLL(str(made))
    library.bench_loop.restype = ctypes.c_longlong
    pointer, integer, real = ctypes.c_void_p, ctypes.c_longlong, ctypes.c_double
    library.bench_loop.argtypes = [
        integer, pointer, real, real, integer, pointer, integer, pointer, pointer, pointer, integer, pointer
    ]  # fmt: skip
    return library
