"""What the system can stand, instead of what each site has to: capacity against the load lost at once."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from dcvrt.studies.comparison import buses
from dcvrt.studies.findings import Findings
from dcvrt.studies.report.page import Safe, badge, bullets, figure, notice, number, paragraph, section, table
from dcvrt.studies.style import mode_name

TITLE, ANCHOR = "What the system can stand", "system-limit"
VERDICTS = {True: "passed", False: "failed", None: "nothing hosted"}


def system_limit(findings: Findings) -> Safe:
    """The trade-off between hosted capacity and what drops off at once; nothing where no limit was tried."""
    found = findings.system_limits
    rows = found["rows"]
    if not rows:
        return Safe("")
    parts = [
        paragraph(
            "Elsewhere in this report every open site has to meet the criteria by itself, in every fault. "
            "An operator has another limit: the load that drops off at once. Here sites may fail singly, as "
            "long as the loss of all of them together stays within a limit, in every fault and period. The "
            "loss of a site is the share of its import that is gone for the whole loss window; a site whose "
            "protected voltage is not held, or whose run ended before its time, counts with all of its load, "
            "since its servers drop off. Every plan was replayed by the engine of all replays, and simulated "
            "once more in closed loop, with its facilities acting on the network."
        ),
        paragraph(
            "For scale: in an event of July 2024 that NERC reviewed, some 1,500 MW of data-centre load "
            "dropped off, and a study presented at ERCOT in 2025 used a limit of 2,600 MW (both read in "
            "secondary sources). What may be lost depends on the system behind it; no limit of this study is "
            "a recommendation."
        ),
        paragraph(_tried(findings)),
    ]
    turned = [row for row in rows if row["closed_loop"] is not None and not row["closed_loop"]["passed"]]
    if turned:
        parts.append(
            notice(
                f"{len(turned)} plan(s) lose more than their limit once their facilities act on the network",
                bullets(
                    [
                        f"{_name(row)}: {row['total_mw']:.1f} MW, loses "
                        f"{row['closed_loop']['aggregate_loss_mw']:.1f} MW at once"
                        for row in turned
                    ]
                ),
            )
        )
    failed = [row for row in rows if row["passed"] is False]
    if failed:
        parts.append(
            notice(
                f"{len(failed)} plan(s) within a limit failed the replay and must not be used",
                bullets([f"{_name(row)}: {row['total_mw']:.1f} MW, loses {_mw(row)}" for row in failed]),
            )
        )
    said = sentences(found)
    picture = findings.folder / "figures" / "system_limit.svg"
    if picture.is_file():
        parts.append(
            figure(
                picture,
                alt=f"Hosted capacity against the load lost at once. {' '.join(said)}",
                caption=(
                    "Hosted capacity against the load lost at once in the worst fault, by the replay, for "
                    "every mode and rating. Each step is a hosting vector that was replayed, for whichever "
                    "mode and rating it was searched; what may be hosted within a loss is as much or more. "
                    "Filled marks: plans searched within a limit. Open marks: plans whose every site rides "
                    "through, at what they lose."
                ),
            )
        )
    parts.append(bullets(said))
    parts.append(
        table(
            "Plans within a limit on the load lost at once",
            ["mode", "β", "limit", "hosted (MW)", "sites (MW)", "lost at once (MW)", "in the worst fault",
             "lost whole in some fault", "replay", "lost at once in closed loop (MW)", "closed loop",
             "gain (MW per MW)"],
            [_cells(row) for row in rows],
            words=[4, 6],
        )
    )  # fmt: skip
    parts.append(_at_every_rating(found))
    parts.append(
        paragraph(
            "Gain: hosted MW for each MW more that may be lost, by the prices of the hosting programme; a "
            "dash where the limit does not bind."
        )
    )
    return section(TITLE, *parts, *_reservations(rows), name=ANCHOR)


def within(front: Iterable[Mapping[str, Any]], mw: float) -> float:
    """The most that was replayed and loses no more than a limit, MW.

    >>> within([{"loss_mw": 8.0, "total_mw": 90.0}, {"loss_mw": 11.0, "total_mw": 120.0}], 10.0)
    90.0
    """
    return max((row["total_mw"] for row in front if row["loss_mw"] <= mw), default=0.0)


def _at_every_rating(found: Mapping[str, Any]) -> Safe:
    """What may at least be hosted within each limit in MW, for every mode and rating."""
    fronts: dict[tuple[str, float], list[Mapping[str, Any]]] = {}
    for row in found["front"]:
        fronts.setdefault((row["mode"], row["beta"]), []).append(row)
    limits = sorted({row["limit_mw"] for row in found["rows"] if row["limit_mw"] > 0})
    if not fronts or not limits:
        return Safe("")
    return table(
        "At least hosted within a limit (MW), by what was replayed for whichever mode and rating",
        ["mode", "β", *(f"{mw:g} MW" for mw in limits)],
        [
            [mode_name(mode), f"{beta:g}", *(number(within(front, mw), 1) for mw in limits)]
            for (mode, beta), front in fronts.items()
        ],
    )


def _tried(findings: Findings) -> str:
    """Which of the ratings studied the limits were tried at."""
    tried = sorted({row["beta"] for row in findings.system_limits["rows"]})
    studied = findings.study.facility.beta
    said = (
        f"The largest plans were searched at {len(tried)} of the {len(studied)} ratings studied: "
        f"{', '.join(f'{b:g}' for b in tried)}."
    )
    if len(tried) < len(studied):
        said += (
            " What was replayed for any search is told for all ratings: what may at least be hosted there. "
            "[system_limit] of the study file takes more ratings and limits; the same folder may be run "
            "again with them."
        )
    return said


def sentences(found: Mapping[str, Any]) -> list[str]:
    """For each mode and rating, what the limits allow beside what sites that all ride through do."""
    every = {(row["mode"], row["beta"]): row for row in found["every_site"]}
    said = []
    for mode, beta in dict.fromkeys((row["mode"], row["beta"]) for row in found["rows"]):
        rows = [row for row in found["rows"] if (row["mode"], row["beta"]) == (mode, beta) and row["passed"]]
        steps = ", ".join(f"{row['limit']}: {row['total_mw']:.1f} MW" for row in rows)
        text = f"{mode_name(mode)}, β = {beta:g}: "
        text += f"within {steps}." if rows else "no limit lets it host."
        alone = every.get((mode, beta))
        if alone is not None and alone["passed"]:
            text += (
                f" With every site riding through {alone['total_mw']:.1f} MW, of which up to "
                f"{alone['aggregate_loss_mw']:.1f} MW are lost at once."
            )
            better = [
                row
                for row in rows
                if row["total_mw"] > alone["total_mw"]
                and row["aggregate_loss_mw"] < alone["aggregate_loss_mw"]
            ]
            if better:
                text += f" Within {better[-1]['limit']} more is hosted and less is lost."
        elif alone is not None and alone["passed"] is None:
            text += " With every site riding through nothing can be hosted."
        said.append(text)
    return said


def _reservations(rows: Sequence[Mapping[str, Any]]) -> list[Safe]:
    """What a reader must know of how the plans were found."""
    parts = []
    unsettled = [row for row in rows if not row["settled"]]
    if unsettled:
        parts.append(
            paragraph(
                "Searches that ended before nothing was left to gain: "
                + "; ".join(map(_name, unsettled))
                + "."
            )
        )
    sequence = list(dict.fromkeys(text for row in rows for text in row["by_sequence"]))
    if sequence:
        parts.append(
            paragraph(
                "The loss jumps where the sequence of events of a site changes. There the search keeps to "
                "the side that it has seen pass, and a larger plan beyond the jump may have escaped it:"
            )
        )
        parts.append(bullets(sequence))
    return parts


def _cells(row: Mapping[str, Any]) -> list[object]:
    loop = row["closed_loop"]
    worst = max(row["losses"], key=lambda entry: entry["loss_mw"], default=None)
    return [
        mode_name(row["mode"]),
        f"{row['beta']:g}",
        row["limit"],
        number(row["total_mw"], 2),
        buses(row["by_site"]),
        number(row["aggregate_loss_mw"], 2),
        "–" if worst is None else f"{worst['fault']}, {worst['period']}",
        ", ".join(f"bus {bus}" for bus in row["lost_whole"]) or "–",
        badge(VERDICTS[row["passed"]]),
        "–" if loop is None else number(loop["aggregate_loss_mw"], 2),
        "–" if loop is None else badge(VERDICTS[loop["passed"]]),
        number(row["price_mw_per_mw"], 2) if row["price_mw_per_mw"] > 0 else "–",
    ]


def _name(row: Mapping[str, Any]) -> str:
    return f"{mode_name(row['mode'])} at β {row['beta']:g} within {row['limit']}"


def _mw(row: Mapping[str, Any]) -> str:
    if row["n_failed"]:
        return f"an unknown load in {row['n_failed']} fault(s) and period(s)"
    return f"{row['aggregate_loss_mw']:.1f} MW at once"
