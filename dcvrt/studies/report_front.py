"""First half of the report: the answer, the plans, what failed, what is closed, and how good the fits are."""

from __future__ import annotations

from dcvrt.studies.findings import (
    Findings,
    Row,
    ac_verdict,
    binding,
    binding_text,
    by_site,
    carried,
    closed,
    verdict,
)
from dcvrt.studies.page import Safe, badge, bullets, escape, figure, notice, number, paragraph, section, table
from dcvrt.studies.style import mode_name

METHODS = {
    "paper": "the paper's fit: margins in MW over load and rating, one fit for all ratings and periods",
    "share": "margins in pu volts and as a share of import, fitted at each rating",
}
TARGETS = {"voltage": "sustained IT voltage", "loss": "load loss"}


# -- the answer ---------------------------------------------------------------------------------------------------


def answer(findings: Findings) -> Safe:
    """How much, where, and what it takes; then everything that a reader must not overlook."""
    return section("The answer", Safe(f'<p class="answer">{escape(headline(findings))}</p>'), _cards(findings), _warnings(findings))


def headline(findings: Findings) -> str:
    """One or two sentences: the largest plan that passed every check, and what it takes.

    A plan counts only when the replay and the power flow passed it.
    """
    best, limit = findings.best(), findings.no_vrt_mw
    if best is None or best["total_mw"] <= 0:
        return (f"No data-centre load can be hosted at the sites studied with any mode and rating studied, if every site must "
                f"ride through every fault. Without ride-through it would be {limit:.1f} MW.")
    places = ", ".join(f"{mw:.1f} MW at bus {site}" for site, mw in zip(findings.sites, by_site(best, findings.sites), strict=True)
                       if mw > 0)
    share = 100.0 * best["total_mw"] / limit if limit > 0 else 100.0
    return (f"{best['total_mw']:.1f} MW of data-centre load can be hosted with ride-through: {places}. It takes {mode_name(best['mode'])} "
            f"converters rated at least {best['beta']:g} times the capacity. That is {share:.0f} % of the {limit:.1f} MW "
            "that the grid could host if no site had to ride through faults.")


def _cards(findings: Findings) -> Safe:
    """The key numbers of each mode."""
    cards = [(f"{findings.no_vrt_mw:.1f} MW", "without ride-through")]
    for mode in findings.modes:
        passed = [row for row in findings.rows(mode) if verdict(row) == "passed" and ac_verdict(row) == "passed"]
        if not passed:
            cards.append(("0 MW", f"{mode_name(mode)}: no plan passed the replay"))
            continue
        most = max(row["total_mw"] for row in passed)
        least = min((row for row in passed if row["total_mw"] >= most - findings.tolerance_mw), key=lambda row: row["beta"])
        cards.append((f"{least['total_mw']:.1f} MW", f"{mode_name(mode)}: most that passed the replay, from β = {least['beta']:g} "
                                                     f"on (method {least['method']})"))
    failed = sum(verdict(row) == "failed" for row in findings.rows())
    replayed = sum(verdict(row) != "nothing hosted" for row in findings.rows())
    cards.append((f"{failed} of {replayed}", "plans failed the replay"))
    return Safe('<div class="cards">' + "".join(f'<div class="card"><b>{escape(value)}</b><span>{escape(text)}</span></div>'
                                                for value, text in cards) + "</div>")


