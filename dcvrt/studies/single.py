"""One facility on one waveform, for `dcvrt ride`."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from dcvrt.errors import InputError, did_you_mean
from dcvrt.studies.outputs import refuse_unusable, write_atomically

if TYPE_CHECKING:
    from dcvrt.trajectory import Trajectory
    from dcvrt.waveform import Waveform


def ride(
    variant: str, waveform: str, beta: float, out: Path | None, named: Sequence[str]
) -> tuple[str, bool]:
    """Run a variant on a waveform.

    Parameters
    ----------
    variant : name of a facility variant.
    waveform : path of a CSV file, or one of `named`.
    beta : converter rating over hosted capacity.
    out : folder for `signals.csv` and `signals.svg`, made when it is not there.

    Returns
    -------
    text, complete : str, bool
        What to show, and whether the run reached the end of the waveform.

    Raises
    ------
    InputError
        For an unknown variant or waveform, or a folder that cannot be written.
    """
    from dcvrt import facility
    from dcvrt.criteria import Criteria, margins
    from dcvrt.integrators import Simulator

    if out is not None:
        refuse_unusable(out)
    simulator = Simulator(facility.get(variant).compile(), save_at=1e-3)
    run = simulator.attempt(waveform_of(waveform, named), H=1.0, beta=beta)
    lines = [
        f"{variant} on {run.name}, beta {beta:g}, on the base of its own capacity",
        f"status: {run.status}",
    ]
    if run.completed:
        found = margins(run, Criteria())
        lines += [
            f"voltage margin: {found.voltage.value:+.4f} pu",
            f"loss margin:    {found.loss.value:+.4f} of the import",
        ]
        lines += [f"  {name}: {value:.6g}" for name, value in found.diagnostics.items()]
    lines += ["events:"] + [f"  {event}" for event in run.events] if run.events else ["events: none"]
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        write_atomically(out / "signals.csv", signals_csv(run))
        run.plot(out / "signals.svg")
        lines.append(f"signals: {out / 'signals.csv'}, {out / 'signals.svg'}")
    return "\n".join(lines), run.completed


def waveform_of(name: str, named: Sequence[str]) -> Waveform:
    """A waveform by its name or from a CSV file.

    Raises
    ------
    InputError
        When it is neither.
    """
    from dcvrt.waveform import Waveform

    if name == "ercot-style":
        return Waveform.ercot_style()
    sag = re.fullmatch(r"sag-(\d+)", name)
    if sag and name in named:
        return Waveform.sag(retained=int(sag[1]) / 100, start=0.1, length=0.15, until=3.0)
    path = Path(name)
    if not path.is_file():
        raise InputError(
            f"waveform {name!r}: no such file and no such test waveform.{did_you_mean(name, named)}"
        )
    return Waveform.from_csv(path)


def signals_csv(run: Trajectory) -> str:
    """All outputs over time; the base stands in the first line."""
    text = io.StringIO()
    text.write("# per unit on S_B = hosted capacity; load convention (import positive)\n")
    writer = csv.writer(text, lineterminator="\n")
    names = run.outputs.names
    writer.writerow(["t_s", *names])
    for t, values in zip(run.t, run.outputs.value, strict=True):
        writer.writerow([f"{t:.6f}", *(f"{x:.8g}" for x in values)])
    return text.getvalue()
