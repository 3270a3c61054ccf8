"""The paper's findings as hypotheses, each tested on the rows of this study."""

from __future__ import annotations

from itertools import pairwise

from dcvrt.studies.findings import Findings
from dcvrt.studies.report.answer import false_passes
from dcvrt.studies.report.caveats import name_of, why_it_never_falls
from dcvrt.studies.report.page import Safe, paragraph, section, table
from dcvrt.studies.rows import Row, by_site, verdict
from dcvrt.studies.style import mode_name

HOLDS, FAILS, OPEN = "holds here", "does not hold here", "cannot be tested here"


def hypotheses(findings: Findings) -> Safe:
    """What the paper found on its case, and whether it shows in this one."""
    rows = [
        [text, *test(findings)]
        for text, test in (
            ("Capacity does not fall as the rating rises.", _never_falls),
            ("Enough rating restores the capacity without ride-through.", _restored),
            ("Grid-forming control reaches it at no higher rating than grid-following.", _forming_needs_less),
            ("The capacity of a single site can fall while the total rises.", _single_sites_fall),
            ("After tightening no fit passes a validation point that fails.", _no_false_pass),
            (
                "Grid-following plans of full capacity need more rating in the replay than in the fits.",
                _replay_needs_more,
            ),
        )
    ]
    return section(
        "The paper's findings, tested",
        paragraph(
            "The paper prints no parameter values, so its numbers cannot be reproduced. Its qualitative "
            "findings are hypotheses here, not targets."
        ),
        table("Findings of the paper and this study", ["finding", "here", "evidence"], rows, words=[1, 2]),
    )


def _never_falls(findings: Findings) -> tuple[str, str]:
    falls = findings.falls()
    if falls:
        return FAILS, " ".join(falls)
    return HOLDS, f"In every mode and with every method ({why_it_never_falls(findings)})."


def _restored(findings: Findings) -> tuple[str, str]:
    reached = "; ".join(
        f"{mode_name(mode)}, method {method}: {_rating(findings, mode, method)}"
        for mode in findings.modes
        for method in findings.methods
    )
    return (FAILS if findings.shortfalls() else HOLDS), f"Least rating that reaches it: {reached}."


def _rating(findings: Findings, mode: str, method: str) -> str:
    beta = full_rating(findings, mode, method)
    return "none studied" if beta is None else f"β = {beta:g}"


def full_rating(findings: Findings, mode: str, method: str) -> float | None:
    """Least rating whose plan has the capacity without ride-through and passed the replay."""
    rows = findings.rows(mode, method)
    full = [row["beta"] for row in rows if _is_full(findings, row) and verdict(row) == "passed"]
    return min(full, default=None)


def _is_full(findings: Findings, row: Row) -> bool:
    return bool(row["total_mw"] >= findings.no_vrt_mw - findings.tolerance_mw)


def _forming_needs_less(findings: Findings) -> tuple[str, str]:
    if not {"gfl", "gfm"} <= set(findings.modes):
        return OPEN, "The study does not compare the two modes."
    far = float("inf")
    ratings = {
        method: [full_rating(findings, mode, method) or far for mode in ("gfl", "gfm")]
        for method in findings.methods
    }
    said = "; ".join(
        f"method {method}: GFL {_rating(findings, 'gfl', method)}, GFM {_rating(findings, 'gfm', method)}"
        for method in findings.methods
    )
    if all(forming == following == far for following, forming in ratings.values()):
        return OPEN, f"Neither mode reaches it at the ratings studied ({said})."
    holds = all(forming <= following for following, forming in ratings.values())
    return (HOLDS, said + ".") if holds else (FAILS, f"{said}. {_why_forming_has_less(findings)}")


def _why_forming_has_less(findings: Findings) -> str:
    """What limits the grid-forming plans where they host less, and by which margin they do so."""
    for method in reversed(findings.methods):
        pairs = zip(findings.rows("gfl", method), findings.rows("gfm", method), strict=True)
        less = [(a, b) for a, b in pairs if b["total_mw"] < a["total_mw"] - findings.tolerance_mw]
        if less:
            following, forming = less[-1]
            return (
                f"At β = {forming['beta']:g} (method {method}) GFM hosts {forming['total_mw']:.1f} MW, GFL "
                f"{following['total_mw']:.1f} MW. {findings.limits_of(forming)}"
            )
    return ""


def _single_sites_fall(findings: Findings) -> tuple[str, str]:
    found = []
    for mode in findings.modes:
        for method in findings.methods:
            for low, high in pairwise(findings.rows(mode, method)):
                before_after = by_site(low, findings.sites), by_site(high, findings.sites)
                changes = zip(findings.sites, *before_after, strict=True)
                found += [
                    f"bus {site} from {before:.1f} to {after:.1f} MW ({name_of(high)})"
                    for site, before, after in changes
                    if after < before - findings.tolerance_mw
                ]
    if not found:
        return FAILS, "No site loses capacity as the rating rises."
    return HOLDS, "; ".join(found[:3]) + (f"; {len(found) - 3} more" if len(found) > 3 else "") + "."


def _no_false_pass(findings: Findings) -> tuple[str, str]:
    if findings.predictions.empty:
        return OPEN, "No fit has a validation point."
    count = sum(false_passes(findings).values())
    evidence = f"{count} false passes among {len(findings.predictions)} validation points."
    return (FAILS if count else HOLDS), evidence


def _replay_needs_more(findings: Findings) -> tuple[str, str]:
    full = [row for row in findings.rows("gfl") if _is_full(findings, row)]
    if not full:
        return OPEN, "No grid-following plan reaches full capacity."
    failed = [row for row in full if verdict(row) == "failed"]
    if failed:
        return HOLDS, "Failed the replay at full capacity: " + "; ".join(map(name_of, failed)) + "."
    return FAILS, "Every grid-following plan of full capacity passed the replay."
