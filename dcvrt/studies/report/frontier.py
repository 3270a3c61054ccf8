"""The page that puts the paper's method and the frontier side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from dcvrt.studies.comparison import buses
from dcvrt.studies.findings import Findings
from dcvrt.studies.report.page import Safe, badge, bullets, escape, number, paragraph, section, table
from dcvrt.studies.style import mode_name


def frontier(findings: Findings) -> Safe:
    """Capacities, verdicts, simulations and what binds of both methods; nothing where none was searched."""
    found = findings.comparison
    if not found["rows"]:
        return Safe("")
    spent, head = (
        found["simulations"],
        ["fault simulations", "of them failed", "facility runs", "of them failed"],
    )
    fields = ("grid", "grid_failed", "facility", "facility_failed")
    names = {
        "paper": "samples of the paper's method",
        "frontier": "search of the frontier, all with gradients",
        "replay": "replays of both methods",
    } | (
        {
            "system_search": "search under system limits, all with gradients",
            "system_replay": "replays of its candidates",
        }
        if findings.system_limits["rows"]
        else {}
    )
    false = [row for row in found["rows"] if row["paper"]["false_pass"]]
    ratio = found["ratio"]
    unsettled = [row for row in found["rows"] if not row["settled"]]
    sequence = list(dict.fromkeys(text for row in found["rows"] for text in row["by_sequence"]))
    return section(
        "Paper's method and frontier",
        paragraph(
            "The paper's method fits affine margins to samples, lowers them by their largest error and keeps "
            "plans to the sampled box. The frontier simulates its own candidates, with the derivative of "
            "every margin by every site's capacity, cuts off what fails, and ends when nothing is left to "
            "gain. Both are replayed in the same way."
        ),
        table(
            "Both methods at every mode and rating",
            ["mode", "β", "paper (MW)", "sites (MW)", "replay", "closed loop", "frontier (MW)", "sites (MW)",
             "replay", "closed loop", "gain (MW)", "what binds the frontier"],
            [_cells(row) for row in found["rows"]],
            words=[3, 7, 11],
        ),
        paragraph(
            "Closed loop: whether the plan also rides through with its facilities acting on the network, by "
            "the native engine; the replay takes hosted load as an impedance (see Facilities in the "
            "network). Gain: what the frontier hosts beyond the paper's method at equal safety, where the "
            "plans of both passed the replay."
        ),
        paragraph(
            f"False passes of the paper's fits: {len(false)}. "
            + (
                ""
                if ratio is None
                else f"The search spent {ratio:.3f} times the fault simulations of the paper's sampling, for "
                "all modes and ratings together."
            )
        ),
        table("Simulations spent", ["for", *head], [
            [names[kind], *[str(spent[kind][field]) for field in fields]] for kind in names
        ]),
        paragraph("Capacity that the fits hid:" if found["hidden"] else "The fits hid no capacity."),
        *([bullets(found["hidden"])] if found["hidden"] else []),
        paragraph("In the frontier's plans, which rest on no fit and no sampled box, sites open from these "
                  "ratings on:"),
        bullets(_openings(found["rows"])),
        *(
            [
                paragraph("Limits set by bisection, on the safe side of a change of the event sequence:"),
                bullets(sequence),
            ]
            if sequence
            else [paragraph("No limit had to be set by bisection at a change of the event sequence.")]
        ),
        *(
            [paragraph("Searches that ended before nothing was left to gain: "
                       + ", ".join(f"{row['mode']} at β {row['beta']:g}" for row in unsettled) + ".")]
            if unsettled
            else []
        ),
    )  # fmt: skip


def _openings(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """From which rating on the frontier has each site open, by mode."""
    said = []
    for mode in dict.fromkeys(row["mode"] for row in rows):
        sizes = {row["beta"]: row["frontier"]["by_site"] for row in rows if row["mode"] == mode}
        first = {
            bus: next((f"from β = {beta:g}" for beta in sorted(sizes) if sizes[beta][bus] > 0), "at none")
            for bus in next(iter(sizes.values()))
        }
        said.append(f"{mode_name(mode)}: " + ", ".join(f"bus {bus} {since}" for bus, since in first.items()))
    return said


def _cells(row: Mapping[str, Any]) -> list[object]:
    cells: list[object] = [mode_name(row["mode"]), f"{row['beta']:g}"]
    for method in ("paper", "frontier"):
        found = row[method]
        verdict = {True: "passed", False: "failed", None: "nothing hosted"}[found["passed"]]
        loop = {True: badge("passed"), False: badge("failed"), None: "–"}[found["closed_loop"]]
        cells += [number(found["total_mw"], 2), buses(found["by_site"]), badge(verdict), loop]
    return [*cells, "–" if row["gain_mw"] is None else number(row["gain_mw"], 2), _binding(row)]


def _binding(row: Mapping[str, Any]) -> Safe:
    lines = [
        f"{item['target']} at bus {item['site']}, fault {item['fault']}, {item['period']}: "
        f"{item.get('mechanism', 'mechanism not known')}; {0.01 * item['by_beta']:+.1f} MW per 0.01 of β"
        for item in row["margins"]
    ]
    shut = row["frontier"]["closed"]
    lines += [f"bus {bus} closed: {why}" for bus, why in shut.items()]
    return Safe("<br>".join(escape(line) for line in lines or ["the network alone"]))
