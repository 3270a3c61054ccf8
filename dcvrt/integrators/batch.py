"""Many runs of one simulator: a row each, with failures kept and labelled."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from dcvrt.criteria import Criteria, Margins, margins, only_criteria
from dcvrt.errors import InputError, SimulationError, raise_all
from dcvrt.trajectory import COMPLETED, Trajectory
from dcvrt.waveform import Waveform

if TYPE_CHECKING:
    import pandas as pd

    from dcvrt.integrators.simulator import Simulator


@dataclass(frozen=True, eq=False)
class BatchResult:
    """Outcome of every case in order.

    Attributes
    ----------
    parameters : values that the table gave, one mapping per case.
    status : ``"completed"`` or the sentence that says why not.
    margins : margins of each case, None where the run failed or no criteria were given.
    runs : trajectories when `keep` was asked for, else None.
    """

    waveforms: tuple[str, ...]
    parameters: tuple[Mapping[str, float], ...]
    status: tuple[str, ...]
    margins: tuple[Margins | None, ...]
    runs: tuple[Trajectory | None, ...]

    def __len__(self) -> int:
        return len(self.status)

    @property
    def failed(self) -> tuple[int, ...]:
        """Numbers of the cases without a result."""
        return tuple(k for k, s in enumerate(self.status) if s != COMPLETED)

    def rows(self) -> list[dict[str, Any]]:
        """One flat mapping per case: parameters, margins with gradients, diagnostics, sequence, status."""
        result = []
        for name, values, status, m in zip(
            self.waveforms, self.parameters, self.status, self.margins, strict=True
        ):
            row: dict[str, Any] = {"waveform": name, **values}
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
) -> BatchResult:
    """Run every case of the table."""
    if criteria is not None:
        only_criteria(criteria)
    cases = _cases(simulator, waveforms, table)
    status: list[str] = []
    found: list[Margins | None] = []
    runs: list[Trajectory | None] = []
    for waveform, values in cases:
        run: Trajectory | None = None
        try:
            run = simulator.attempt(waveform, None, **values)
            outcome = run.status
        except SimulationError as error:
            outcome = str(error)
        status.append(outcome)
        done = run is not None and run.completed
        found.append(margins(run, criteria) if run is not None and done and criteria is not None else None)
        runs.append(run if keep else None)
    return BatchResult(
        tuple(w.name for w, _ in cases), tuple(v for _, v in cases), tuple(status), tuple(found), tuple(runs)
    )


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
) -> list[tuple[Waveform, dict[str, float]]]:
    if isinstance(waveforms, Waveform):
        waveforms = [waveforms]
    for waveform in waveforms if not isinstance(waveforms, str) else [waveforms]:
        only_waveform(waveform)
    columns = {
        k: list(v) for k, v in table.items() if not isinstance(v, (int, float)) and hasattr(v, "__len__")
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
    cases = [
        (
            waveforms[0] if len(waveforms) == 1 else waveforms[k],
            shared | {c: float(v[k]) for c, v in columns.items()},
        )
        for k in range(n)
    ]
    problems: dict[str, None] = {}
    for _, values in cases:
        try:
            simulator.dae.parameter_values(**values)
        except InputError as error:
            problems |= dict.fromkeys(str(error).splitlines())
    raise_all(list(problems), "batch")
    return cases
