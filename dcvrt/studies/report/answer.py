"""The answer: how much, where, what it takes, and what a reader must not overlook."""

from __future__ import annotations

from dcvrt.planning import surrogate
from dcvrt.studies.findings import Findings
from dcvrt.studies.report import caveats, coupling
from dcvrt.studies.report.caveats import name_of
from dcvrt.studies.report.page import Safe, bullets, escape, notice, paragraph, section
from dcvrt.studies.report.record import failed_runs
from dcvrt.studies.rows import ac_verdict, by_site, verdict
from dcvrt.studies.style import mode_name

TARGETS = {"voltage": "IT voltage", "loss": "load loss"}


def answer(findings: Findings) -> Safe:
    """How much, where, and what it takes; then everything that a reader must not overlook."""
    return section(
        "The answer",
        Safe(f'<p class="answer">{escape(headline(findings))}</p>'),
        paragraph(in_closed_loop(findings)),
        _cards(findings),
        _warnings(findings),
    )


def headline(findings: Findings) -> str:
    """One or two sentences: the largest plan that passed every check, and what it takes.

    A plan counts only when the replay and the power flow passed it.
    """
    best, limit = findings.best(), findings.no_vrt_mw
    if not findings.anything_simulated:
        return (
            f"Nothing could be simulated: none of the {len(findings.margins)} facility runs has a result, so "
            f"that no hosted load could be tested. Without ride-through it would be {limit:.1f} MW."
        )
    if best is None or best["total_mw"] <= 0:
        return (
            "No data-centre load can be hosted at the sites studied with any mode and rating studied, if "
            f"every site must ride through every fault. Without ride-through it would be {limit:.1f} MW."
        )
    places = ", ".join(
        f"{mw:.1f} MW at bus {site}"
        for site, mw in zip(findings.sites, by_site(best, findings.sites), strict=True)
        if mw > 0
    )
    equal = [
        row
        for row in map(findings.best, findings.modes)
        if row and row["total_mw"] >= best["total_mw"] - findings.tolerance_mw
    ]
    takes = " or ".join(
        f"{mode_name(row['mode'])} converters rated {row['beta']:g} times the capacity" for row in equal
    )
    share = 100.0 * best["total_mw"] / limit if limit > 0 else 100.0
    return (
        f"{best['total_mw']:.1f} MW of data-centre load can be hosted with ride-through: {places}. It "
        f"takes {takes} (the least rating studied that passed). That is {share:.0f} % of the {limit:.1f} "
        "MW that the grid could host if no site had to ride through faults."
    )


def in_closed_loop(findings: Findings) -> str:
    """What of the answer is left when the facilities act back on the network in the fault."""
    if findings.best() is None or not findings.closed_loop:
        return (
            "The verdicts take hosted load as an impedance in the fault; no plan was simulated with its "
            "facilities acting back on the network."
        )
    said = []
    for mode in findings.modes:
        best, row = findings.best(mode), findings.best(mode, closed_loop=True)
        if best is None:
            continue
        if row is None:
            said.append(f"{mode_name(mode)}: none of the plans")
        else:
            said.append(f"{mode_name(mode)}: {row['total_mw']:.1f} MW at β = {row['beta']:g}")
    return (
        "These plans are judged with hosted load as an impedance in the fault. Facilities also act back on "
        "the network through their control (closed loop). The largest plan at the ratings studied that rides "
        f"through in closed loop as well is, with {'; with '.join(said)}."
    )


def _cards(findings: Findings) -> Safe:
    """The key numbers of each mode."""
    cards = [(f"{findings.no_vrt_mw:.1f} MW", "without ride-through")]
    for mode in findings.modes:
        best = findings.best(mode)
        if best is None:
            cards.append(("0 MW", f"{mode_name(mode)}: no plan passed the replay"))
        else:
            cards.append(
                (
                    f"{best['total_mw']:.1f} MW",
                    f"{mode_name(mode)}: most that passed the replay, at β = {best['beta']:g} (method "
                    f"{best['method']})",
                )
            )
    failed = sum(verdict(row) == "failed" for row in findings.rows())
    replayed = sum(verdict(row) != "nothing hosted" for row in findings.rows())
    cards.append((f"{failed} of {replayed}", "plans failed the replay"))
    return Safe(
        '<div class="cards">'
        + "".join(
            f'<div class="card"><b>{escape(value)}</b><span>{escape(text)}</span></div>'
            for value, text in cards
        )
        + "</div>"
    )