def _warnings(findings: Findings) -> Safe:
    """Boxes for what went wrong or is not as one would expect; each is computed from the rows."""
    boxes = []
    failed = [row for row in findings.rows() if verdict(row) == "failed"]
    if failed:
        boxes.append(notice(f"{len(failed)} plan(s) failed the replay and must not be used", bullets(
            [f"{name_of(row)}: {row['total_mw']:.1f} MW" for row in failed])))
    ac = [row for row in findings.rows() if ac_verdict(row) == "failed"]
    if ac:
        boxes.append(notice(f"{len(ac)} plan(s) failed the AC power flow", bullets([f"{name_of(row)}: {findings.plan(row)['ac_status']}"
                                                                                   for row in ac])))
    counts = findings.summary["simulations"]
    if counts["failed"] or counts["quarantined"]:
        boxes.append(notice("Some simulations have no result", paragraph(
            f"{counts['failed']} simulation(s) failed and {counts['quarantined']} task(s) were set aside. They are left out of the fits "
            "and count as failures in a replay. The section on simulations lists them.")))
    false = false_passes(findings)
    if sum(false.values()):
        boxes.append(notice("False passes: margins that a fit passes and the simulation does not", bullets(
            [f"method {method}, {mode_name(mode)}, {TARGETS[target]}: {count} validation point(s)"
             for (method, mode, target), count in false.items() if count])))
    falls = findings.falls()
    if falls:
        boxes.append(notice("Capacity falls somewhere as β rises", bullets(falls)))
    short = findings.shortfalls()
    if short:
        boxes.append(notice("The highest β does not reach the capacity without ride-through", bullets(short), "neutral"))
    good = []
    if not failed:
        good.append("Every plan that hosts anything passed the replay.")
    if not falls:
        good.append("Capacity never falls as β rises.")
    if not short:
        good.append("The highest β reaches the capacity without ride-through in every mode and method.")
    if not sum(false.values()):
        good.append("No fit passed a validation point that the simulation failed.")
    if good:
        boxes.append(notice("What holds", bullets(good), "good"))
    return Safe("".join(boxes))


def name_of(row: Row) -> str:
    """Mode, rating and method of a row in words."""
    return f"{mode_name(row['mode'])}, β = {row['beta']:g}, method {row['method']}"


def false_passes(findings: Findings) -> dict[tuple[str, str, str], int]:
    """Validation points predicted to pass that fail in simulation, by method, mode and target."""
    points = findings.predictions
    wrong = points[(points.predicted >= 0) & (points.margin < 0)]
    return {(row["method"], row["mode"], row["target"]):
            int(((wrong.method == row["method"]) & (wrong["mode"] == row["mode"]) & (wrong.target == row["target"])).sum())
            for row in findings.summary["surrogate"]}


# -- plans --------------------------------------------------------------------------------------------------------


def plans(findings: Findings) -> Safe:
    """Every row of the sweep with what binds and both verdicts, and the pictures of it."""
    sites = findings.sites
    head = ["mode", "β", "method", "total (MW)", *[f"bus {site} (MW)" for site in sites], "replay", "least voltage margin (pu)",
            "least loss margin (MW)", "largest aggregate loss (MW)", "AC power flow", "lowest voltage (pu)",
            "screen error (pu)", "what binds"]
    nothing = findings.no_vrt_by_site
    rows: list[list[object]] = [["none required", "–", "–", number(findings.no_vrt_mw, 2), *[number(nothing.get(s, 0.0), 2) for s in sites],
                                 "–", "–", "–", "–", *_ac_of_no_vrt(findings), limits_of_no_vrt(findings)]]
    ordered = [row for method in findings.methods for mode in findings.modes for row in findings.rows(mode, method)]
    for row in ordered:
        replay, ac = row["replay"], row["ac"]
        rows.append([mode_name(row["mode"]), f"{row['beta']:g}", row["method"], number(row["total_mw"], 2),
                     *[number(mw, 2) for mw in by_site(row, sites)], badge(verdict(row)),
                     number(replay["worst_voltage_margin_pu"], 4), number(replay["worst_loss_margin_mw"], 2),
                     number(replay["aggregate_loss_mw"], 2), badge(ac_verdict(row)), number(ac["v_min_pu"], 4),
                     number(ac["v_error_pu"], 5), _what_binds(row)])
    marked = [k for k, row in enumerate(ordered, 1) if verdict(row) == "failed" or ac_verdict(row) == "failed"]
    explained = [f"Method {method}: {METHODS.get(method, method)}." for method in findings.methods]
    pictures = [
        figure(findings.folder / "figures" / "capacity.svg", alt=_capacity_alt(findings), caption=(
            "Hosted capacity against the converter rating β. A red cross is a plan that failed the replay. The dashed grey line is "
            "the capacity without ride-through.")),
        figure(findings.folder / "figures" / "allocation.svg", alt="Stacked bars of the capacity of each site against beta; "
               "the same numbers stand in the table of plans.", caption="Where the capacity goes, by mode and method."),
    ]
    return section("Plans", *[paragraph(text) for text in explained],
                   paragraph("A negative margin is a failure. The aggregate loss is the largest sum of the sites' lost import in one "
                             "fault. Prices in brackets are hosted MW gained per unit by which the limit is relaxed."),
                   table("Plans by mode, rating and method", head, rows, words=[2, 4 + len(sites), 8 + len(sites), 11 + len(sites)],
                         marked=marked), *pictures)


