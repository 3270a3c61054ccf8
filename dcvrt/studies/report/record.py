"""How the result came about: the chain, simulations counted, versions, the study file."""

from __future__ import annotations

from typing import TYPE_CHECKING

from dcvrt.errors import first_sentence
from dcvrt.studies.campaign import LOST
from dcvrt.studies.findings import Findings
from dcvrt.studies.report.page import Safe, definitions, escape, figure, paragraph, section, table
from dcvrt.studies.store import RUN_FAILED
from dcvrt.studies.style import mode_name

if TYPE_CHECKING:
    import pandas as pd


def simulations(findings: Findings) -> Safe:
    """How much was simulated, what failed and what was set aside."""
    counts = findings.summary["simulations"]
    minutes = findings.summary["wall_s"] / 60.0
    parts = [
        definitions(
            [
                ("Fault simulations", counts["grid"]),
                ("Facility runs", counts["facility"]),
                ("Failed", counts["failed"]),
                ("Tasks set aside", counts["quarantined"]),
                ("Time spent", f"{minutes:.1f} min"),
                (
                    "Hosting vectors",
                    f"{int((findings.hostings.role == 'sample').sum())} sampled, "
                    f"{int((findings.hostings.role == 'plan').sum())} plans",
                ),
            ]
        )
    ]
    away = findings.tasks[findings.tasks.status.isin(LOST)]
    if len(away):
        parts.append(
            table(
                "Tasks that were set aside",
                ["task", "phase", "state", "message"],
                [[str(task.hash)[:12], task.phase, task.status, task.message] for task in away.itertuples()],
                words=[1, 2, 3],
            )
        )
    failed = failed_runs(findings)
    if len(failed):
        grouped = (
            failed.groupby(["failed_in", "mode", "beta", "reason"], sort=True).size().reset_index(name="rows")
        )
        parts.append(
            table(
                "Facility runs without a result, by reason",
                ["failed in", "mode", "β", "reason", "runs"],
                [
                    [
                        row["failed_in"],
                        mode_name(row["mode"]),
                        f"{row['beta']:g}",
                        row["reason"],
                        str(row["rows"]),
                    ]
                    for row in grouped.to_dict("records")
                ],
                words=[1, 3],
            )
        )
        parts.append(paragraph(f"One of them in full: {failed.status.iloc[0]}"))
    battery = findings.margins[(findings.margins.ok == 1)]
    if len(battery):
        visited = int((battery.battery == 1).sum())
        parts.append(
            paragraph(
                f"In {visited} of {len(battery)} facility runs with a result the supervisor visited "
                "BATTERY, where the import is zero and the load loss 100 %."
            )
        )
    return section("Simulations", *parts)


def failed_runs(findings: Findings) -> pd.DataFrame:
    """Rows of margins whose simulation failed, with the first line of what it said as `reason`."""
    failed = findings.margins[findings.margins.failed_in.isin(["grid", *RUN_FAILED])]
    return failed.assign(reason=[first_sentence(status) for status in failed.status])


def method(findings: Findings) -> Safe:
    """The chain of the study."""
    return section(
        "Method",
        figure(
            findings.folder / "figures" / "framework.svg",
            alt=(
                "Hosting proposals go through fault simulation, POI waveforms and the facility model to "
                "margins; margins become tightened affine rows of the hosting programme; every plan is "
                "replayed through the whole chain."
            ),
            caption=(
                "The chain of a study. Only the replay accepts a plan: the fitted margins are a way to "
                "find it."
            ),
        ),
    )


def provenance(findings: Findings) -> Safe:
    """What the study was made from and with."""
    known = findings.provenance
    made_with = ", ".join(f"{name} {version}" for name, version in findings.summary["versions"].items())
    pairs: list[tuple[object, object]] = [
        ("Versions", made_with),
        ("Platform", known.get("platform", "–")),
        ("Seed", known.get("seed", "–")),
        (
            "Facility evaluation",
            "; ".join(f"{mode_name(m)}: {text}" for m, text in dict(known.get("backends", {})).items())
            or "–",
        ),
        (
            "Files beside this report",
            "study.toml, study.sqlite (everything), summary.json, table.csv, validation.csv, coupling.csv, "
            "figures/ (SVG and PNG)",
        ),
        (
            "Again",
            "the same 'dcvrt study run' on this folder repeats nothing; 'dcvrt study report' writes "
            "tables, figures and report anew",
        ),
    ]
    text = Safe(
        f"<details><summary>Study file</summary><pre>{escape(known.get('study_text', ''))}</pre></details>"
    )
    return section("Provenance", definitions(pairs), text)
