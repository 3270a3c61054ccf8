"""CasADi's integrators as they are called from Python, over interpreted or over compiled functions.

One call a stretch through CasADi's buffers. Over compiled functions (CasADi's option ``jit``) the right-hand
side and every derivative that the integrator asks for are machine code; only its own steps run in CasADi's
library. The samples that the error is taken on come from the interpreted form: the same numbers.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from benchmarks._case import POINTS, Case
from benchmarks.baselines import CannotRun, Solver
from dcvrt.integrators.casadi import bind
from dcvrt.integrators.equations import Equations

Array = NDArray[np.float64]
JIT = {
    "jit": True,
    "compiler": "shell",
    "jit_cleanup": False,  # the folder goes as a whole
    "jit_options": {"flags": ["-O3", "-march=native"], "cleanup": False},
}
SUNDIALS = ("cvodes", "idas")


def make(case: Case, plugin: str, interpreted: bool, forward: str = "") -> Callable[[float], Solver]:
    """Baseline on one case.

    Parameters
    ----------
    forward : ``""`` for a plain run or sensitivities within the equations, ``"simultaneous"`` or
        ``"staggered"`` for CasADi's forward sensitivities of the integrator.
    """
    equations = Equations(case.dae, (), False) if forward else case.equations
    nw = case.equations.nw if forward else 0
    rhs = equations.functions[0]
    tau = ca.SX.sym("tau")
    x, P, group = (ca.SX.sym(n, rhs.numel_in(n)) for n in ("x", "p", "u"))
    ode, _ = rhs(tau, x, ca.SX(0, 1), P, group)
    dae = {"t": tau, "x": x, "p": ca.vertcat(P, group), "ode": ode}
    n = case.X0.size
    nominal = np.hstack((case.P[:, : P.numel()], case.group))
    if nw:
        k = len(nominal)
        seeds = np.concatenate((case.seeds, np.zeros((k, nw, case.group.shape[1]))), axis=2)
        nominal = np.hstack((nominal, seeds.reshape(k, -1)))
    jump = case.jump if case.jump.any() else None

    def prepare(rtol: float, points: int) -> Callable[[], Array]:
        chosen: dict[str, Any] = {"reltol": rtol, "abstol": rtol * 1e-2}
        if not interpreted and points == 1:
            chosen |= JIT
        if plugin in SUNDIALS:
            chosen["max_num_steps"] = 200_000
        if nw:
            chosen["nfwd"] = nw
            if plugin in SUNDIALS:
                chosen["sensitivity_method"] = forward
        grid = (np.arange(1, points + 1) / points).tolist()
        with _scratch_folder():
            integrator = ca.integrator("stretch", plugin, dae, 0.0, grid, chosen)
        x0, p, X = np.zeros(n), np.zeros(nominal.shape[1]), np.zeros((points, n))
        # with forward sensitivities the columns of one output time stand side by side in X
        buffer, call = bind(integrator, {"x0": x0, "p": p}, {"xf": X})
        kept = np.zeros((len(nominal), points, n))

        def run() -> Array:
            x0[:] = case.X0
            for k in range(len(nominal)):
                if jump is not None:
                    x0[:] += jump[k]
                p[:] = nominal[k]
                try:
                    call()
                except RuntimeError as error:
                    raise CannotRun(str(error).strip().splitlines()[-1][:200]) from None
                if buffer.ret() != 0:
                    raise CannotRun(f"stretch {k} failed at rtol {rtol:g}")
                kept[k] = X
                x0[:] = X[-1]
            return kept

        return run

    return lambda rtol: Solver(prepare(rtol, 1), prepare(rtol, POINTS))


@contextmanager
def _scratch_folder() -> Iterator[None]:
    """CasADi writes what it compiles into the present folder."""
    here = Path.cwd()
    with TemporaryDirectory(prefix="dcvrt-jit-") as folder:
        os.chdir(folder)
        try:
            yield
        finally:
            os.chdir(here)
