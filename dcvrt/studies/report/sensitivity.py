"""How the answer moves with the assumptions: by gradients, and where most is at stake by searching again."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dcvrt.studies.figures.sensitivity import by_gradient, drawn, rows_of
from dcvrt.studies.findings import Findings
from dcvrt.studies.report.page import Safe, bullets, escape, figure, notice, paragraph, section, table
from dcvrt.studies.sensitivity import SHOWN
from dcvrt.studies.style import mode_name

TITLE, ANCHOR = "How the answer moves with the assumptions", "sensitivity"
SAME = 0.1
"""Difference between a gradient and a search, as a share of the larger, below which they agree."""


def sensitivity(findings: Findings) -> Safe:
    """For one plan of each mode: what it is held by, the tornado, and all assumptions."""
    plans = findings.sensitivity_plans
    missing = [_missing(findings, mode) for mode in findings.modes if mode not in plans]
    if not plans:
        return section(TITLE, *map(paragraph, missing), name=ANCHOR)
    spent = findings.provenance.get("sensitivity_runs", {"grid": 0, "facility": 0})
    parts = [
        notice(
            "In open loop only",
            paragraph(
                "Every number of this section takes hosted load as an impedance in the fault, so that the "
                "voltages do not move with what is varied. Where a facility acts on the network, the same "
                "change of an assumption moves the voltages too; how far the plans are off in closed loop is "
                "told in Facilities in the network."
            ),
            "neutral",
        ),
        paragraph(
            "How many MW more or fewer would be hosted if an assumption of the facility or of the criteria "
            "were another? By gradients: the margins that hold a plan, or are near to that, are shifted by "
            "their derivatives times the change, and the hosting programme is solved again; for small "
            "changes that is the price of each margin times its derivative (MW per unit). Beside that the "
            "facility is run at both ends of each range on the voltages of the plan, which shows what "
            "gradients cannot see: events that are "
            "gained or lost, and margins that were not near. Where most is at stake the frontier is searched "
            "again, with the engine of the samples in place of the replay "
            f"({spent['grid']} fault simulations and {spent['facility']} facility runs in all). Ranges are "
            "as illustrative as the values. Neither gradients nor runs on the plan's voltages tell whether a "
            "closed site would open; only a search does."
        ),
        *map(paragraph, missing),
        *[paragraph(held(findings, mode)) for mode in plans],
    ]
    picture = findings.folder / "figures" / "sensitivity.svg"
    if any(drawn(findings, mode) for mode in plans) and picture.is_file():
        said = " ".join(_said(findings, mode) for mode in plans)
        parts.append(
            figure(
                picture,
                alt=f"Bars of the change of hosted capacity by assumption. {said}",
                caption=f"Change of the hosted capacity over the range of each assumption. {said}",
            )
        )
    for mode in plans:
        rows = rows_of(findings, mode)
        moving = [row for row in rows if moves(row)]
        still = [row for row in rows if not moves(row)]
        parts.append(
            table(
                f"{mode_name(mode)}: change of the hosted capacity (MW), low end / high end",
                [
                    "assumption",
                    "value",
                    "low / high",
                    "MW per unit",
                    "by gradient",
                    "searched again",
                    "what gradients miss",
                ],
                [_row(plans[mode], row) for row in moving],
                words=[0, 6],
            )
        )
        if still:
            parts.append(
                Safe(
                    f"<details><summary>{escape(mode_name(mode))}: {len(still)} assumption(s) that move "
                    "nothing at first order, and with which the plan passes at both ends</summary>"
                    f"{bullets([_still(row) for row in still])}</details>"
                )
            )
    return section(TITLE, *parts, name=ANCHOR)  # fmt: skip


def moves(row: Mapping[str, Any]) -> bool:
    """Whether there is something to tell of an assumption."""
    return row["stake_mw"] >= SHOWN or any(end["refused"] for end in row["sides"].values())


def held(findings: Findings, mode: str) -> str:
    """What holds the plan of a mode, and so what its gradients can say."""
    about = findings.sensitivity_plans[mode]
    head = f"{mode_name(mode)}: {about['total_mw']:.1f} MW at β = {about['beta']:g}"
    closed = ", ".join(about["closed"])
    shut = f" Closed sites: {closed}." if closed else ""
    network = f" Beside that the network holds it: {'; '.join(about['limits'])}." if about["limits"] else ""
    followed = "; ".join(
        f"{item['target']} at bus {item['site']}, fault {item['fault']}, {item['period']}"
        for item in about["near"]
    )
    near = f" Near to binding, and followed by their gradients as well: {followed}." if followed else ""
    events = "".join(
        f" It also stands at a change of events, where gradients say nothing: {label}."
        for label in about["by_sequence"]
    )
    priced = [item for item in about["binding"] if item["price"] > 0]
    if not priced:
        return (
            f"{head} is held by no margin, so there is no MW per unit: it is left out, not zero. What holds "
            f"it: {'; '.join(about['limits']) or 'the box of the search'}.{near or ' No margin is near.'}"
            f"{events}{shut}"
        )
    margins = "; ".join(
        f"{item['target']} at bus {item['site']}, fault {item['fault']}, {item['period']} "
        f"({item['price']:.0f} MW per {'pu' if item['target'] == 'voltage' else 'share'}, "
        f"{0.01 * item['by_beta']:+.1f} MW per 0.01 of β)"
        for item in priced
    )
    return f"{head} is held by {margins}.{network}{near}{events}{shut}"


def reference(findings: Findings, differing: list[str]) -> Safe:
    """Where the effect of the parameters that differ between the modes is shown, and of which it is not."""
    varied = set(findings.sensitivities.path) if len(findings.sensitivities) else set()
    shown = [path for path in differing if path in varied]
    hidden = [path for path in differing if path not in varied]
    link = f'<a href="#{ANCHOR}">{escape(TITLE)}</a>'
    said = []
    if shown:
        said.append(f"How the answer moves with {escape(', '.join(shown))}: see {link}.")
    if hidden:
        said.append(
            f"The effect of {escape(', '.join(hidden))} was not studied; a range in [sensitivity.ranges] "
            "adds it."
        )
    return Safe(f"<p>{' '.join(said)}</p>")


def _missing(findings: Findings, mode: str) -> str:
    if findings.study.grid.coupling == "closed":
        return (
            f"{mode_name(mode)}: the study searches in closed loop, where the voltages depend on what would "
            "be varied; sensitivities are found in open loop only."
        )
    if "frontier" not in findings.methods:
        return f"{mode_name(mode)}: the frontier was not searched, so no prices of margins are known."
    beta = findings.study.sensitivity.beta
    where = "" if beta is None else f" at β = {beta:g}"
    return f"{mode_name(mode)}: the frontier hosts nothing{where}, so there is no plan to vary."


def _row(about: Mapping[str, Any], row: Mapping[str, Any]) -> list[object]:
    low, high = row["sides"]["low"], row["sides"]["high"]
    unit = "" if row["unit"] == "1" else f" {row['unit']}"
    missed = [
        f"{word}: {text}"
        for word, end in (("low", low), ("high", high))
        for text in [
            end["refused"],
            *(f"bus {bus} fails: {why}" for bus, why in end["unseen"].items()),
            *(["the search ended early"] if end["rerun_settled"] is False else []),
        ]
        if text
    ]
    return [
        f"{row['path']}: {row['doc']}",
        f"{row['value']:g}{unit}",
        f"{low['value']:g} / {high['value']:g}",
        "–" if row["by_unit"] is None else f"{row['by_unit']:.3g}",
        f"{_change(by_gradient(low))} / {_change(by_gradient(high))}",
        f"{_again(about, low)} / {_again(about, high)}",
        Safe("<br>".join(map(escape, missed))) if missed else "–",
    ]


def _change(mw: float | None) -> str:
    return "–" if mw is None else "0" if abs(mw) < SHOWN else f"{mw:+.1f}"


def _again(about: Mapping[str, Any], end: Mapping[str, Any]) -> str:
    if end["rerun_mw"] is None or about["rerun_mw"] is None:
        return "–"
    return _change(end["rerun_mw"] - about["rerun_mw"])


def _still(row: Mapping[str, Any]) -> str:
    unit = "" if row["unit"] == "1" else f" {row['unit']}"
    low, high = row["sides"]["low"]["value"], row["sides"]["high"]["value"]
    span = "not varied" if low == high else f"{low:g} to {high:g}{unit}"
    slope = "" if row["by_unit"] is None else f"; {row['by_unit']:.2g} MW per unit"
    return f"{row['path']}: {row['doc']}; {span}{slope}"


def _said(findings: Findings, mode: str) -> str:
    """What moves a plan most, and how far gradients and searches agree."""
    about, rows = findings.sensitivity_plans[mode], drawn(findings, mode)
    name = mode_name(mode)
    if not rows:
        return f"{name}: no assumption moves the plan within its range."
    said = f"{name}: most is at stake with {rows[0]['path']}."
    if about["rerun_mw"] is None:
        return said
    ends = [
        (mw, end["rerun_mw"] - about["rerun_mw"])
        for row in rows
        for end in row["sides"].values()
        for mw in [by_gradient(end)]
        if end["rerun_mw"] is not None and mw is not None
    ]
    agree = sum(abs(a - b) <= SAME * max(abs(a), abs(b)) + SHOWN for a, b in ends)
    if not ends:
        return said
    return f"{said} Gradients and search agree to a tenth at {agree} of {len(ends)} ends searched again."
