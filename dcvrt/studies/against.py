"""One facility against the envelope of a code, for `dcvrt ride --against`."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from dcvrt.envelopes import MARKS, Envelope
from dcvrt.envelopes.check import Finding, Verdict, check
from dcvrt.envelopes.choices import Choices, Yardstick
from dcvrt.envelopes.table import joined
from dcvrt.envelopes.trials import CONNECTED, Trial, trials_of
from dcvrt.studies.outputs import refuse_unusable, write_atomically
from dcvrt.studies.single import signals_csv

if TYPE_CHECKING:
    from rich.table import Table

    from dcvrt.trajectory import Event, Trajectory

SHOWN = 4
"""Most events of one run that the table tells."""
WORDS = {True: "pass", False: "FAIL", None: "no verdict"}


@dataclass(frozen=True, eq=False)
class Outcome:
    """One trial: its run, the verdict, the margin of the IT voltage (nan for a run that ended early)."""

    trial: Trial
    run: Trajectory
    verdict: Verdict
    it_margin: float

    @property
    def word(self) -> str:
        return WORDS[self.verdict.passed]

    @property
    def mechanism(self) -> str:
        """What the automata did, with times from the start of the disturbance.

        Of a lost connection only the cause: the last jump before it, with its guard.
        """
        lost = self.finding(CONNECTED)
        if lost is not None and math.isfinite(lost.time):
            before = [e for e in self.run.events if e.time <= lost.time]
            if not before:
                return "the import falls without a change of mode"
            return f"{self._told(before[-1])}: {before[-1].row.partition(': ')[2]}"
        told = [self._told(e) for e in self.run.events]
        if len(told) > SHOWN:
            told = [*told[: SHOWN - 2], "...", f"{told[-1]} ({len(told)} events)"]
        if not self.run.completed:
            told.append(self.run.status)
        return ", ".join(told) or "stays as it is"

    def _told(self, event: Event) -> str:
        return f"{event.target} {event.time - self.trial.begin:+.3f} s"

    def finding(self, requirement: str) -> Finding | None:
        return next((f for f in self.verdict.findings if f.requirement == requirement), None)

    @property
    def connection(self) -> str:
        """How it stayed connected, in a few words."""
        found = self.finding(CONNECTED)
        if found is None:
            return ""
        if found.passed is False and math.isfinite(found.time):
            return f"left at {found.time - self.trial.begin:+.3f} s"
        return found.text if found.passed is None else f"import >= {self.verdict.lowest_share:.1%}"

    @property
    def return_(self) -> str:
        """What else was found, in a few words."""
        return "; ".join(f.text for f in self.verdict.findings if f.requirement != CONNECTED)

    @property
    def margins(self) -> str:
        """Every margin that was judged, with its unit."""
        judged = [f for f in self.verdict.findings if f.passed is not None]
        return ", ".join(_margin(f) for f in judged)


def _margin(finding: Finding) -> str:
    if math.isinf(finding.margin):
        return "never"
    if math.isnan(finding.margin):
        return "-"
    if finding.unit == "share":
        return f"{finding.margin:+.0%}"
    return f"{finding.margin:+.3f} {finding.unit}"


def run_all(
    variant: str, envelope: Envelope, parameters: Mapping[str, float], choices: Choices | None = None
) -> list[Outcome]:
    """Run a variant through every trial of an envelope and judge it.

    Raises
    ------
    InputError
        unknown variant or parameter, a value outside its bounds.
    SimulationError
        no equilibrium at nominal voltage, where every trial begins.
    """
    from dcvrt import facility
    from dcvrt.criteria import Criteria, margins
    from dcvrt.integrators import Simulator

    simulator = Simulator(facility.get(variant).compile(), save_at=1e-3)
    outcomes = []
    for trial in trials_of(envelope, choices or Choices()):
        run = simulator.attempt(trial.waveform, None, **{"H": 1.0, **parameters})
        verdict = check(envelope, run, trial.waveform, judged=trial.judged)
        it = margins(run, Criteria()).voltage.value if run.completed else math.nan
        outcomes.append(Outcome(trial, run, verdict, it))
    return outcomes


def against(
    variant: str, envelope: Envelope, parameters: Mapping[str, float], out: Path | None
) -> tuple[list[Outcome], list[Path]]:
    """Run a variant against an envelope and, with a folder, write the table, the figure and all signals.

    Raises
    ------
    InputError, SimulationError
        as :func:`run_all`; a folder that cannot be written.
    """
    if out is not None:
        refuse_unusable(out)
    outcomes = run_all(variant, envelope, parameters)
    if out is None:
        return outcomes, []
    from dcvrt.studies.figures import envelope as figure
    from dcvrt.studies.style import save, styled

    out.mkdir(parents=True, exist_ok=True)
    written = [write_atomically(out / "verdicts.csv", verdicts_csv(envelope, outcomes))]
    title = f"{variant} against {envelope.title}: {_given(parameters)}"
    with styled():
        written += save(figure.draw(envelope, outcomes, title), out, "envelope")
    signals = out / "signals"
    signals.mkdir(exist_ok=True)
    for number, outcome in enumerate(outcomes, 1):
        name = f"{number:02d}-{re.sub(r'[^a-z0-9.+-]+', '-', outcome.trial.label.lower()).strip('-')}"
        written.append(write_atomically(signals / f"{name}.csv", signals_csv(outcome.run)))
    return outcomes, written


def table_of(outcomes: list[Outcome]) -> Table:
    """The verdicts for a terminal."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    table = Table(box=box.SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0))
    for heading, justify, whole in (
        ("segment", "left", False), ("V, Hz,\ndeg", "right", True), ("verdict", "left", True),
        ("margins", "left", True), ("IT V,\npu", "right", True), ("evidence", "left", True),
        ("what happened", "left", False),
    ):  # fmt: skip
        table.add_column(heading, justify=justify, no_wrap=whole, overflow="fold")  # type: ignore[arg-type]
    colours = {"pass": "green", "FAIL": "bold red", "no verdict": "yellow"}
    for o in outcomes:
        trial = o.trial
        label = trial.label
        if trial.shortened:
            label += f" (run for {trial.held:g} s)"
        table.add_row(
            *(Text(x) for x in (label, "" if math.isnan(trial.level) else f"{trial.level:.4g}")),
            Text(o.word, style=colours[o.word]),
            Text(o.margins.replace(", ", "\n")),
            "" if math.isnan(o.it_margin) else f"{o.it_margin:+.3f}",
            Text(trial.mark),
            Text("; ".join(filter(None, (o.connection, o.return_, o.mechanism)))),
        )  # fmt: skip
    return table


