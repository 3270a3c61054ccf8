"""The facility of a study on the test waveform, independent of any network fault."""

from __future__ import annotations

from typing import TYPE_CHECKING

from dcvrt.errors import DcvrtError
from dcvrt.studies.figures import ride
from dcvrt.studies.findings import Findings
from dcvrt.studies.style import mode_name

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from dcvrt.trajectory import Trajectory

TEST_BETA = 1.15
"""Rating of the facility on the test waveform: the nearest of the study is taken."""


def rating(findings: Findings) -> float:
    """Rating of the study that is nearest to the one of the test."""
    return min(findings.study.facility.beta, key=lambda beta: abs(beta - TEST_BETA))


def on_test_waveform(findings: Findings, mode: str) -> tuple[Trajectory | None, str]:
    """Run the facility of a mode on the ERCOT-style waveform.

    Returns
    -------
    run, status
        No run where there is none: the status then says why.
    """
    from dcvrt.waveform import Waveform

    try:
        run = findings.simulator(mode).attempt(
            Waveform.ercot_style(), beta=rating(findings), pf=findings.study.hosting.pf
        )
    except DcvrtError as error:
        return None, str(error)
    return run, str(run.status)


def draw(findings: Findings, mode: str, run: Trajectory) -> Figure:
    """What happens inside, and which waveform it is; a run that ended early says so."""
    from dcvrt.waveform import Waveform

    title = (
        f"{mode_name(mode)}, β = {rating(findings):g}, on the ERCOT-style test waveform (our own; "
        "not ERCOT's official waveform)"
    )
    if not run.completed:
        title += f"\n{run.status}"
    return ride.draw(
        ride.signals_of(run, Waveform.ercot_style().at(run.t)),
        findings.facility(mode).automaton_behind("mode").modes,
        title,
        findings.study.criteria.v_it_min_pu,
    )