def _what_binds(row: Row) -> str:
    found = [carried(row)] if carried(row) else []
    found += [binding_text(entry) for entry in binding(row)[:3]]
    shut = closed(row)
    if shut:
        found.append(f"closed: bus {', '.join(shut)}")
    more = len(binding(row)) - 3
    return "; ".join(found) + (f"; {more} more" if more > 0 else "") or "nothing"


def _ac_of_no_vrt(findings: Findings) -> list[object]:
    plan = findings.plans[findings.plans.method == "none"].iloc[0]
    return [badge("passed" if plan.ac_passed else "failed"), number(plan.ac_v_min_pu, 4), number(plan.ac_v_error_pu, 5)]


def limits_of_no_vrt(findings: Findings) -> str:
    """What limits the plan without ride-through."""
    plan = findings.plans[findings.plans.method == "none"].iloc[0]
    return "; ".join(binding_text(entry) for entry in plan.binding[:3]) or "nothing"


def _capacity_alt(findings: Findings) -> str:
    parts = [f"Without ride-through {findings.no_vrt_mw:.1f} MW."]
    for mode in findings.modes:
        for method in findings.methods:
            rows = findings.rows(mode, method)
            if rows:
                parts.append(f"{mode_name(mode)}, method {method}: " + ", ".join(
                    f"{row['total_mw']:.0f} MW at beta {row['beta']:g}" + (" (failed the replay)" if verdict(row) == "failed" else "")
                    for row in rows) + ".")
    return " ".join(parts)


# -- what failed, what is closed ----------------------------------------------------------------------------------


def failures(findings: Findings) -> Safe:
    """Plans that failed the replay: by how much, and where."""
    failed = [row for row in findings.rows() if verdict(row) == "failed"]
    if not failed:
        return section("Failed replays", paragraph("None: every plan that hosts anything passed the replay of all faults and periods."))
    rows = []
    for row in failed:
        plan = findings.plan(row)
        worst = plan["worst"]
        rows.append([name_of(row), number(row["total_mw"], 1), number(row["replay"]["worst_voltage_margin_pu"], 4),
                     _place(worst.get("voltage")), number(row["replay"]["worst_loss_margin_mw"], 2), _place(worst.get("loss")),
                     str(int(plan["n_failed"]))])
    return section("Failed replays", paragraph("These plans satisfy the fitted margins and not the simulation. They are no result."),
                   table("Plans that failed the replay", ["plan", "total (MW)", "least voltage margin (pu)", "where",
                                                          "least loss margin (MW)", "where", "runs without result"], rows, words=[3, 5]))


def _place(where: Row | None) -> str:
    if not where:
        return "–"
    path = str(where.get("sequence", "")).replace(">", " → ")
    return f"bus {where['site']}, fault {where['fault']}, {where['period']}" + (f" ({path})" if path else "")


def closed_sites(findings: Findings) -> Safe:
    """Sites that no plan may open, each with the reason and the ratings at which it is so."""
    reasons: dict[tuple[str, str, str, str], list[float]] = {}
    for row in findings.rows():
        for bus, why in closed(row).items():
            plain = why.replace(f", beta {row['beta']:g}", "")
            reasons.setdefault((bus, row["mode"], row["method"], plain), []).append(row["beta"])
    if not reasons:
        return section("Closed sites", paragraph("None: every site has capacity in every plan."))
    rows = [[f"bus {bus}", mode_name(mode), method, ", ".join(f"{beta:g}" for beta in betas), why]
            for (bus, mode, method, why), betas in sorted(reasons.items(), key=lambda item: (int(item[0][0]), item[0][1:]))]
    return section("Closed sites", paragraph("A site where no capacity passes a margin is closed: it gets no facility, and the margin does "
                                             "not hold back the other sites."),
                   table("Closed sites with the margin that closes them", ["site", "mode", "method", "at β", "reason"], rows,
                         words=[1, 2, 3, 4]))


