r"""Implicit trapezoidal rule on the equations of a loaded ANDES system.

.. math::
    T \dot x = f(x, y), \quad 0 = g(x, y), \qquad
    T (x_{n+1} - x_n) = \tfrac{h}{2} (f_{n+1} + f_n), \quad g_{n+1} = 0

ANDES evaluates `f`, `g`, their Jacobian and its limiters; only the stepping is ours, for three reasons.

* Exact events. ANDES steps 0.1 ms across an event and averages `f` over the jump. Here an event is its own
  algebraic solution: `x` stays, `g = 0` gives the voltages on the other side, and the next step starts from
  the `f` of that side. Against ANDES's own loop at 1/480 s the voltages differ by about 1e-4 pu.
* Cost. ANDES leaves the rows of states at a limit in the Jacobian and refreshes that by the clock, which
  takes 4 to 10 iterations a step. Here a state at its limit has a unit row, the factors are kept while they
  contract well, and the iteration ends when what is left by its contraction is far below the error of a step.
* Copies. Where the system holds several copies of a case (`repeated`), each with a fault of its own, one
  evaluation serves all of them. Newton's iteration, its factors and its end are each copy's own: every fault
  is stepped as if it were alone.

Every step is as long as asked, so that all simulations of a study share one time layout. A step that does not
converge is cut into halves within its interval, where one copy is stepped; of several, it leaves that copy
behind.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from typing import Any

import numpy as np
import numpy.typing as npt

from dcvrt.grid.evaluation import Evaluation, Jacobian

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]
Bools = npt.NDArray[np.bool_]

TOLERANCE = 1e-6
"""Largest correction of any variable that the solution of an event may still make, pu or rad."""
LEFT = 1e-7
"""Largest error of any variable that may be left in a step, pu or rad. Fifty times as much would leave
voltages right to 1e-6 pu in most cases, but near a limit it decides whether a limiter acts."""
ITERATIONS = 12
EVENT_ITERATIONS = 60
SLOW = 0.1
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
    copies : sequence of (int array, int array), optional
        Addresses of states and algebraic variables of the copies that are stepped, which no equation ties to
        each other; what is in none stays where it is. The whole system when not given.

    Attributes
    ----------
    t : float
        Time reached, s.
    active : list of int
        Numbers of the copies that are stepped still; whoever takes one out leaves it where it is.
    lost : dict of int to NoConvergenceError
        Copies left behind where Newton did not converge.
    iterations, factorisations : int
        Newton iterations and Jacobians factorised so far, of all copies.
    """

    def __init__(self, system: Any, copies: Sequence[tuple[Integers, Integers]] | None = None) -> None:
        self.system, self.dae = system, system.dae
        self.evaluate, self.jacobian = Evaluation(system), Jacobian(system)
        self.t = float(self.dae.t)
        self.n = int(self.dae.n)
        self.T = np.array(self.dae.Tf, dtype=float)
        self.instant = self.T == 0
        if copies is None:
            copies = [(np.arange(self.n), np.arange(int(self.dae.m)))]
        self.copies = [_Newton(system.dae, self.jacobian, x, y) for x, y in copies]
        self.active = list(range(len(copies)))
        self.lost: dict[int, NoConvergenceError] = {}
        self.iterations = self.factorisations = 0
        self.evaluate(0)

    # -- what ANDES evaluates ------------------------------------------------------------------------------

    def pegged(self) -> Bools:
        """Which states a limiter holds."""
        held = np.zeros(self.n, dtype=bool)
        for limiter in self.system.antiwindups:
            for address, _, _ in limiter.x_set:
                held[np.ravel(address)] = True
        return held

    def _factorise(self, h: float, pegged: Bools, copies: Sequence[_Newton]) -> None:
        values = self.jacobian()
        # Rows: a state at its limit has only its unit entry, a state without time constant only its f.
        scale = np.where(self.instant, -1.0, -0.5 * h)
        unit = np.where(self.instant, UNUSED, self.T)
        still = pegged
        if h == 0:
            # A state without time constant that is not in its own equation (of a filter switched off by
            # zeros) follows from the states that it drives. Those stay in an event, so it waits for a step.
            still = pegged | (self.instant & (self.jacobian.own_rates(values) == 0))
        scale[still], unit[still] = 0.0, 1.0
        for copy in copies:
            copy.factorise(values, scale, unit)
            copy.still, copy.factored = still[copy.x], (h, pegged[copy.x].tobytes())
            self.factorisations += 1

    def _newton(self, h: float, limit: int) -> dict[int, int]:
        """Solve one step of length `h` from the present point; `h = 0` is an event: `x` stays, `g = 0`.

        Returns
        -------
        dict of int to int
            Copies that did not converge, which are where they were, each with the variable that moved most.
        """
        dae = self.dae
        x0, y0, f0 = dae.x.copy(), dae.y.copy(), dae.f.copy()
        waiting = {k: self.copies[k] for k in self.active}
        failed: dict[int, int] = {}
        for copy in waiting.values():
            copy.begin()
        pegged = self.pegged()
        for iteration in range(limit):
            stale = [copy for copy in waiting.values() if copy.stale(h, pegged)]
            if stale:
                self._factorise(h, pegged, stale)
            residual = np.where(self.instant, -dae.f, self.T * (dae.x - x0) - 0.5 * h * (dae.f + f0))
            for k, copy in list(waiting.items()):
                if not copy.correct(residual):
                    failed[k] = copy.worst
                    del waiting[k]
            self.system.vars_to_models()
            self.evaluate(iteration)
            self.iterations += len(waiting)
            before, pegged = pegged, self.pegged()
            waiting = {k: copy for k, copy in waiting.items() if not copy.settled(h, before, pegged)}
            if not waiting:
                break
        failed |= {k: copy.worst for k, copy in waiting.items()}
        for k in failed:
            copy = self.copies[k]
            dae.x[copy.x], dae.y[copy.y], dae.f[copy.x] = x0[copy.x], y0[copy.y], f0[copy.x]
            copy.factored = NONE
        if failed:
            self.system.vars_to_models()
        return failed

    # -- what is called ------------------------------------------------------------------------------------

    def event(self, guess: Floats) -> None:
        """Solve the algebraic equations from `guess`, after something in the network has changed."""
        for k in self.active:
            copy = self.copies[k]
            copy.factored = NONE
            self.dae.y[copy.y] = guess[copy.y]
        self.system.vars_to_models()
        self.evaluate(0)
        self._leave(self._newton(0.0, EVENT_ITERATIONS), self.t)

    def advance(self, until: float) -> None:
        """Make one step to `until`; where a single copy does not converge, several shorter ones."""
        self._leave(self._advance(until, HALVINGS if len(self.copies) == 1 else 0), until)
        self.t = until

    def _advance(self, until: float, halvings: int) -> dict[int, int]:
        self.dae.t[...] = until
        failed = self._newton(until - self.t, ITERATIONS)
        if failed and halvings:
            self.evaluate(0)
            middle = 0.5 * (self.t + until)
            return self._advance(middle, halvings - 1) or self._advance(until, halvings - 1)
        if not failed:
            self.t = until
        return failed

    def _leave(self, failed: dict[int, int], t: float) -> None:
        for k, variable in failed.items():
            self.lost[k] = NoConvergenceError(t, str(self.dae.xy_name[variable]))
            self.active.remove(k)


