r"""One run: smooth stretches joined by input jumps and by jumps of the automata.

The loop is the same for every solver. A stretch is integrated without regard to events; guards, timers and
bounds are then looked at on its samples; what comes first is located by integrating from the sample before
it, the rows that are due are applied, and the next stretch starts there.

Across a jump at t_e with reset R, from dx/dt = f^- to f^+,

.. math::
    \frac{dt_e}{d\theta} = -\frac{h_\theta}{\dot h}, \qquad
    S^+ = R_\theta + (\dot R - f^+) \frac{dt_e}{d\theta},

where h is the guard and derivatives by theta and along time are total ones at the left of the jump.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dcvrt.integrators import sentences
from dcvrt.integrators.channels import Channels
from dcvrt.integrators.crossing import first_crossing
from dcvrt.integrators.model import Model
from dcvrt.integrators.sentences import MAX_EVENTS, MAX_JUMPS_AT_ONCE
from dcvrt.trajectory import COMPLETED, Event

Array = NDArray[np.float64]

SAME_INSTANT = 1e-9
"""Jumps closer than this, s, are at one instant; a guard is judged by its sign this long after it."""
LOCATED = 1e-12
FIRST_LOOK, LONGEST_LOOK = 0.02, 0.5
"""A stretch after a restart is short, since the next event is often near; then stretches double, s."""
MAX_POINTS = 1024
POINTS = tuple(sorted({2**k for k in range(11)} | {3 * 2**k for k in range(9)}))


class Ended(Exception):  # noqa: N818 - not an error: the run is over and this says why
    """The run is over; the message is its status."""


@dataclass
class Phase:
    """Samples between two jumps: parameters and modes are the same on all of them."""

    P: Array
    t: list[Array]
    X: list[Array]
    Z: list[Array]
    piece: list[NDArray[np.int64]]

    def add(self, t: Array, X: Array, Z: Array, piece: NDArray[np.int64]) -> None:
        self.t.append(t.copy())
        self.X.append(X.copy())
        self.Z.append(Z.copy())
        self.piece.append(piece.copy())


class Run:
    """State of one run while it is integrated; sensitivities are carried times their scale."""

    def __init__(self, model: Model, inputs: Channels, p: Array, X: Array, Z: Array, save_at: float) -> None:
        self.model, self.equations, self.inputs, self.save_at = model, model.equations, inputs, save_at
        eq = self.equations
        self.X, self.Z = X, Z
        self.t, self.k = float(inputs.start[0]), 0
        self.ends = np.append(inputs.start[1:], inputs.start[-1] + inputs.length[-1])
        self.p = p
        self.modes = [a.mode_number(a.start) for a in eq.dae.automata]
        self.entry, self.dentry = np.full(eq.na, self.t), np.zeros((eq.na, eq.nw))
        held, dheld = eq.held(p)
        self.held, self.dheld = np.array(held)[:, 0], np.array(dheld)
        self.n_rows = len(eq.rows)
        self.automaton = np.array([a for a, _ in eq.rows], dtype=int)
        automata = eq.dae.automata
        self.source = np.array([automata[a].mode_number(r.source) for a, r in eq.rows], dtype=int)
        self.target = [automata[a].mode_number(r.target) for a, r in eq.rows]
        self.armed, self.darmed = np.full(self.n_rows, np.nan), np.zeros((self.n_rows, eq.nw))
        self.has_guards = bool(self.n_rows or eq.bounds)
        self.events: list[Event] = []
        self.phases: list[Phase] = []
        self.break_grad: list[Array] = []
        self.instant, self.jumps_at_instant, self.visited = -math.inf, 0, [""]
        self.P = self._parameters()
        self.look_ahead = FIRST_LOOK

    # -- the loop -----------------------------------------------------------------------------------------

    def run(self) -> str:
        """Integrate to the end; the status."""
        borders = [*self.inputs.start[self.inputs.sections[1:]].tolist(), float(self.ends[-1])]
        try:
            for number, border in enumerate(borders):
                self.k = int(self.inputs.sections[number])
                self._check_bounds()
                if number:
                    self._begin_phase(np.zeros(self.equations.nw))
                self._settle(np.zeros(self.equations.nw), first=number == 0)
                while self.t < border:
                    self._advance(border)
                self._fire_due()
        except Ended as over:
            return str(over)
        return COMPLETED

    def _advance(self, border: float) -> None:
        """Integrate one stretch and handle the first thing that happens in it."""
        fires, row = self._next_timer()
        limit = min(border, fires)
        if limit - self.t <= LOCATED:
            self._be_at(limit)
            return self._fire(row) if fires <= limit else None
        t, X, Z, piece = self._stretch(limit)
        crossing = self._first_crossing(t, X, Z, piece)
        if crossing is None:
            self.phases[-1].add(t[1:], X[1:], Z[1:], piece[1:])
            self._move(t[-1], X[-1], Z[-1], int(piece[-1]))
            self.look_ahead = min(2 * self.look_ahead, LONGEST_LOOK)
            if self.t >= fires:
                self._fire(row)
            return None
        i, brackets = crossing
        if i:
            self.phases[-1].add(t[1 : i + 1], X[1 : i + 1], Z[1 : i + 1], piece[1 : i + 1])
        self._move(t[i], X[i], Z[i], int(piece[i + 1]))
        self._cross(brackets, float(t[i + 1]))
        return None

    def _be_at(self, t: float) -> None:
        """Take a time that differs from the present by round-off for the present."""
        last = self.phases[-1].t[-1]
        if last[-1] == self.t:
            last[-1] = t
        self.t = t

    def _move(self, t: float, X: Array, Z: Array, piece: int) -> None:
        self.t, self.X, self.Z, self.k = float(t), X.copy(), Z.copy(), piece

    # -- smooth stretches ---------------------------------------------------------------------------------

    def _stretch(self, limit: float) -> tuple[Array, Array, Array, NDArray[np.int64]]:
        """Integrate from here to `limit` or less: time, states, algebraics and piece of each sample."""
        start, length, end = self.inputs.start, self.inputs.length, self.ends
        while self.k + 1 < len(start) and start[self.k + 1] <= self.t + LOCATED:
            self.k += 1
        ahead = self.look_ahead if self.has_guards else LONGEST_LOOK
        stop = min(limit, self.t + ahead)
        last = max(int(np.searchsorted(start, stop, side="left")) - 1, self.k)
        groups = 1 << (min(last - self.k + 1, self.model.solver.groups).bit_length() - 1)
        inner = length[self.k + 1 : self.k + groups - 1]
        uneven = len(inner) > 0 and inner.max() > 4 * inner.min()
        if uneven or length[self.k : self.k + groups].max() > MAX_POINTS * self.save_at:
            groups = 1
        stop = min(stop, float(end[self.k + groups - 1]))
        if groups == 1:
            stop = min(stop, self.t + MAX_POINTS * self.save_at)
        begin = start[self.k : self.k + groups].copy()
        begin[0] = self.t
        finish = np.append(begin[1:], stop)
        wanted = math.ceil(float((finish - begin).max()) / self.save_at - 1e-6)
        points = next(n for n in POINTS if n >= min(max(wanted, 1), MAX_POINTS))
        return self._integrate(begin, finish, points)

    def _integrate(
        self, begin: Array, finish: Array, points: int
    ) -> tuple[Array, Array, Array, NDArray[np.int64]]:
        groups = len(begin)
        pieces = np.arange(self.k, self.k + groups)
        number = np.arange(groups, dtype=float)
        controls: Array = np.column_stack((number, begin, finish - begin, self.inputs.C[pieces]))
        try:
            X, Z = self.model.stretch(points, groups)(
                self.X, self.Z[: self.model.sizes["z"]], self.P, controls
            )
        except ArithmeticError as error:
            raise Ended(self._failure(str(error), float(begin[0]), float(finish[-1]))) from None
        fractions = np.arange(1, points + 1) / points
        t = (begin[:, None] + (finish - begin)[:, None] * fractions).ravel()
        t[points - 1 :: points] = finish
        piece = np.repeat(pieces, points)
        return (
            np.append(self.t, t),
            np.concatenate((self.X[None], X)),
            np.concatenate((self.Z[None], Z)),
            np.append(piece[0], piece),
        )

    def between(
        self, P: Array, t: float, X: Array, Z: Array, end: float, piece: int, points: int
    ) -> tuple[Array, Array, Array]:
        """More samples strictly between two neighbouring ones of a phase."""
        control = np.concatenate(([0.0, t, end - t], self.inputs.C[piece]))[None]
        states, algebraics = self.model.stretch(points, 1)(X, Z, P, control)
        times = t + (end - t) * np.arange(1, points) / points
        return times, states[:-1].copy(), algebraics[:-1].copy()

    def _failure(self, why: str, begin: float, end: float) -> str:
        eq = self.equations
        rates = self.model.at("flow", self.t, self.X, self.Z, self.P, self.inputs.C[self.k])[0][:, 0]
        last = self.events[-1] if self.events else None
        return sentences.failed(eq.dae, why, begin, end, self.modes, self.X, rates, last)

    # -- what happens on a stretch ------------------------------------------------------------------------

    def _signs(self) -> Array:
        """+1 where a guard matters when it rises through 0, -1 where it matters when it falls, else 0."""
        signs = np.zeros(self.n_rows + len(self.equations.bounds))
        signs[self.n_rows :] = 1.0
        if self.n_rows:
            active = self.source == np.array(self.modes)[self.automaton]
            signs[: self.n_rows] = np.where(active, np.where(np.isnan(self.armed), 1.0, -1.0), 0.0)
        return signs

    def _first_crossing(
        self, t: Array, X: Array, Z: Array, piece: NDArray[np.int64]
    ) -> tuple[int, dict[int, tuple[float, float]]] | None:
        if not self.has_guards:
            return None
        guards, rates = (r[:, :, 0] for r in self.model.on("look", t, X, Z, self.P, self.inputs.C[piece]))
        signs = self._signs()
        matters = signs != 0
        h = np.where(matters, signs * guards, -1.0)
        h[0] = np.minimum(h[0], 0.0)  # what held at the start was dealt with there
        return first_crossing(t, h, np.where(matters, signs * rates, 0.0))

    def _cross(self, brackets: dict[int, tuple[float, float]], sample: float) -> None:
        """Locate the earliest of the crossings after the present sample, and handle it."""
        signs = self._signs()
        brackets = dict(brackets)
        best: tuple[float, Array, Array, int] | None = None
        while brackets:
            row, (guess, upper) = min(brackets.items(), key=lambda item: item[1])
            del brackets[row]
            if best is not None:
                upper = min(upper, best[0])
            found = self._locate(row, float(signs[row]), self.t, upper, min(guess, upper))
            if found is not None and (best is None or found[0] < best[0] - SAME_INSTANT):
                best = (*found, row)
        if (
            best is None
        ):  # the samples promised a crossing that the solution does not have: go on from the next
            X, Z = self._to(sample)
            self.phases[-1].add(np.array([sample]), X[None], Z[None], np.array([self.k]))
            self._move(sample, X, Z, self.k)
            return
        te, X, Z, row = best
        self.t, self.X, self.Z = te, X, Z
        dte = self._time_gradient(row)
        self.look_ahead = FIRST_LOOK
        if row >= self.n_rows:
            self._emit()
            self._leave_bounds(row - self.n_rows)
        self._emit()
        self._settle(dte, forced={row: signs[row] > 0})

    def _to(self, t: float) -> tuple[Array, Array]:
        """States a little after the present sample, by integrating there."""
        if t <= self.t:
            return self.X, self.Z
        _, X, Z, _ = self._integrate(np.array([self.t]), np.array([t]), 1)
        return X[-1].copy(), Z[-1].copy()

    def _locate(
        self, row: int, sign: float, low: float, high: float, guess: float
    ) -> tuple[float, Array, Array] | None:
        """Time at which sign * guard rises through zero in [low, high]: Newton from a guess, bracketed if it
        strays.

        None when the guard is not above zero at `high` after all.
        """

        def look(t: float) -> tuple[float, float, Array, Array]:
            X, Z = self._to(t)
            guard, rate = self.model.at("look", t, X, Z, self.P, self.inputs.C[self.k])
            return sign * float(guard[row, 0]), sign * float(rate[row, 0]), X, Z

        t = guess
        for _ in range(6):
            value, rate, X, Z = look(t)
            if not rate > 0:
                break
            step = value / rate
            if abs(step) <= LOCATED:
                return t, X, Z
            t -= step
            if not low <= t <= high:
                break
        value, rate, X, Z = look(high)
        if not value > 0:
            return None
        t = high
        while high - low > LOCATED:
            step = value / rate if rate > 0 else math.inf
            if abs(step) <= LOCATED:
                break
            t = t - step if low < t - step < high else 0.5 * (low + high)
            value, rate, X, Z = look(t)
            low, high = (low, t) if value > 0 else (t, high)
        return t, X, Z

    def _time_gradient(self, row: int) -> Array:
        """dt_e/dtheta of a crossing."""
        if not self.equations.nw:
            return np.zeros(0)
        C = self.inputs.C[self.k]
        _, rate = self.model.at("look", self.t, self.X, self.Z, self.P, C)
        (slope,) = self.model.at("cross", self.t, self.X, self.Z, self.P, C)
        with np.errstate(divide="ignore", invalid="ignore"):  # a grazing guard has no derivative: NaN says so
            return -slope[row] / rate[row, 0]

    def _next_timer(self) -> tuple[float, int]:
        """When the first armed row fires, and which."""
        if not self.n_rows or np.isnan(self.armed).all():
            return math.inf, -1
        fires = self.armed + self.held
        row = int(np.nanargmin(fires))
        return float(fires[row]), row

    def _fire_due(self) -> None:
        """Fire what has run out at this instant, before the inputs jump and its guard may lapse."""
        fires, row = self._next_timer()
        while fires <= self.t + SAME_INSTANT:
            self._fire(row)
            fires, row = self._next_timer()

    def _fire(self, row: int) -> None:
        """A timer has run out."""
        self.look_ahead = FIRST_LOOK
        self._settle(self.darmed[row] + self.dheld[row], due=row)

    # -- jumps --------------------------------------------------------------------------------------------

    def _settle(
        self, dte: Array, forced: dict[int, bool] | None = None, due: int | None = None, first: bool = False
    ) -> None:
        """Apply every row that is due at this instant, then start and stop timers.

        `forced` says which guards are known to be positive or not just after this instant, since their
        crossing was located here; `due` is a row whose timer has run out.
        """
        forced = dict(forced or {})
        if self.t - self.instant > SAME_INSTANT:
            self.instant, self.jumps_at_instant, self.visited = self.t, 0, []
        if first:
            self.phases.append(Phase(self.P, [], [], [], []))
        jumped = False
        while True:
            positive = self._positive(forced)
            ready = self._ready(positive, due)
            if ready is None:
                break
            if first and not jumped:
                self._emit()
            self._jump(*ready, dte)
            jumped, due = True, None
            forced = {r: v for r, v in forced.items() if self.automaton[r] != self.automaton[ready[0]]}
        if jumped:
            self._begin_phase(dte)
        elif first:
            self._make_consistent()
            self._emit()
        if self.n_rows:
            self._set_timers(positive, dte)

    def _positive(self, forced: dict[int, bool]) -> NDArray[np.bool_]:
        """Which guards are positive just after this instant."""
        if not self.n_rows:
            return np.zeros(0, dtype=bool)
        guards, rates = self.model.at("look", self.t, self.X, self.Z, self.P, self.inputs.C[self.k])
        g, rate = guards[: self.n_rows, 0], rates[: self.n_rows, 0]
        on_the_edge = np.abs(g) <= np.abs(rate) * SAME_INSTANT
        positive = np.where(on_the_edge, rate > 0, g > 0)
        for row, value in forced.items():
            positive[row] = value
        return positive

    def _ready(self, positive: NDArray[np.bool_], due: int | None) -> tuple[int, list[int]] | None:
        """First row that is due, and the further ones of the same automaton."""
        if not self.n_rows:
            return None
        active = self.source == np.array(self.modes)[self.automaton]
        timed_out = self.armed + self.held <= self.t + SAME_INSTANT
        ready = active & positive & ((self.held <= 0) | timed_out)
        if due is not None:
            ready[due] = True
        rows = np.flatnonzero(ready)
        if not len(rows):
            return None
        return int(rows[0]), [int(r) for r in rows[1:] if self.automaton[r] == self.automaton[rows[0]]]

    def _jump(self, row: int, ties: list[int], dte: Array) -> None:
        """Apply one row."""
        eq, C = self.equations, self.inputs.C[self.k]
        a, transition = eq.rows[row]
        automaton = eq.dae.automata[a]
        self._count_jump(automaton.path, transition.source, transition.target)
        x, nx = self.X.copy(), eq.nx
        moved = self.model.at("flow", self.t, self.X, self.Z, self.P, C)[0][:, 0]
        S = x[nx:].reshape(eq.nw, nx).T
        if row in self.model.resets:
            after, rate, slope = self.model.at(f"reset_{row}", self.t, self.X, self.Z, self.P, C)
            x[:nx], moved, S = after[:, 0], rate[:, 0], slope.reshape(nx, eq.nw)
        self.modes[a] = self.target[row]
        self.entry[a], self.dentry[a] = self.t, dte
        mine = self.automaton == a
        self.armed[mine] = np.nan
        self.X, self.P = x, self._parameters()
        self._make_consistent()
        if eq.nw:
            flow = self.model.at("flow", self.t, self.X, self.Z, self.P, C)[0][:, 0]
            self.X[nx:] = (S + np.outer(moved - flow, dte)).T.ravel()
            self._make_consistent()
        grad = {c.name: float(d) / c.scale + 0.0 for c, d in zip(eq.columns, dte, strict=True)}
        tie = tuple(eq.rows[r][1].text for r in ties)
        self.events.append(
            Event(self.t, automaton.path, transition.source, transition.target, transition.text, tie, grad)
        )
        if len(self.events) > MAX_EVENTS:
            raise Ended(sentences.too_many_events(self.t))

    def _count_jump(self, path: str, source: str, target: str) -> None:
        self.jumps_at_instant += 1
        self.visited.append(f"{path}: {source} -> {target}")
        if self.jumps_at_instant > MAX_JUMPS_AT_ONCE:
            raise Ended(sentences.chatter(self.t, self.visited))

    def _set_timers(self, positive: NDArray[np.bool_], dte: Array) -> None:
        active = self.source == np.array(self.modes)[self.automaton]
        for row in np.flatnonzero((self.held > 0) & active):
            if not positive[row]:
                self.armed[row] = np.nan
            elif np.isnan(self.armed[row]):
                self.armed[row], self.darmed[row] = self.t, dte

    # -- helpers ------------------------------------------------------------------------------------------

    def _parameters(self) -> Array:
        eq = self.equations
        flags = [a.flags[m] for a, m in zip(eq.dae.automata, self.modes, strict=True)]
        return np.concatenate((self.p, *flags, self.entry, self.dentry.T.ravel()))

    def _begin_phase(self, dte: Array) -> None:
        """Start a new phase with the present values as its first sample."""
        if len(self.phases) > 1 and len(self.phases[-1].t) == 1 and self.phases[-1].t[0][0] == self.t:
            self.phases.pop()  # a state passed through at this instant: a time stands at most twice
            self.break_grad.pop()
        self.break_grad.append(dte.copy())
        self.phases.append(Phase(self.P, [], [], [], []))
        self._make_consistent()
        self._emit()

    def _emit(self) -> None:
        """Store the present values as a sample, once."""
        phase = self.phases[-1]
        if phase.t and phase.t[-1][-1] == self.t:
            return
        phase.add(np.array([self.t]), self.X[None], self.Z[None], np.array([self.k]))

    def _make_consistent(self) -> None:
        """Solve 0 = g for the algebraic variables and their sensitivities at the present states."""
        eq = self.equations
        if not eq.nz:
            return
        C = self.inputs.C[self.k]
        for _ in range(50):
            residual, jacobian, slope = self.model.at("algebra", self.t, self.X, self.Z, self.P, C)
            step = np.linalg.solve(jacobian, residual[:, 0])
            self.Z[: eq.nz] -= step
            if np.abs(step).max() < 1e-12 * (1 + np.abs(self.Z[: eq.nz]).max()):
                break
        else:
            raise Ended(sentences.not_consistent(eq.dae, self.t))
        if eq.nw:
            self.Z[eq.nz :] = -np.linalg.solve(jacobian, slope).T.ravel()

    def _check_bounds(self) -> None:
        for number, (k, sign, bound) in enumerate(self.equations.bounds):
            if sign * (self.X[k] - bound) > 1e-9 * (1 + abs(bound)):
                self._leave_bounds(number)

    def _leave_bounds(self, number: int) -> None:
        raise Ended(sentences.left_bounds(self.equations.dae, *self.equations.bounds[number], self.t))
