"""One run of the kernel as a trajectory."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from ctypes import byref
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dcvrt.integrators import sentences
from dcvrt.integrators.channels import Channels
from dcvrt.integrators.compiler import Compiler
from dcvrt.integrators.corners import LEVELS, MISSED, POINTS, SHARPER
from dcvrt.integrators.equations import Equations
from dcvrt.integrators.kernel import Kernel
from dcvrt.integrators.kernel.build import build_object
from dcvrt.integrators.kernel.library import InputTable, Library, Options, Record, Task, doubles, view
from dcvrt.integrators.kernel.model import ModelText
from dcvrt.trajectory import COMPLETED, Event, Signals, Trajectory

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

    def run(self, channels: Channels, p: Array, X: Array, Z: Array, save_at: float) -> KernelRun:
        """Run one case."""
        return KernelRun(self, channels, p, X, Z, save_at)

    def events(self, rows: Array) -> tuple[Event, ...]:
        """Event objects from the driver's rows of numbers."""
        eq = self.equations
        automata, n = eq.dae.automata, len(eq.rows)
        made = []
        for numbers in rows.tolist():
            a, row = eq.rows[int(numbers[1])]
            tie = tuple(eq.rows[k][1].text for k in range(n) if numbers[2 + k])
            grad = {c.name: g / c.scale + 0.0 for c, g in zip(eq.columns, numbers[2 + n :], strict=True)}
            made.append(Event(numbers[0], automata[a].path, row.source, row.target, row.text, tie, grad))
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
        self, model: KernelModel, channels: Channels, p: Array, X: Array, Z: Array, save_at: float
    ) -> None:
        self.model = model
        self.p = np.ascontiguousarray(p, dtype=float)
        X, Z = (np.ascontiguousarray(a, dtype=float) for a in (X, Z))
        self.inputs = InputTable(model.equations, channels)
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
        self.result, self.record = model.library.Result(), Record()
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

    def corners(self, samples: Samples) -> NDArray[np.int64]:
        """Intervals in which some output turns a corner that the cubic between two samples misses."""
        found = np.zeros(len(samples.t), dtype=ctypes.c_long)
        given = (samples.t, samples.y, samples.rate, samples.phase)
        count = self.model.library.dll.corners_at(
            len(found), *(a.ctypes.data for a in given), MISSED, SHARPER, found.ctypes.data
        )
        return found[:count]

    def samples(self) -> Samples:
        """Samples of the run, with more of them at corners of the outputs."""
        r, width, nz = self.record, self.model.width, self.model.equations.nz
        n = r.samples
        t, x = view(r.sample_t, n), view(r.sample_x, n, width)
        z = view(r.sample_z, n, nz * (1 + self.model.equations.nw))
        piece, phase, step = (view(p, n) for p in (r.sample_piece, r.sample_phase, r.sample_step))
        y, rate = self.outputs(t, x, z, piece, phase)
        samples = Samples(t, piece, phase, step, y, rate, ((x, z),), np.arange(n))
        for _ in range(LEVELS):
            at = self.corners(samples)
            if not len(at):
                break
            samples = samples.with_more(at, self._between(samples, at))
        return samples

    def _between(self, s: Samples, at: NDArray[np.int64]) -> Samples:
        """More samples strictly inside some intervals."""
        inside = POINTS - 1
        t = (s.t[at][:, None] + (s.t[at + 1] - s.t[at])[:, None] * np.arange(1, POINTS) / POINTS).ravel()
        step, phase = np.repeat(s.step[at + 1], inside), np.repeat(s.phase[at + 1], inside)
        x, z = self.states(t, step)
        low, high = np.repeat(s.piece[at], inside), np.repeat(s.piece[at + 1], inside)
        piece = np.clip(np.searchsorted(self.inputs.start, t, side="right") - 1, low, high)
        y, rate = self.outputs(t, x, z, piece, phase)
        return Samples(t, piece, phase, step, y, rate, ((x, z),), np.arange(len(t)))

    def trajectory(self, wrt: tuple[str, ...], name: str) -> Trajectory:
        """Signals on the samples, with samples added at corners of the outputs."""
        eq, r = self.model.equations, self.record
        dae, samples = eq.dae, self.samples()
        n = len(samples.t)
        x, z = samples.assembled()
        sens = rate_sens = x_sens = z_sens = None
        if eq.nw:
            _, _, sens, rate_sens = self.outputs(samples.t, x, z, samples.piece, samples.phase, True)
            sens /= eq.scale
            rate_sens /= eq.scale
            x[:, eq.nx :] /= np.repeat(eq.scale, eq.nx)
            z[:, eq.nz :] /= np.repeat(eq.scale, eq.nz)
            x_sens = x[:, eq.nx :].reshape(n, eq.nw, eq.nx).transpose(0, 2, 1)
            z_sens = z[:, eq.nz :].reshape(n, eq.nw, eq.nz).transpose(0, 2, 1)
        breaks = view(r.dbreak, r.breaks, eq.nw) / (eq.scale if eq.nw else 1.0)
        return Trajectory(
            t=samples.t.copy(),
            outputs=Signals(dae.y_names, samples.y, samples.rate, sens, rate_sens),
            states=Signals(dae.x_names, x[:, : eq.nx], None, x_sens),
            algebraics=Signals(tuple(row.path for row in dae.algebraics), z[:, : eq.nz], None, z_sens),
            events=self.events,
            status=self.status,
            parameters=dict(zip(dae.p_names, self.p.tolist(), strict=True)),
            wrt=wrt,
            start_modes={a.path: a.start for a in dae.automata},
            break_grad=breaks,
            name=name,
        )


@dataclass(frozen=True, eq=False)
class Samples:
    """Samples in order of time; states stay where they were computed until all samples are there.

    Attributes
    ----------
    t, piece, phase, step : time of each sample, piece of the inputs, phase of the modes, step of the run.
    y, rate : outputs and their rates.
    stores : states and algebraic variables, in the order in which they were computed.
    order : number of each sample in that order.
    """

    t: Array
    piece: NDArray[np.int64]
    phase: NDArray[np.int64]
    step: NDArray[np.int64]
    y: Array
    rate: Array
    stores: tuple[tuple[Array, Array], ...]
    order: NDArray[np.int64]

    def with_more(self, at: NDArray[np.int64], new: Samples) -> Samples:
        """These and new samples inside the intervals `at`, equally many in each."""
        place = np.repeat(at + 1, len(new.t) // len(at))

        def merged(old: NDArray[Any], more: NDArray[Any]) -> NDArray[Any]:
            return np.insert(old, place, more, axis=0)

        return Samples(
            merged(self.t, new.t),
            merged(self.piece, new.piece),
            merged(self.phase, new.phase),
            merged(self.step, new.step),
            merged(self.y, new.y),
            merged(self.rate, new.rate),
            self.stores + new.stores,
            merged(self.order, len(self.t) + new.order),
        )

    def assembled(self) -> list[Array]:
        """States and algebraic variables in order, for the caller to keep."""
        whole = [np.empty((len(self.t), a.shape[1])) for a in self.stores[0]]
        begin = 0
        for store in self.stores:
            end = begin + len(store[0])
            rows = np.flatnonzero((self.order >= begin) & (self.order < end))
            for into, part in zip(whole, store, strict=True):
                into[rows] = part
            begin = end
        return whole
