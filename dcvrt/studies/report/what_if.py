"""How the answer moves with the assumptions: the least rating of the largest plans under other values."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dcvrt.studies.figures.what_if import modes_varied, rows_of
from dcvrt.studies.findings import Findings
from dcvrt.studies.report.page import Safe, escape, figure, number, paragraph, section, table
from dcvrt.studies.style import mode_name
from dcvrt.studies.what_if import TOLERANCE, values_text

TITLE, ANCHOR = "How the answer moves with the assumptions", "what-if"


def what_if(findings: Findings) -> Safe:
    """For each mode, the least rating of its largest plan as studied and under every what-if."""
    missing = [
        f"{mode_name(mode)}: no plan passed, so there is none whose rating could be sought."
        for mode, best in zip(findings.modes, map(findings.best, findings.modes), strict=True)
        if best is None
    ]
    if len(missing) == len(findings.modes):
        return section(TITLE, *map(paragraph, missing), name=ANCHOR)
    if findings.what_ifs.empty:
        none = "No assumption was varied: the study has no [[what_if]]."
        return section(TITLE, paragraph(none), name=ANCHOR)
    parts = [
        paragraph(
            "For the largest plan of each mode that passed, the least converter rating is sought with which "
            "it still rides through every fault in every period at every open site, once as studied and once "
            "with one assumption varied. Capacities and grid voltages are those of the plan's replay; only "
            "the facility or the criterion changes. Where no rating is enough, a smaller plan may still ride "
            f"through. Ratings are found by bisection, to {TOLERANCE:g}, and the margins are taken to grow "
            "with the rating. The varied values are as illustrative as those of the study. The plans of two "
            "modes may differ: compare within a mode."
        ),
        *map(paragraph, missing),
    ]
    picture = findings.folder / "figures" / "what_if.svg"
    if modes_varied(findings) and picture.is_file():
        said = " ".join(_said(findings, mode) for mode in modes_varied(findings))
        parts.append(
            figure(
                picture,
                alt=f"Bars of the least rating by assumption. {said}",
                caption=f"Least rating with each assumption varied, from that of the study. {said}",
            )
        )
    for mode in findings.modes:
        base, varied = rows_of(findings, mode)
        if base is not None:
            parts.append(
                table(
                    f"{mode_name(mode)}: least rating of the plan of {base['total_mw']:.1f} MW "
                    f"({base['n_waveforms']} voltage waveforms)",
                    ["assumption", "in the study", "varied", "least β, study", "least β, varied", "change"],
                    [_row(base, row) for row in varied],
                    words=[1, 2],
                )
            )
    return section(TITLE, *parts, name=ANCHOR)


def reference(findings: Findings, differing: list[str]) -> Safe:
    """Where the effect of the parameters that differ between the modes is shown, and of which it is not."""
    varied = {change["name"]: None for changes in findings.what_ifs.get("changes", []) for change in changes}
    shown = [path for path in differing if path in varied]
    hidden = [path for path in differing if path not in varied]
    link = f'<a href="#{ANCHOR}">{escape(TITLE)}</a>'
    said = []
    if shown:
        said.append(f"How the answer moves with {escape(', '.join(shown))}: see {link}.")
    if hidden:
        said.append(
            f"The effect of {escape(', '.join(hidden))} was not studied; a [[what_if]] in the study file "
            "adds it."
        )
    return Safe(f"<p>{' '.join(said)}</p>")


def _row(base: Mapping[str, Any], row: Mapping[str, Any]) -> list[object]:
    change = "–"
    if base["rating"] is not None and row["rating"] is not None:
        change = f"{row['rating'] - base['rating']:+.3f}"
    return [
        row["label"],
        values_text(row["changes"], "studied"),
        values_text(row["changes"], "varied", named=False),
        rating_text(base),
        rating_text(row),
        change,
    ]


def rating_text(row: Mapping[str, Any]) -> str:
    """A least rating in words: where the search ends it is a bound.

    >>> rating_text({"rating": 1.2344, "low": 1.0, "high": 2.0})
    '1.234'
    >>> rating_text({"rating": 1.0, "low": 1.0, "high": 2.0}), rating_text({"rating": None, "high": 2.0})
    ('at most 1', 'none up to 2')
    """
    if row["rating"] is None:
        return f"none up to {row['high']:g}"
    return f"at most {row['low']:g}" if row["rating"] <= row["low"] else number(row["rating"], 3)


def _said(findings: Findings, mode: str) -> str:
    """What moves the rating of a mode most, and what no rating makes up for."""
    base, varied = rows_of(findings, mode)
    assert base is not None
    name, said = mode_name(mode), []
    finite = [row for row in varied if row["rating"] is not None]
    most = max(finite, key=lambda row: abs(row["rating"] - base["rating"]), default=None)
    if most is not None:
        if abs(most["rating"] - base["rating"]) <= TOLERANCE:
            said.append(f"{name}: no varied value that some rating makes up for moves it.")
        else:
            said.append(
                f"{name}: among those that a rating makes up for, most by '{most['label']}', from "
                f"{rating_text(base)} to {rating_text(most)}."
            )
    never = [f"'{row['label']}'" for row in varied if row["rating"] is None]
    if never:
        said.append(f"{name}: no rating up to {base['high']:g} makes up for {', '.join(never)}.")
    return " ".join(said)
