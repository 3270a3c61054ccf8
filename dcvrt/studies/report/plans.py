"""The plans of the sweep: capacities, what binds, both verdicts; what failed and what is closed."""

from __future__ import annotations

from dcvrt.studies.findings import Findings
from dcvrt.studies.report import caveats
from dcvrt.studies.report.caveats import name_of
from dcvrt.studies.report.page import (
    Safe,
    badge,
    bullets,
    escape,
    figure,
    magnitude,
    number,
    paragraph,
    section,
    table,
)
from dcvrt.studies.rows import Row, ac_verdict, binding, binding_text, by_site, carried, closed, verdict
from dcvrt.studies.style import mode_name

METHODS = {
    "paper": "the paper's fit: margins in MW over load and rating, one fit for all ratings and periods",
    "share": "margins in pu volts and as a share of import, fitted at each rating",
    "frontier": "exact margins with gradients at the candidates themselves, outside the sampled box too",
}


def plans(findings: Findings) -> Safe:
    """Every row of the sweep with what binds and both verdicts, and the pictures of it."""
    sites = findings.sites
    nothing = findings.no_vrt_by_site
    ordered = [
        row for method in findings.methods for mode in findings.modes for row in findings.rows(mode, method)
    ]
    marked = [
        k for k, row in enumerate(ordered, 1) if verdict(row) == "failed" or ac_verdict(row) == "failed"
    ]
    head = [
        "mode",
        "β",
        "method",
        "total (MW)",
        *[f"bus {site} (MW)" for site in sites],
        "replay",
        "AC",
        "what binds",
    ]
    rows: list[list[object]] = [
        [
            "none required",
            "–",
            "–",
            number(findings.no_vrt_mw, 2),
            *[number(nothing.get(site, 0.0), 2) for site in sites],
            "–",
            _ac_of_no_vrt(findings)[0],
            limits_of_no_vrt(findings),
        ]
    ]
    rows += [
        [
            mode_name(row["mode"]),
            f"{row['beta']:g}",
            row["method"],
            number(row["total_mw"], 2),
            *[number(mw, 2) for mw in by_site(row, sites)],
            badge(verdict(row)),
            badge(ac_verdict(row)),
            _what_binds(row),
        ]
        for row in ordered
    ]
    check_head = [
        "mode",
        "β",
        "method",
        "replay",
        "least voltage margin (pu)",
        "least loss margin (MW)",
        "largest aggregate loss (MW)",
        "AC power flow",
        "lowest voltage (pu)",
        "error of the linear screen (pu)",
        "units above q_max, worst hour",
        "largest excess (Mvar)",
        "units below q_min, worst hour",
        "largest excess (Mvar)",
    ]
    checks: list[list[object]] = [["none required", "–", "–", "–", "–", "–", "–", *_ac_of_no_vrt(findings)]]
    checks += [
        [
            mode_name(row["mode"]),
            f"{row['beta']:g}",
            row["method"],
            badge(verdict(row)),
            number(row["replay"]["worst_voltage_margin_pu"], 4),
            number(row["replay"]["worst_loss_margin_mw"], 2),
            number(row["replay"]["aggregate_loss_mw"], 2),
            badge(ac_verdict(row)),
            number(row["ac"]["v_min_pu"], 4),
            magnitude(row["ac"]["v_error_pu"]),
            *_reactive(findings.plan(row)),
        ]
        for row in ordered
    ]
    explained = [f"Method {method}: {METHODS.get(method, method)}." for method in findings.methods]
    pictures = [
        figure(
            findings.folder / "figures" / "capacity.svg",
            alt=_capacity_alt(findings),
            caption=(
                "Hosted capacity against the converter rating β. A red cross is a plan that failed the "
                "replay, a red ring one that passed it and fails in closed loop. The dashed grey line is the "
                "capacity without ride-through."
            ),
        ),
        figure(
            findings.folder / "figures" / "allocation.svg",
            alt="Stacked bars of the capacity of each site against beta; "
            "the same numbers stand in the table of plans.",
            caption="Where the capacity goes, by mode and method.",
        ),
    ]
    words = 4 + len(sites)
    edge, loaded = caveats.lower_bounds(findings), caveats.limited_before_fault(findings)
    return section(
        "Plans",
        *pictures,
        *[paragraph(text) for text in explained],
        paragraph("Prices in brackets are hosted MW gained per unit by which a limit is relaxed."),
        *([paragraph(caveats.LOWER_BOUNDS), bullets(edge)] if edge else []),
        table(
            "Plans by method, mode and rating",
            head,
            rows,
            words=[2, words, words + 1, words + 2],
            marked=marked,
        ),
        paragraph(
            "The replay simulates every fault in every period with every facility of the plan. A negative "
            "margin is a failure. The aggregate loss is the largest sum of the sites' lost import in one "
            "fault. The AC power flow covers every hour; the error is that of the linear voltage screen "
            "near a limit. The last columns say how far units are beyond their reactive limits: "
            + (
                "none is, as these are enforced."
                if findings.study.hosting.reactive_limits
                else "these are not enforced, the voltages of the units are held whatever that takes."
            )
        ),
        table("Checks of each plan", check_head, checks, words=[2, 3, 7], marked=marked),
        paragraph(loaded[0]),
        *([bullets(loaded[1:])] if loaded[1:] else []),
    )


