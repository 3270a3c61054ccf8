"""One run of the kernel as a trajectory."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from ctypes import byref
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dcvrt.integrators import sentences
from dcvrt.integrators.compiler import Compiler
from dcvrt.integrators.corners import LEVELS, MISSED, POINTS, SHARPER
from dcvrt.integrators.equations import Equations
from dcvrt.integrators.kernel import Kernel
from dcvrt.integrators.kernel.build import build_object
from dcvrt.integrators.kernel.library import (
    Corners,
    InputTable,
    Library,
    Options,
    Record,
    Task,
    doubles,
    view,
)
from dcvrt.integrators.kernel.model import ModelText
from dcvrt.trajectory import COMPLETED, Event, LateSignals, Signals, Slopes, Trajectory

Array = NDArray[np.float64]
THETA_LOOSER, THETA_SHARE = 10.0, 0.1
"""A sensitivity's tolerance: so many times the relative one, of |S| + share times its largest element."""
WATCH_TOLERANCE = 1e-5
"""What cubics between nodes of the watched outputs may miss, over the largest value so far."""
LONGEST_BETWEEN_GUARDS = 0.02
"""Guards are looked at where steps end, and on the cubic between: no step is longer than this, s."""
KEPT_PLACES = 2
"""Finished runs whose memory is kept: fresh memory costs more than the run that fills it."""
WHY = {
    4: "the step size became too small",
    5: "more steps than max_steps = {max_steps}",
    6: "the state is no longer a finite number",
    8: "there is no memory left",
}


