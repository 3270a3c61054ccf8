"""Many cases of one system: in the lanes of the driver, on threads, with functionals inside."""

from __future__ import annotations

import ctypes
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from ctypes import addressof, byref, c_void_p, sizeof
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dcvrt.functionals import Outcome
from dcvrt.integrators.kernel.functionals import Results, Table
from dcvrt.integrators.kernel.library import (
    BYTES,
    DOUBLES,
    FunctionalResults,
    InputTable,
    Options,
    Work,
    view,
)
from dcvrt.integrators.kernel.run import KernelModel

Array = NDArray[np.float64]
SHARE_OF_A_THREAD = 4
"""Pieces of work per thread: more even out cases of different length, fewer keep the lanes full."""


class Ensemble:
    """Cases of one model, run together.

    Parameters
    ----------
    model : compiled with the outputs that the functionals read.
    inputs : table of the inputs of every case; cases may share one.
    P, X, Z : parameters and start values, a row each case.
    functionals : what is computed of every completed case.
    """

    def __init__(
        self,
        model: KernelModel,
        inputs: Sequence[InputTable],
        P: Array,
        X: Array,
        Z: Array,
        functionals: Table | None,
    ) -> None:
        self.model, self.cases = model, len(inputs)
        self.inputs = list(inputs)
        self.P, self.X, self.Z = (np.ascontiguousarray(a, dtype=float) for a in (P, X, Z))
        self.table = functionals if functionals is not None and len(functionals) else None
        #: `struct task` of every case: addresses of its p, x, z and inputs
        self.tasks = np.zeros((self.cases, 4), dtype=np.uintp)
        for column, a in enumerate((self.P, self.X, self.Z)):
            self.tasks[:, column] = a.ctypes.data + np.arange(self.cases, dtype=np.uintp) * a.strides[0]
        self.tasks[:, 3] = [addressof(table.struct) for table in self.inputs]
        self.results = (model.library.Result * self.cases)()
        self.found: Results | None = (
            self.table.results(self.cases, model.equations.nw) if self.table else None
        )
        self._run()

    def _run(self) -> None:
        model, threads = self.model, self.model.solver.threads
        options = model.options(np.inf, False)
        options.nodes = options.steps = self.table is not None
        least = model.library.lanes
        share = max(-(-self.cases // (threads * SHARE_OF_A_THREAD)), least) if threads > 1 else self.cases
        pieces = [(k, min(k + share, self.cases)) for k in range(0, self.cases, share)]
        if threads == 1 or len(pieces) == 1:
            done = [self._piece(options, *piece) for piece in pieces]
        else:
            with ThreadPoolExecutor(threads) as pool:
                done = list(pool.map(lambda piece: self._piece(options, *piece), pieces))
        #: the driver's rows of numbers, per case
        self.events = [
            view(r.event, r.events, model.event_width).copy() if all(done) else np.zeros((0, 0))
            for r in self.results
        ]
        model.library.dll.results_free(byref(self.results), self.cases)
        if not all(done):
            raise MemoryError

    def _piece(self, options: Options, first: int, last: int) -> bool:
        """Run some of the cases; the interpreter is free meanwhile."""
        work = Work()
        work.task = self.tasks[first:].ctypes.data
        work.options = ctypes.pointer(options)
        work.result = addressof(self.results) + first * sizeof(self.model.library.Result)
        work.cases = last - first
        if self.table is not None and self.found is not None:
            work.functional = c_void_p(self.table.rows.ctypes.data)
            work.functionals = len(self.table)
            f = self.found
            kinds: list[Any] = [DOUBLES, DOUBLES, DOUBLES, BYTES, BYTES]
            arrays: list[NDArray[Any]] = [f.value, f.time, f.gradient, f.place, f.tie]
            at = [ctypes.cast(a[first:].ctypes.data, kind) for a, kind in zip(arrays, kinds, strict=True)]
            work.functional_results = FunctionalResults(*at)
        return bool(self.model.library.dll.run_many_lanes(byref(work)))

    def status(self, case: int) -> str:
        """How a case ended."""
        result = self.results[case]
        return self.model.sentence(result, self.model.events(self.events[case]) if result.status else ())

    def sequence(self, case: int) -> tuple[str, ...]:
        """Modes visited, as :attr:`Trajectory.sequence`."""
        texts, rows = self.model.row_texts, self.events[case][:, 1].astype(int).tolist()
        return (*self.model.start_texts, *(texts[row] for row in rows))

    def outcomes(self) -> Iterable[Mapping[str, Outcome]]:
        """Functionals of every case; of no use where it did not complete."""
        if self.table is None or self.found is None:
            return [{}] * self.cases
        eq = self.model.equations
        return self.found.outcomes(self.table, [c.name for c in eq.columns], eq.scale)