def _what_binds(row: Row) -> Safe:
    """Closed sites and the highest-priced limits, one a line; the row says mode and rating already."""
    shut = closed(row)
    found = [carried(row)] if carried(row) else []
    found += [f"closed: bus {', '.join(shut)}"] if shut else []
    found += [binding_text(entry).replace(_place_in_sweep(row), "") for entry in binding(row)[:2]]
    more = len(binding(row)) - 2
    found += [f"{more} more"] if more > 0 else []
    return Safe("<br>".join(escape(line) for line in found or ["nothing"]))


def _place_in_sweep(row: Row) -> str:
    """How the labels of fitted rows end."""
    return f", {row['mode']}, beta {row['beta']:g}"


def _ac_of_no_vrt(findings: Findings) -> list[object]:
    plan = caveats.no_vrt(findings)
    return [
        badge("passed" if plan["ac_passed"] else "failed"),
        number(plan["ac_v_min_pu"], 4),
        magnitude(plan["ac_v_error_pu"]),
        *_reactive(plan),
    ]


def _reactive(plan: Row) -> list[object]:
    """Units beyond their reactive limits at a plan of the store, and by how much."""
    found = caveats.reactive_excess(plan)
    if found is None:
        return ["–"] * 4
    sides = (found.above, found.below)
    return [text for side in sides for text in (str(side.units), number(side.excess_mvar, 1))]


def limits_of_no_vrt(findings: Findings) -> Safe:
    """What limits the plan without ride-through."""
    plan = findings.plans[findings.plans.method == "none"].iloc[0]
    found = [binding_text(entry) for entry in plan.binding[:2]]
    return Safe("<br>".join(escape(line) for line in found or ["nothing"]))


def _capacity_alt(findings: Findings) -> str:
    parts = [f"Without ride-through {findings.no_vrt_mw:.1f} MW."]
    for mode in findings.modes:
        for method in findings.methods:
            rows = findings.rows(mode, method)
            if rows:
                parts.append(
                    f"{mode_name(mode)}, method {method}: "
                    + ", ".join(
                        f"{row['total_mw']:.0f} MW at beta {row['beta']:g}"
                        + (" (failed the replay)" if verdict(row) == "failed" else "")
                        for row in rows
                    )
                    + "."
                )
    return " ".join(parts)


def failures(findings: Findings) -> Safe:
    """Plans that failed the replay: by how much, and where."""
    failed = [row for row in findings.rows() if verdict(row) == "failed"]
    if not failed:
        return section(
            "Failed replays",
            paragraph("None: every plan that hosts anything passed the replay of all faults and periods."),
        )
    rows = []
    for row in failed:
        plan = findings.plan(row)
        worst = plan["worst"]
        rows.append(
            [
                name_of(row),
                number(row["total_mw"], 1),
                number(row["replay"]["worst_voltage_margin_pu"], 4),
                _place(worst.get("voltage")),
                number(row["replay"]["worst_loss_margin_mw"], 2),
                _place(worst.get("loss")),
                str(int(plan["n_failed"])),
            ]
        )
    return section(
        "Failed replays",
        paragraph("These plans satisfy the fitted margins and not the simulation. They are no result."),
        table(
            "Plans that failed the replay",
            [
                "plan",
                "total (MW)",
                "least voltage margin (pu)",
                "where",
                "least loss margin (MW)",
                "where",
                "runs without result",
            ],
            rows,
            words=[3, 5],
        ),
    )


def _place(where: Row | None) -> str:
    if not where:
        return "–"
    path = str(where.get("sequence", "")).replace(">", " → ")
    return f"bus {where['site']}, fault {where['fault']}, {where['period']}" + (f" ({path})" if path else "")


def closed_sites(findings: Findings) -> Safe:
    """Sites that no plan may open, each with the reason and the ratings at which it is so."""
    reasons: dict[tuple[str, str, str], dict[str, list[float]]] = {}
    for row in findings.rows():
        for bus, why in closed(row).items():
            plain = why.removeprefix("no capacity in the sampled box passes: ").replace(
                f", {row['mode']}, beta {row['beta']:g}", ""
            )
            reasons.setdefault((bus, row["mode"], row["method"]), {}).setdefault(plain, []).append(
                row["beta"]
            )
    if not reasons:
        return section("Closed sites", paragraph("None: every site has capacity in every plan."))
    rows = []
    for (bus, mode, method), found in sorted(
        reasons.items(), key=lambda item: (int(item[0][0]), item[0][1:])
    ):
        lines = [f"β {', '.join(f'{beta:g}' for beta in betas)}: {why}" for why, betas in found.items()]
        rows.append(
            [f"bus {bus}", mode_name(mode), method, Safe("<br>".join(escape(line) for line in lines))]
        )
    return section(
        "Closed sites",
        paragraph(
            "A site where no capacity in the sampled box passes a margin is closed: it gets no facility, "
            "and its margins do not hold back the other sites."
        ),
        table(
            "Closed sites with the margin that closes them",
            ["site", "mode", "method", "at β: the margin that closes it"],
            rows,
            words=[1, 2, 3],
        ),
    )
