r"""Implicit trapezoidal rule on the equations of a loaded ANDES system.

.. math::
    T \dot x = f(x, y), \quad 0 = g(x, y), \qquad
    T (x_{n+1} - x_n) = \tfrac{h}{2} (f_{n+1} + f_n), \quad g_{n+1} = 0

ANDES evaluates `f`, `g`, their Jacobian and its limiters; only the stepping is ours, for two reasons.

* Exact events. ANDES steps 0.1 ms across an event and averages `f` over the jump. Here an event is its own
  algebraic solution: `x` stays, `g = 0` gives the voltages on the other side, and the next step starts from
  the `f` of that side. Against ANDES's own loop at 1/480 s the voltages differ by about 1e-4 pu.
* Cost. ANDES leaves the rows of states at a limit in the Jacobian and refreshes that by the clock, which
  takes 4 to 10 iterations a step. Here a state at its limit has a unit row, the factors are kept while they
  contract well, and the iteration ends when what is left by its contraction is far below the error of a step.

Every step is as long as asked, so that all simulations of a study share one time layout. A step that does not
converge is cut into halves within its interval.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np
import numpy.typing as npt

from dcvrt.grid.evaluation import Evaluation

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

TOLERANCE = 1e-6
"""Largest correction of any variable that the solution of an event may still make, pu or rad."""
LEFT = 1e-7
"""Largest error of any variable that may be left in a step, pu or rad. Fifty times as much would leave
voltages right to 1e-6 pu in most cases, but near a limit it decides whether a limiter acts."""
ITERATIONS = 12
EVENT_ITERATIONS = 60
SLOW = 0.05
"""A correction that shrinks by less than this factor refreshes the Jacobian."""
HALVINGS = 6
UNUSED = 1e-8
"""Diagonal entry of a state without time constant: keeps one that its device does not use where it is."""


class NoConvergenceError(Exception):
    """Newton did not converge; `variable` moved most, `t` is where."""

    def __init__(self, t: float, variable: str) -> None:
        super().__init__(f"no solution at t = {t:.4f} s; {variable} did not settle")
        self.t, self.variable = t, variable


class Stepper:
    """Integrates an initialised ANDES system from event to event.

    Parameters
    ----------
    system : andes.System
        After `TDS.init`; its state is where the integration starts.

    Attributes
    ----------
    t : float
        Time reached, s.
    iterations, factorisations : int
        Newton iterations and Jacobians factorised so far.
    """

    def __init__(self, system: Any) -> None:
        kvxopt: Any = import_module("kvxopt")  # the sparse matrices that ANDES works in
        self._klu = import_module("kvxopt.klu")
        self._matrix, self._sparse, self._spdiag = kvxopt.matrix, kvxopt.sparse, kvxopt.spdiag
        self.system, self.dae = system, system.dae
        self.evaluate = Evaluation(system)
        self.models = system.exist.pflow_tds
        self.t = float(self.dae.t)
        self.n = int(self.dae.n)
        self.T = np.array(self.dae.Tf, dtype=float)
        self.instant = self.T == 0
        self.iterations = self.factorisations = 0
        self._symbolic: Any = None
        self._factors: Any = None
        self._still: Integers = np.empty(0, dtype=np.int64)
        self._factored: tuple[float, tuple[int, ...]] = (-1.0, ())
        self.evaluate(0)

    # -- what ANDES evaluates ------------------------------------------------------------------------------

    def pegged(self) -> Integers:
        """States that a limiter holds."""
        held = [np.ravel(address) for limiter in self.system.antiwindups for address, _, _ in limiter.x_set]
        return np.unique(np.concatenate(held)).astype(np.int64) if held else np.empty(0, dtype=np.int64)

    def _factorise(self, h: float, pegged: Integers) -> None:
        dae, spdiag = self.dae, self._spdiag
        self.system.j_update(models=self.models)
        # Rows: a state at its limit has only its unit entry, a state without time constant only its f.
        scale = np.where(self.instant, 1.0, 0.5 * h)
        unit = np.where(self.instant, UNUSED, self.T)
        self._still = pegged
        if h == 0:
            # A state without time constant that is not in its own equation (of a filter switched off by
            # zeros) follows from the states that it drives. Those stay in an event, so it waits for a step.
            own = np.ravel(self._matrix(dae.fx[:: self.n + 1]))
            self._still = np.union1d(pegged, np.flatnonzero(self.instant & (own == 0)))
        scale[self._still], unit[self._still] = 0.0, 1.0
        rows = spdiag(self._matrix(-scale))
        jacobian = self._sparse(
            [[spdiag(self._matrix(unit)) + rows * dae.fx, dae.gx], [rows * dae.fy, dae.gy]]
        )
        self._symbolic = self._klu.symbolic(jacobian)  # the pattern changes with the states at a limit
        self._factors = self._klu.numeric(jacobian, self._symbolic)
        self._jacobian = jacobian
        self._factored = (h, tuple(pegged.tolist()))
        self.factorisations += 1

    def _correction(self, x0: Floats, f0: Floats, h: float) -> Floats:
        dae = self.dae
        residual = np.where(self.instant, -dae.f, self.T * (dae.x - x0) - 0.5 * h * (dae.f + f0))
        residual[self._still] = 0.0
        right = self._matrix(np.concatenate((residual, dae.g)))
        self._klu.solve(self._jacobian, self._symbolic, self._factors, right)
        return np.ravel(right)

    def _newton(self, h: float, limit: int) -> None:
        r"""Solve one step of length `h` from the present point; `h = 0` is an event: `x` stays, `g = 0`.

        Corrections of sizes :math:`s_k` that contract by :math:`q = s_k / s_{k-1}` leave an error of
        :math:`s_k q / (1 - q)`. It ends a step, but only while the states at a limit stay the same.
        """
        dae = self.dae
        x0, y0, f0 = dae.x.copy(), dae.y.copy(), dae.f.copy()
        last, size, worst = np.inf, np.inf, 0
        pegged = self.pegged()
        for iteration in range(limit):
            same = abs(self._factored[0] - h) <= 1e-6 * h and self._factored[1] == tuple(pegged.tolist())
            refresh = not same or size > SLOW * last
            try:
                if refresh:
                    self._factorise(h, pegged)
                step = self._correction(x0, f0, h)
            except ArithmeticError:  # singular Jacobian
                break
            if not np.isfinite(step).all():
                break
            dae.x -= step[: self.n]
            dae.y -= step[self.n :]
            self.system.vars_to_models()
            self.evaluate(iteration)
            self.iterations += 1
            worst = int(np.argmax(np.abs(step)))
            last, size = size, float(abs(step[worst]))
            before, pegged = pegged, self.pegged()
            settled = h > 0 and size < last < np.inf and np.array_equal(before, pegged)
            if size <= TOLERANCE or (settled and size * size <= LEFT * (last - size)):
                return
        dae.x[:], dae.y[:], dae.f[:] = x0, y0, f0
        self.system.vars_to_models()
        raise NoConvergenceError(self.t + h, str(dae.xy_name[worst]))

    # -- what is called ------------------------------------------------------------------------------------

    def event(self, guess: Floats) -> None:
        """Solve the algebraic equations from `guess`, after something in the network has changed."""
        self._factored = (-1.0, ())
        self.dae.y[:] = guess
        self.system.vars_to_models()
        self.evaluate(0)
        self._newton(0.0, EVENT_ITERATIONS)

    def advance(self, until: float) -> None:
        """Make one step to `until`, or several shorter ones where it does not converge."""
        self._advance(until, HALVINGS)
        self.t = until

    def _advance(self, until: float, halvings: int) -> None:
        try:
            self.dae.t[...] = until
            self._newton(until - self.t, ITERATIONS)
            self.t = until
        except NoConvergenceError:
            if not halvings:
                raise
            self._factored = (-1.0, ())
            self.evaluate(0)
            middle = 0.5 * (self.t + until)
            self._advance(middle, halvings - 1)
            self._advance(until, halvings - 1)