# -- fits ---------------------------------------------------------------------------------------------------------


def validation(findings: Findings) -> Safe:
    """How well the fitted margins foretell simulations that they have not seen."""
    false = false_passes(findings)
    fits = findings.surrogates
    rows = []
    marked = []
    for k, score in enumerate(findings.summary["surrogate"]):
        key = (score["method"], score["mode"], score["target"])
        own = fits[(fits.method == key[0]) & (fits["mode"] == key[1]) & (fits.target == key[2])]
        unit = "pu" if key[2] == "voltage" else "MW" if key[0] == "paper" else "share"
        digits = 3 if unit == "MW" else 5
        rows.append([key[0], mode_name(key[1]), TARGETS[key[2]], unit, *[number(score[name], digits) for name in
                                                                     ("mae", "rmse", "worst_over", "worst_under")],
                     str(false[key]), number(100.0 * score["violation_rate"], 2, "–"), str(score["n_fit"]), str(score["n_validation"]),
                     str(int(own.n_excluded.sum())), str(int((own.n_sequences > 1).sum()))])
        if false[key]:
            marked.append(k)
    head = ["method", "mode", "margin", "unit", "mean absolute error", "root mean square error", "worst overprediction",
            "worst underprediction", "false passes", "conservative violations (%)", "points fitted", "validation points",
            "failed runs left out", "fits over mixed event sequences"]
    return section(
        "How good the fitted margins are",
        paragraph("Each margin is fitted on some of the samples, lowered by its largest overprediction there, and judged on samples that the "
                  "fit has not seen. A conservative violation is a prediction above the simulated margin; a false pass is one that also "
                  "passes a point that truly fails. Errors of the two methods have different units."),
        table("Validation of the surrogates after tightening", head, rows, words=[1, 2, 3], marked=marked),
        figure(findings.folder / "figures" / "validation.svg", alt=_validation_alt(findings, false),
               caption="Simulated against predicted margins after tightening. Points above the line are overpredictions; the shaded "
                       "quadrant holds false passes, ringed in red."))


def _validation_alt(findings: Findings, false: dict[tuple[str, str, str], int]) -> str:
    return "Scatter of simulated against predicted margins. " + " ".join(
        f"Method {method}, {mode_name(mode)}, {TARGETS[target]}: {count} false passes." for (method, mode, target), count in false.items())


# -- worst cases --------------------------------------------------------------------------------------------------


def worst_cases(findings: Findings) -> Safe:
    """Waveforms of the replayed run with the least margin, for each mode."""
    parts: list[Safe] = []
    for mode in findings.modes:
        case = findings.worst_case(mode)
        picture = findings.folder / "figures" / f"worst_case_{mode}.svg"
        if case is None or not picture.is_file():
            parts.append(paragraph(f"{mode_name(mode)}: no plan with capacity was replayed."))
            continue
        passed = case.v_margin_pu >= 0 and case.loss_margin_share >= 0
        path = case.sequence.replace(">", " → ") or "not recorded"
        text = (f"{mode_name(mode)}, β = {case.beta:g}, {case.h_mw:.1f} MW at bus {case.site}; fault {case.fault}, period {case.period}. "
                f"Voltage margin {number(case.v_margin_pu, 4)} pu, loss margin {number(100 * case.loss_margin_share, 2)} % of the import "
                f"before the fault: {'passed' if passed else 'FAILED'}. Modes passed through: {path}.")
        parts.append(figure(picture, alt=f"Waveforms of the worst replayed run. {text}", caption=text))
    return section("The worst replayed cases", *parts)
