"""The report of a study: one HTML file that opens anywhere, without a network, with the answer first."""

from __future__ import annotations

import re
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from string import Template

from dcvrt.studies.figures import draw_all
from dcvrt.studies.findings import Findings
from dcvrt.studies.outputs import write_atomically
from dcvrt.studies.report import (
    answer,
    checks,
    coupling,
    frontier,
    grid,
    hypotheses,
    models,
    plans,
    record,
    sensitivity,
    system_limit,
)
from dcvrt.studies.report.page import Safe, escape

REPORT = "report.html"

SECTIONS: tuple[Callable[[Findings], Safe], ...] = (
    answer.answer,
    frontier.frontier,
    system_limit.system_limit,
    plans.plans,
    plans.failures,
    plans.closed_sites,
    coupling.coupling,
    hypotheses.hypotheses,
    checks.validation,
    checks.worst_cases,
    grid.grid,
    models.facility,
    record.simulations,
    models.assumptions,
    sensitivity.sensitivity,
    models.deviations,
    record.method,
    record.provenance,
)


def write_report(findings: Findings) -> Path:
    """Write `report.html` into the folder of a finished study; figures that are missing are drawn.

    Parameters
    ----------
    findings : of the study's folder.

    Returns
    -------
    Path
        The report.
    """
    if not (findings.folder / "figures" / "framework.svg").is_file():
        draw_all(findings)
    return write_atomically(findings.folder / REPORT, text_of(findings))


def text_of(findings: Findings) -> str:
    """The page as text."""
    body = "\n".join(part for part in (make(findings) for make in SECTIONS) if part)
    titles = re.findall(r'<section id="([^"]+)".*?<h2[^>]*>(.*?)</h2>', body, flags=re.DOTALL)
    contents = "".join(f'<li><a href="#{anchor}">{title}</a></li>' for anchor, title in titles)
    versions = findings.summary["versions"]
    kind = (
        "A quick run: fewer samples, periods and ratings than the study file asks for. "
        if findings.provenance["quick"]
        else ""
    )
    page = Template(resources.files("dcvrt.studies.report").joinpath("page.html").read_text(encoding="utf-8"))
    return page.substitute(
        title=escape(findings.study.study.name),
        subtitle=escape(
            f"{kind}How much data-centre load the grid can host when every site must ride through the "
            "grid's faults."
        ),
        contents=contents,
        body=body,
        footer=escape(
            f"Made by dcvrt {versions['dcvrt']} from the store of the study. Screening results in positive "
            "sequence; not a submission to a system operator."
        ),
    )
