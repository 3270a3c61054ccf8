"""One facility on one waveform, for `dcvrt ride`."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from dcvrt import scenarios
from dcvrt.errors import InputError, did_you_mean, raise_all
from dcvrt.studies.outputs import refuse_unusable, write_atomically

if TYPE_CHECKING:
    from dcvrt.trajectory import Trajectory
    from dcvrt.waveform import Waveform


def ride(variant: str, waveform: str, parameters: Mapping[str, float], out: Path | None) -> tuple[str, bool]:
    """Run a variant on a waveform.

    Parameters
    ----------
    variant : name of a facility variant.
    waveform : path of a CSV file, or name of a scenario.
    parameters : values that differ from the variant's own, as `beta`.
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
    run = simulator.attempt(waveform_of(waveform), None, **{"H": 1.0, **parameters})
    given = ", ".join(f"{name} {value:g}" for name, value in parameters.items())
    lines = [
        f"{variant} on {run.name}, {given}, on the base of its own capacity",
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


def parameters_of(beta: float, settings: Sequence[str]) -> dict[str, float]:
    """Parameters from `beta` and texts NAME=VALUE.

    Raises
    ------
    InputError
        texts of another form, values that are no number, a name that stands twice.
    """
    found, problems = {"beta": beta}, []
    for text in settings:
        name, equals, value = (part.strip() for part in text.partition("="))
        try:
            number = float(value) if equals and name else math.nan
        except ValueError:
            number = math.nan
        if not math.isfinite(number):
            problems.append(f"--set {text}: write NAME=VALUE with a number, for example --set sup.T_dip=2.5.")
        elif name in found:
            way_out = "use --beta" if name == "beta" else "give it once"
            problems.append(f"--set {text}: {name} has a value already. Way out: {way_out}.")
        else:
            found[name] = number
    raise_all(problems, "ride")
    return found


def waveform_of(name: str) -> Waveform:
    """A waveform by the name of its scenario or from a CSV file.

    Raises
    ------
    InputError
        When it is neither.
    """
    from dcvrt.waveform import Waveform

    if name in scenarios.names():
        return scenarios.get(name)
    path = Path(name)
    if not path.is_file():
        raise InputError(
            f"waveform {name!r}: no such file and no such scenario.{did_you_mean(name, scenarios.names())}"
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