def header(variant: str, envelope: Envelope, parameters: Mapping[str, float]) -> str:
    """What is judged, and by which choices of ours."""
    scale = Yardstick()
    lines = [f"{variant} against {envelope.title}, {envelope.jurisdiction}: {_given(parameters)}"]
    lines.append(f"  for {envelope.applies_to}")
    if envelope.status is not None:
        lines.append(f"  status: {envelope.status.text} [{envelope.status.mark}]")
    lines += [f"  note: {note.text} [{note.mark}]" for note in envelope.notes]
    if envelope.side == "poi":
        lines.append(
            f"  connected: imports at least {scale.connected_share:.0%} of a constant-current load, but for "
            f"{scale.tolerance * 1e3:g} ms [own]"
        )
    if envelope.recovery is not None:
        asked = envelope.recovery
        share = f"{asked.share:.0%}" if asked.share is not None else f"{scale.share:.0%} [own]"
        top = f" to {asked.highest:.0%}" if asked.highest is not None else ""
        above = f"{asked.above:g} pu" if asked.above is not None else f"{scale.above:g} pu [own]"
        lines.append(
            f"  recovered: import at {share}{top} of what it was within {asked.within:g} s of V above "
            f"{above} [{asked.mark}]"
        )
    return "\n".join(lines)


def footer(envelope: Envelope, outcomes: list[Outcome]) -> str:
    """Count of the verdicts, and what the marks of evidence mean."""
    words = [o.word for o in outcomes]
    counts = ", ".join(f"{words.count(word)} {word}" for word in WORDS.values() if word in words)
    marks = joined(envelope.marks, *(o.trial.mark for o in outcomes)).split(", ")
    lines = [counts or "nothing to run: the code gives no number that can be simulated"]
    lines += [f"  {o.trial.label}: {o.trial.note}" for o in outcomes if o.trial.note]
    lines.append("evidence: " + "; ".join(f"{mark}: {MARKS[mark]}" for mark in marks if mark))
    lines.append("Screening only: compare the numbers with the code in force before anyone relies on them.")
    return "\n".join(lines)


def verdicts_csv(envelope: Envelope, outcomes: list[Outcome]) -> str:
    """The verdicts as a table, one row per trial and requirement."""
    text = io.StringIO()
    marks = ", ".join(f"{mark} = {meaning}" for mark, meaning in MARKS.items())
    text.write(f"# {envelope.title}; marks of evidence: {marks}\n")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(
        ["segment", "kind", "level", "required_s", "run_s", "requirement", "verdict", "margin", "margin_unit",
         "finding", "lowest_import_share", "it_voltage_margin_pu", "what_it_did", "evidence", "note"]
    )  # fmt: skip
    for o in outcomes:
        for f in o.verdict.findings:
            writer.writerow(
                [o.trial.label, o.trial.kind, _cell(o.trial.level), _cell(o.trial.time),
                 _cell(o.trial.held), f.requirement, WORDS[f.passed], _cell(f.margin), f.unit,
                 f.text, _cell(o.verdict.lowest_share), _cell(o.it_margin), o.mechanism, o.trial.mark,
                 o.trial.note]
            )  # fmt: skip
    return text.getvalue()


def _given(parameters: Mapping[str, float]) -> str:
    return ", ".join(f"{name} {value:g}" for name, value in parameters.items())


def _cell(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.6g}"


def overall(outcomes: list[Outcome]) -> bool | None:
    """False when a trial failed, None when one has no result, True when every judged one passed."""
    if any(o.verdict.passed is False for o in outcomes):
        return False
    if any(not o.run.completed for o in outcomes):
        return None
    return True