NONE = (-1.0, b"")
"""Step and states at a limit of factors that are no more."""


class _Newton:
    """Newton's iteration on the variables of one copy.

    Parameters
    ----------
    dae : andes.variables.dae.DAE
    jacobian : Jacobian
    x, y : int arrays
        Addresses of its states and algebraic variables.
    """

    def __init__(self, dae: Any, jacobian: Jacobian, x: Integers, y: Integers) -> None:
        self.dae, self.x, self.y = dae, x, y
        self.variables = np.concatenate([x, y + int(dae.n)])
        self.factored = NONE
        """Length of the step and states at a limit that the factors were made for."""
        self.still: Bools = np.zeros(len(x), dtype=bool)
        """States whose rows are unit rows."""
        self._kvxopt: Any = import_module("kvxopt")  # the sparse matrices that ANDES works in
        self._klu: Any = import_module("kvxopt.klu")
        self._symbolic: Any = None
        self._factors: Any = None
        self._arrange(jacobian)
        self.begin()

    def _arrange(self, jacobian: Jacobian) -> None:
        """Where the entries of the Jacobian stand in the matrix of this copy."""
        n, size, states = len(self.x), len(self.variables), int(self.dae.n)
        local = np.full(states + int(self.dae.m), -1)
        local[self.variables] = np.arange(size)
        row, column = local[jacobian.row], local[jacobian.column]
        self._entries = np.flatnonzero((row >= 0) & (column >= 0))
        row, column = row[self._entries], column[self._entries]
        self._of_states = np.flatnonzero(row < n)
        self._state = self.x[row[self._of_states]]
        diagonal = np.arange(n)  # the part that is no Jacobian's
        places = np.concatenate([column, diagonal]) * size + np.concatenate([row, diagonal])
        unique, self._place = np.unique(places, return_inverse=True)  # column after column, as it is stored
        self._nonzeros = len(unique)
        parts = (self._kvxopt.matrix(part) for part in (np.ones(len(unique)), unique % size, unique // size))
        self._matrix = self._kvxopt.spmatrix(*parts, (size, size))

    def begin(self) -> None:
        """Forget how the last step went."""
        self.last = self.size = np.inf
        self.worst = 0

    def stale(self, h: float, pegged: Bools) -> bool:
        """Whether the factors are those of another step or of other limits, or contract badly."""
        length, held = self.factored
        same = abs(length - h) <= 1e-6 * h and held == pegged[self.x].tobytes()
        return not same or self.size > SLOW * self.last

    def settled(self, h: float, before: Bools, pegged: Bools) -> bool:
        r"""Whether the iteration may end.

        Corrections of sizes :math:`s_k` that contract by :math:`q = s_k / s_{k-1}` leave an error of
        :math:`s_k q / (1 - q)`. It ends a step, but only while the states at a limit stay the same.
        """
        size, last = self.size, self.last
        if size <= TOLERANCE:
            return True
        contracts = h > 0 and size < last < np.inf and size * size <= LEFT * (last - size)
        return contracts and bool((before[self.x] == pegged[self.x]).all())

    def correct(self, residual: Floats) -> bool:
        """Make one iteration, from the residuals of all states; false where it gives no numbers."""
        if self._factors is None:
            return False
        own = residual[self.x]
        own[self.still] = 0.0
        right = self._kvxopt.matrix(np.concatenate((own, self.dae.g[self.y])))
        self._klu.solve(self._matrix, self._symbolic, self._factors, right)
        step = np.ravel(right)
        if not np.isfinite(step).all():
            return False
        n, sizes = len(self.x), np.abs(step)
        self.dae.x[self.x] -= step[:n]
        self.dae.y[self.y] -= step[n:]
        place = int(np.argmax(sizes))
        self.worst, self.last, self.size = int(self.variables[place]), self.size, float(sizes[place])
        return True

    def factorise(self, values: Floats, scale: Floats, unit: Floats) -> None:
        """Factors of the Jacobian of a step, from all entries of those of f and g as they are stored.

        Rows of states: `scale` times those of f, and `unit` on the diagonal.
        """
        entries = values[self._entries]
        entries[self._of_states] *= scale[self._state]
        filled = np.bincount(self._place, np.concatenate([entries, unit[self.x]]), self._nonzeros)
        self._matrix.V = self._kvxopt.matrix(filled)
        try:
            if self._symbolic is None:
                self._symbolic = self._klu.symbolic(self._matrix)
            self._factors = self._klu.numeric(self._matrix, self._symbolic)
        except ArithmeticError:  # singular
            self._factors = None
