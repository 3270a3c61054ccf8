"""Many runs of one simulator: a row each, with failures kept and labelled."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dcvrt.criteria import Criteria, Margins
from dcvrt.errors import InputError, SimulationError
from dcvrt.functionals import Functional, Outcome, evaluate
from dcvrt.integrators.asked import Asked
from dcvrt.trajectory import COMPLETED, Trajectory
from dcvrt.waveform import Waveform

if TYPE_CHECKING:
    import pandas as pd

    from dcvrt.integrators.simulator import Simulator

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class BatchResult:
    """Outcome of every case in order.

    Attributes
    ----------
    parameters : values that the table gave, one mapping per case.
    status : ``"completed"`` or the sentence that says why not.
    margins : margins of each case, None where the run failed or no criteria were given.
    runs : trajectories when `keep` was asked for, else None.
    functionals : those asked for, by name; none where the run failed.
    started : whether the case had an equilibrium to start from.
    """

    waveforms: tuple[str, ...]
    parameters: tuple[Mapping[str, float], ...]
    status: tuple[str, ...]
    margins: tuple[Margins | None, ...]
    runs: tuple[Trajectory | None, ...]
    functionals: tuple[Mapping[str, Outcome], ...]
    started: tuple[bool, ...]

    def __len__(self) -> int:
        return len(self.status)

    @property
    def failed(self) -> tuple[int, ...]:
        """Numbers of the cases without a result."""
        return tuple(k for k, s in enumerate(self.status) if s != COMPLETED)

    def rows(self) -> list[dict[str, Any]]:
        """One flat mapping per case: parameters, functionals, margins, diagnostics, sequence, status."""
        result = []
        for name, values, status, m, found in zip(
            self.waveforms, self.parameters, self.status, self.margins, self.functionals, strict=True
        ):
            row: dict[str, Any] = {"waveform": name, **values}
            for column, outcome in found.items():
                row |= outcome.flat(column)
            if m is not None:
                row |= m.flat()
            row["status"] = status
            result.append(row)
        return result

    def table(self) -> pd.DataFrame:
        """The rows as a DataFrame; a failed case has no margins (NaN) and says why in `status`."""
        import pandas as pd

        return pd.DataFrame(self.rows())


def run_batch(
    simulator: Simulator,
    waveforms: Sequence[Waveform],
    table: Mapping[str, float | Sequence[float]],
    criteria: Criteria | None,
    keep: bool,
    functionals: Mapping[str, Functional] | None = None,
) -> BatchResult:
    """Run every case of the table."""
    cases, P = _cases(simulator, waveforms, table)
    span = min(w.until - w.start for w, _ in cases)
    asked = Asked.of(criteria, functionals, simulator.dae.y_names, simulator.dae.p_names, span)
    if simulator._on_kernel():
        answers = _on_kernel(simulator, [w for w, _ in cases], P, asked)
    else:
        answers = [_one_run(simulator, w, values, asked, keep) for w, values in cases]
    runs = [answer.run for answer in answers]
    if keep and simulator._on_kernel():
        runs = [_kept(simulator, w, values) for w, values in cases]
    return BatchResult(
        tuple(w.name for w, _ in cases),
        tuple(v for _, v in cases),
        tuple(answer.status for answer in answers),
        tuple(answer.margins for answer in answers),
        tuple(runs),
        tuple(answer.functionals for answer in answers),
        tuple(answer.started for answer in answers),
    )


@dataclass(frozen=True, eq=False)
class _Answer:
    """Outcome of one case."""

    status: str
    margins: Margins | None = None
    functionals: Mapping[str, Outcome] = field(default_factory=dict)
    run: Trajectory | None = None
    started: bool = True

    @classmethod
    def of(
        cls, asked: Asked, found: Mapping[str, Outcome], sequence: tuple[str, ...], run: Trajectory | None
    ) -> _Answer:
        """Answer of a completed run; a run that cannot be judged is a failed one."""
        try:
            return cls(COMPLETED, *asked.answers(found, sequence), run)
        except SimulationError as error:
            return cls(str(error), run=run)


def _one_run(
    simulator: Simulator, waveform: Waveform, values: Mapping[str, float], asked: Asked, keep: bool
) -> _Answer:
    """A case by a run of its own."""
    try:
        run = simulator.attempt(waveform, None, **values)
    except SimulationError as error:
        return _Answer(str(error), started=False)
    kept = run if keep else None
    if not run.completed:
        return _Answer(run.status, run=kept)
    return _Answer.of(asked, evaluate(asked.everything, run), run.sequence, kept)


def _on_kernel(simulator: Simulator, waveforms: Sequence[Waveform], P: Array, asked: Asked) -> list[_Answer]:
    """All cases in the lanes of the kernel."""
    from dcvrt.integrators.kernel.ensemble import Ensemble
    from dcvrt.integrators.kernel.functionals import Table, watched

    tangents = any(name in w.tangents for w in waveforms for name in simulator.wrt)
    kernel = simulator._kernel(tangents, watched(asked.everything))
    tables = [simulator._table(kernel, w) for w in waveforms]
    X, Z, unstarted = simulator._begin_all(kernel, [channels for channels, _ in tables], P)
    answers = {k: _Answer(message, started=False) for k, message in unstarted.items()}
    started = [k for k in range(len(P)) if k not in unstarted]
    if started:
        wanted = Table.of(asked.everything, values_only=asked.values_only) if asked.everything else None
        inputs = [tables[k][1] for k in started]
        ensemble = Ensemble(kernel, inputs, P[started], X[started], Z[started], wanted)
        for number, (k, found) in enumerate(zip(started, ensemble.outcomes(), strict=True)):
            status = ensemble.status(number)
            answers[k] = (
                _Answer.of(asked, found, ensemble.sequence(number), None)
                if status == COMPLETED
                else _Answer(status)
            )
    return [answers[k] for k in range(len(P))]


def _kept(simulator: Simulator, waveform: Waveform, values: Mapping[str, float]) -> Trajectory | None:
    """The trajectory of a case, by a run of its own; none without an equilibrium."""
    try:
        return simulator.attempt(waveform, None, **values)
    except SimulationError:
        return None


def only_waveform(waveform: object) -> None:
    """Refuse what is no waveform.

    Raises
    ------
    InputError
        With the ways to make one.
    """
    if not isinstance(waveform, Waveform):
        raise InputError(
            f"{waveform!r} is no waveform. Way out: Waveform.sag(...), Waveform.ercot_style(), "
            "Waveform.from_csv(path) or Waveform(t, v)."
        )


def _cases(
    simulator: Simulator, waveforms: Sequence[Waveform], table: Mapping[str, float | Sequence[float]]
) -> tuple[list[tuple[Waveform, dict[str, float]]], Array]:
    """Waveform and values of every case, and all parameters as rows."""
    if isinstance(waveforms, Waveform):
        waveforms = [waveforms]
    for waveform in waveforms if not isinstance(waveforms, str) else [waveforms]:
        only_waveform(waveform)
    columns = {
        k: [float(value) for value in v]
        for k, v in table.items()
        if not isinstance(v, (int, float)) and hasattr(v, "__len__")
    }
    lengths = {f"{k!r}": len(v) for k, v in columns.items()}
    if len(waveforms) != 1:
        lengths["waveforms"] = len(waveforms)
    if not len(waveforms) or 0 in lengths.values():
        empty = [k for k, n in lengths.items() if n == 0]
        raise InputError(f"batch: there is nothing to run: {', '.join(empty)} is empty.")
    if len(set(lengths.values())) > 1:
        told = ", ".join(f"{k} has {n}" for k, n in lengths.items())
        raise InputError(f"batch: columns differ in length: {told}. Give one value for all or one per case.")
    n = next(iter(lengths.values()), 1)
    shared = {k: float(v) for k, v in table.items() if k not in columns}  # type: ignore[arg-type]
    rows = zip(*columns.values(), strict=True) if columns else [()] * n
    cases = [
        (waveform, shared | dict(zip(columns, row, strict=True)))
        for waveform, row in zip(waveforms if len(waveforms) > 1 else [*waveforms] * n, rows, strict=True)
    ]
    return cases, simulator.dae.parameter_cases([values for _, values in cases], "batch")
