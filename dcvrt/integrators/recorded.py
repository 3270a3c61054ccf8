"""A run that remembers why each of its breaks is there, for a sweep backwards over it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dcvrt.integrators.channels import Channels
from dcvrt.integrators.model import Model
from dcvrt.integrators.run import Run

Array = NDArray[np.float64]


@dataclass(eq=False)
class Point:
    """Where a function is evaluated."""

    t: float
    X: Array
    Z: Array
    P: Array
    piece: int


@dataclass(eq=False)
class Cause:
    """Why something happened at an instant, and so what its time depends on.

    A guard at a point; or a timer, which its row's `held` after `started` runs out; or neither: an input jump
    or the start, whose times depend on nothing. `weight` is tau.
    """

    row: int = -1
    guard: Point | None = None
    started: Cause | None = None
    weight: float = 0.0


@dataclass(eq=False)
class Jump:
    """One row that was applied: automaton, the point before it, and what x moves by with its time."""

    row: int
    automaton: int
    before: Point
    moved: Array


@dataclass(eq=False)
class Break:
    """Jumps at one instant for one cause."""

    cause: Cause
    jumps: list[Jump] = field(default_factory=list)


class RecordedRun(Run):
    """A run that remembers why each break is there.

    Attributes
    ----------
    into : per phase, the breaks that lead into it, in order.
    inside : per phase, guards that crossed inside it without a jump, since a timer may have started there.
    samples : per phase, times, states and algebraic variables on all samples of the trajectory.
    """

    def __init__(self, model: Model, inputs: Channels, p: Array, X: Array, Z: Array, save_at: float) -> None:
        super().__init__(model, inputs, p, X, Z, save_at)
        self.into: list[list[Break]] = []
        self.inside: list[list[Cause]] = []
        self._crossed: Cause | None = None
        self._now = self._placed = Break(Cause())
        self._started: dict[int, Cause] = {}
        self.samples: tuple[tuple[Array, Array, Array], ...] = ()

    def _point(self) -> Point:
        return Point(self.t, self.X.copy(), self.Z.copy(), self.P.copy(), self.k)

    def _time_gradient(self, row: int) -> Array:
        self._crossed = Cause(row, guard=self._point())
        return super()._time_gradient(row)

    def _settle(
        self, dte: Array, forced: dict[int, bool] | None = None, due: int | None = None, first: bool = False
    ) -> None:
        if due is not None:
            self._now = Break(Cause(due, started=self._started.get(due)))
        elif forced:
            self._now = Break(self._crossed or Cause())
        else:
            self._now = Break(Cause())
        if first:
            self.into.append([])
            self.inside.append([])
        super()._settle(dte, forced, due, first)
        if not self._now.jumps and self._now.cause.guard is not None:
            if len(self.phases[-1].t) == 1 and self.phases[-1].t[0][0] == self.t:
                self.into[-1].append(self._now)
            else:
                self.inside[-1].append(self._now.cause)

    def _jump(self, row: int, ties: list[int], dte: Array) -> None:
        before = self._point()
        name = f"reset_{row}" if row in self.model.resets else ""
        at = (before.t, before.X, before.Z, before.P, self.inputs.C[self.k])
        rate = self.model.at(name, *at)[1] if name else self.model.at("flow", *at)[0]
        super()._jump(row, ties, dte)
        flow = self.model.at("flow", self.t, self.X, self.Z, self.P, self.inputs.C[self.k])[0]
        self._now.jumps.append(Jump(row, self.equations.rows[row][0], before, rate[:, 0] - flow[:, 0]))

    def _begin_phase(self, dte: Array) -> None:
        count = len(self.phases)
        super()._begin_phase(dte)
        if len(self.phases) > count:
            self.into.append([])
            self.inside.append([])
        if self._now.jumps and self._now is not self._placed:  # an input jump begins a phase for no cause
            self.into[-1].append(self._now)
            self._placed = self._now

    def _set_timers(self, positive: NDArray[np.bool_], dte: Array) -> None:
        before = self.armed.copy()
        super()._set_timers(positive, dte)
        for row in np.flatnonzero(~np.isnan(self.armed) & np.isnan(before)).tolist():
            self._started[row] = self._now.cause