def _warnings(findings: Findings) -> Safe:
    """Boxes for what went wrong or is not as one would expect; each is computed from the rows."""
    boxes = []
    failed = [row for row in findings.rows() if verdict(row) == "failed"]
    if failed:
        boxes.append(
            notice(
                f"{len(failed)} plan(s) failed the replay and must not be used",
                bullets([f"{name_of(row)}: {row['total_mw']:.1f} MW" for row in failed]),
            )
        )
    ac = [row for row in findings.rows() if ac_verdict(row) == "failed"]
    if ac:
        boxes.append(
            notice(
                f"{len(ac)} plan(s) failed the AC power flow",
                bullets([f"{name_of(row)}: {findings.plan(row)['ac_status']}" for row in ac]),
            )
        )
    turned = coupling.turned(findings)
    if turned:
        boxes.append(
            notice(
                f"{len(turned)} plan(s) do not ride through once their facilities act on the network",
                bullets(turned),
            )
        )
    reactive = caveats.reactive_limits(findings)
    if reactive:
        boxes.append(notice("Units beyond their reactive limits", bullets(reactive)))
    counts = findings.summary["simulations"]
    if counts["failed"] or counts["quarantined"]:
        boxes.append(
            notice(
                "Some simulations have no result",
                Safe(
                    paragraph(
                        f"{counts['failed']} simulation(s) failed and {counts['quarantined']} task(s) were "
                        "set aside. They are left out of the fits and count as failures in a replay. Where "
                        "no fit remains, the site is closed. The section on simulations lists them all."
                    )
                    + bullets(_reasons(findings))
                ),
            )
        )
    false = false_passes(findings)
    if sum(false.values()):
        boxes.append(
            notice(
                "False passes: margins that a fit passes and the simulation does not",
                bullets(
                    [
                        f"method {method}, {mode_name(mode)}, {TARGETS[target]}: {count} validation point(s)"
                        for (method, mode, target), count in false.items()
                        if count
                    ]
                ),
            )
        )
    falls = findings.falls()
    if falls:
        boxes.append(notice("Capacity falls somewhere as β rises", bullets(falls)))
    edge = caveats.lower_bounds(findings)
    if edge:
        boxes.append(
            notice(
                "Some capacities are lower bounds",
                Safe(paragraph(caveats.LOWER_BOUNDS) + bullets(edge)),
                "neutral",
            )
        )
    short = findings.shortfalls()
    if short:
        boxes.append(
            notice(
                "The highest β does not reach the capacity without ride-through", bullets(short), "neutral"
            )
        )
    good = []
    if not failed:
        good.append("Every plan that hosts anything passed the replay.")
    if not falls:
        good.append(f"Capacity never falls as β rises ({caveats.why_it_never_falls(findings)}).")
    if not short:
        good.append("The highest β reaches the capacity without ride-through in every mode and method.")
    if not sum(false.values()):
        good.append("No fit passed a validation point that the simulation failed.")
    if good and findings.anything_simulated:
        boxes.append(notice("What holds", bullets(good), "good"))
    return Safe("".join(boxes))


def false_passes(findings: Findings) -> dict[tuple[str, str, str], int]:
    """Validation points predicted to pass that fail in simulation, by method, mode and target."""
    points = findings.predictions
    wrong = points[surrogate.false_passes(points.predicted, points.margin)]
    return {
        (row["method"], row["mode"], row["target"]): int(
            (
                (wrong.method == row["method"])
                & (wrong["mode"] == row["mode"])
                & (wrong.target == row["target"])
            ).sum()
        )
        for row in findings.summary["surrogate"]
    }


def _reasons(findings: Findings) -> list[str]:
    """Why simulations failed, the most frequent reason first, with the ratings and periods it came up at."""
    failed = failed_runs(findings)
    said = []
    for reason in failed.reason.value_counts().index[:3]:
        here = failed[failed.reason == reason]
        ratings = ", ".join(f"{beta:g}" for beta in sorted(here.beta.unique()))
        periods = ", ".join(sorted(here.period.unique()))
        said.append(f"{reason}: {len(here)} run(s), at β = {ratings}, period {periods}.")
    return said