class KernelModel:
    """A compiled system and the calls that run it."""

    def __init__(
        self, equations: Equations, solver: Kernel, compiler: Compiler, watched: Sequence[str] = ()
    ) -> None:
        self.equations, self.solver = equations, solver
        assert solver.method is not None
        self.text = ModelText(equations, watched, implicit=solver.method == "rosenbrock")
        self.library = Library(build_object(self.text, solver.method, compiler), equations)
        self.backend = f"compiled by {compiler}, {self.library.lanes} lanes"
        eq = equations
        self.width = eq.nx * (1 + eq.nw)
        self.event_width = 2 + len(eq.rows) + eq.nw
        self.has_guards = bool(eq.rows or eq.bounds)
        automata = eq.dae.automata
        self.start_texts = tuple(f"{a.path}: {a.start}" for a in automata)
        self.row_texts = tuple(f"{automata[a].path}: {r.source} -> {r.target} [{r.text}]" for a, r in eq.rows)
        """What a sequence of modes begins with, and what each row adds to it."""
        self.places: list[int] = []  # memory of finished runs, for the next ones

    def __del__(self) -> None:
        for keep in getattr(self, "places", ()):
            self.library.dll.keep_free(keep)

    def options(self, save_at: float, samples: bool) -> Options:
        """Options of the driver."""
        solver = self.solver
        longest = LONGEST_BETWEEN_GUARDS if self.has_guards else np.inf
        return Options(
            solver.rtol, solver.atol, THETA_LOOSER * solver.rtol, THETA_SHARE, save_at, longest,
            WATCH_TOLERANCE, solver.max_steps, samples, samples, 0,
        )  # fmt: skip

    def rests(self, P: Array, first: Array, first_tangent: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Equilibria of many cases with scaled sensitivities: X, Z, and which cases have one.

        Arguments have a row each case: parameters, first values of the inputs (cases, inputs), and their
        derivatives by every theta (cases, inputs, thetas).
        """
        eq, n = self.equations, len(P)
        tangent = np.zeros((n, eq.nw, 0))
        if eq.tangents and eq.voltage is not None:
            tangent = (first_tangent[:, list(eq.voltage)] * eq.scale).transpose(0, 2, 1)
        given = [np.ascontiguousarray(a, dtype=float) for a in (P, first, tangent)]
        X, Z = np.zeros((n, self.width)), np.zeros((n, eq.nz * (1 + eq.nw)))
        found = np.zeros(n, dtype=ctypes.c_int)
        self.library.dll.rests_of(n, *(a.ctypes.data for a in (*given, X, Z, found)))
        return X, Z, found.astype(bool)

    def run(self, inputs: InputTable, p: Array, X: Array, Z: Array, save_at: float) -> KernelRun:
        """Run one case."""
        return KernelRun(self, inputs, p, X, Z, save_at)

    def events(self, rows: Array) -> tuple[Event, ...]:
        """Event objects from the driver's rows of numbers."""
        eq, n, made = self.equations, len(self.equations.rows), []
        names, scale = [c.name for c in eq.columns], np.append(np.ones(2 + n), eq.scale)
        for numbers in (rows / scale + 0.0).tolist():
            a, row = eq.rows[int(numbers[1])]
            tie: tuple[str, ...] = ()
            if any(numbers[2 : 2 + n]):
                tie = tuple(eq.rows[k][1].text for k in range(n) if numbers[2 + k])
            grad = dict(zip(names, numbers[2 + n :], strict=True))
            path = eq.dae.automata[a].path
            made.append(Event(numbers[0], path, row.source, row.target, row.text, tie, grad))
        return tuple(made)

    def sentence(self, result: Any, events: Sequence[Event]) -> str:
        """Status of a case."""
        eq, dae = self.equations, self.equations.dae
        match result.status:
            case 0:
                return COMPLETED
            case 1:
                state, sign, bound = eq.bounds[result.detail]
                return sentences.left_bounds(dae, state, sign, bound, result.t)
            case 2:
                rows = [eq.rows[k] for k in result.visited[: sentences.MAX_JUMPS_AT_ONCE + 1]]
                visited = (f"{dae.automata[a].path}: {r.source} -> {r.target}" for a, r in rows)
                return sentences.chatter(result.t, visited)
            case 3:
                return sentences.too_many_events(result.t)
            case 7:
                return sentences.not_consistent(dae, result.failed_from)
            case status:
                why = WHY[status].format(max_steps=self.solver.max_steps)
                last = events[-1] if events else None
                modes = list(result.mode)[: eq.na]
                x, rate = np.array(result.x), np.array(result.rate)
                return sentences.failed(dae, why, result.failed_from, result.failed_to, modes, x, rate, last)


class KernelRun:
    """One case, run; it stays in the driver's memory so that steps can be evaluated again."""

    def __init__(
        self, model: KernelModel, inputs: InputTable, p: Array, X: Array, Z: Array, save_at: float
    ) -> None:
        self.model = model
        self.p = np.ascontiguousarray(p, dtype=float)
        X, Z = (np.ascontiguousarray(a, dtype=float) for a in (X, Z))
        self.inputs = inputs
        self.task = Task(doubles(self.p), doubles(X), doubles(Z), ctypes.pointer(self.inputs.struct))
        options = model.options(save_at, True)
        dll = model.library.dll
        self.keep: int | None = None
        try:
            self.keep = model.places.pop()
        except IndexError:
            self.keep = dll.keep_new()
        if not self.keep:
            raise MemoryError
        self.result, self.record, self.sampled = model.library.Result(), Record(), False
        if not dll.keep_run(
            self.keep, byref(self.task), byref(options), byref(self.result), byref(self.record)
        ):
            raise MemoryError
        events = view(self.record.event, self.record.events, model.event_width)
        self.events = model.events(events)
        self.status = model.sentence(self.result, self.events)

    def __del__(self) -> None:
        keep, self.keep = getattr(self, "keep", None), None
        if keep and len(self.model.places) < KEPT_PLACES:
            self.model.places.append(keep)
        elif keep:
            self.model.library.dll.keep_free(keep)

    def states(self, t: Array, step: NDArray[np.int64]) -> tuple[Array, Array]:
        """States and algebraic variables (with sensitivities) at times of steps, by the dense output."""
        t, step = np.ascontiguousarray(t, dtype=float), np.ascontiguousarray(step, dtype=ctypes.c_long)
        eq = self.model.equations
        x, z = np.zeros((len(t), self.model.width)), np.zeros((len(t), eq.nz * (1 + eq.nw)))
        self.model.library.dll.keep_states(self.keep, len(t), *(a.ctypes.data for a in (t, step, x, z)))
        return x, z

    def outputs(
        self,
        t: Array,
        x: Array,
        z: Array,
        piece: NDArray[np.int64],
        phase: NDArray[np.int64],
        with_theta: bool = False,
    ) -> list[Array]:
        """Outputs and rates (n, outputs); on request their derivatives by theta (n, outputs, thetas)."""
        eq = self.model.equations
        n, ny = len(t), eq.dae.y.numel()
        shapes = [(n, ny), (n, ny), (n, ny, eq.nw), (n, ny, eq.nw)]
        results = [np.empty(shape) for shape in shapes[: 4 if with_theta else 2]]
        given = [np.ascontiguousarray(a) for a in (t, x, z, piece, phase)]
        pointers = [a.ctypes.data for a in (*given, *results)] + [None] * (4 - len(results))
        if not self.model.library.dll.outputs_on(byref(self.task), self.record.phase, n, *pointers):
            raise MemoryError
        return results

    def trajectory(self, wrt: tuple[str, ...], name: str) -> Trajectory:
        """Signals on the samples, with samples added at corners of the outputs."""
        eq, r = self.model.equations, self.record
        corners = Corners(MISSED, SHARPER, POINTS, LEVELS)
        if not self.sampled and not self.model.library.dll.keep_samples(self.keep, byref(corners), byref(r)):
            raise MemoryError
        self.sampled = True  # what signals read later stays where it is
        dae, n, ny = eq.dae, r.samples, eq.dae.y.numel()
        t = view(r.sample_t, n).copy()
        y, rate = (view(a, n, ny).copy() for a in (r.sample_y, r.sample_rate))
        x, z = view(r.sample_x, n, self.model.width), view(r.sample_z, n, eq.nz * (1 + eq.nw))

        def signals(names: tuple[str, ...], values: Array, rates: Array | None, slopes: Slopes) -> Signals:
            return LateSignals(names, values, rates, slopes) if eq.nw else Signals(names, values, rates)

        breaks = view(r.dbreak, r.breaks, eq.nw) / (eq.scale if eq.nw else 1.0)
        return Trajectory(
            t=t,
            outputs=signals(dae.y_names, y, rate, self._output_slopes),
            states=signals(dae.x_names, x[:, : eq.nx].copy(), None, partial(_by_theta, self, x, eq.nx)),
            algebraics=signals(dae.z_names, z[:, : eq.nz].copy(), None, partial(_by_theta, self, z, eq.nz)),
            events=self.events,
            status=self.status,
            parameters=dict(zip(dae.p_names, self.p.tolist(), strict=True)),
            wrt=wrt,
            start_modes={a.path: a.start for a in dae.automata},
            break_grad=breaks,
            name=name,
        )

    def _output_slopes(self) -> tuple[Array, Array]:
        """Derivatives of outputs and their rates by theta, on the samples."""
        r, eq, n = self.record, self.model.equations, self.record.samples
        x, z = view(r.sample_x, n, self.model.width), view(r.sample_z, n, eq.nz * (1 + eq.nw))
        piece, phase = view(r.sample_piece, n), view(r.sample_phase, n)
        _, _, sens, rate_sens = self.outputs(view(r.sample_t, n), x, z, piece, phase, True)
        return sens, rate_sens


def _by_theta(run: KernelRun, flat: Array, rows: int) -> tuple[Array, None]:
    """Derivatives by the thetas themselves (samples, rows, thetas) from the driver's flat vectors, which live
    as long as the run."""
    scale = run.model.equations.scale
    by_theta = flat[:, rows:] / np.repeat(scale, rows)
    return by_theta.reshape(len(flat), len(scale), rows).transpose(0, 2, 1), None
