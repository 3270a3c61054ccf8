"""How good the fitted margins are, and the worst of the replayed cases."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from dcvrt.studies.findings import Findings
from dcvrt.studies.report.answer import TARGETS, false_passes
from dcvrt.studies.report.page import Safe, bullets, figure, number, paragraph, section, table
from dcvrt.studies.style import mode_name


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
        rows.append(
            [
                key[0],
                mode_name(key[1]),
                TARGETS[key[2]],
                unit,
                *[number(score[name], digits) for name in ("mae", "rmse", "worst_over", "worst_under")],
                str(false[key]),
                "–" if (rate := score["violation_rate"]) is None else number(100.0 * rate, 2),
                str(score["n_fit"]),
                str(score["n_validation"]),
                str(score["n_validation_failed"]),
                str(int(own.n_excluded.sum())),
                str(int((own.n_sequences > 1).sum())),
            ]
        )
        if false[key]:
            marked.append(k)
    head = [
        "method",
        "mode",
        "margin",
        "unit",
        "MAE",
        "RMSE",
        "worst over-prediction",
        "worst under-prediction",
        "false passes",
        "violation rate (%)",
        "points fitted",
        "validation points",
        "failed validation runs",
        "failed runs left out of the fit",
        "fits of mixed sequences",
    ]
    one_sided = findings.provenance.get("one_sided", [])
    return section(
        "How good the fitted margins are",
        *(
            [
                paragraph(
                    f"Of {len(one_sided)} margins the fitting set has seen one side only, met or missed, or "
                    "no result at all; a fit that says the other side extrapolates. By margin and site, over "
                    "faults, modes and ratings:"
                ),
                bullets(counted(one_sided)),
            ]
            if one_sided
            else []
        ),
        paragraph(
            "Each margin is fitted on some of the samples, lowered by its largest overprediction there, "
            "and judged on samples that the fit has not seen. A false pass is a point that the fit passes "
            "and whose margin is negative or whose simulation failed; the conservative-violation rate is "
            "their share of all validation points, with a margin or without one. MAE is the mean absolute "
            "error, RMSE the root mean square error; those of the two methods have different units."
        ),
        table("Validation of the surrogates after tightening", head, rows, words=[1, 2, 3], marked=marked),
        *forms(findings),
        figure(
            findings.folder / "figures" / "validation.svg",
            alt=_validation_alt(findings, false),
            caption="Simulated against predicted margins after tightening. Points above the line are "
            "overpredictions; the shaded quadrant holds false passes, ringed in red.",
        ),
    )


def counted(one_sided: Sequence[str]) -> list[str]:
    """How many margins of each site have been seen from one side only, and from which."""
    seen = Counter((text.split(", fault")[0], text.rsplit(": ", 1)[1]) for text in one_sided)
    return [f"{where}: {count} times {why}" for (where, why), count in sorted(seen.items())]


FORMS = {
    "paper": "affine in load and rating, MW; least squares, tightened; pooled over ratings and periods",
    "share": "affine in H, pu and share of load; least squares, tightened; a fit per rating",
    "bound": "affine in H, pu and share of load; highest bound below the samples; a fit per rating, period",
    "pieces": "the least of affine pieces found from gradients, split by event sequence",
}


def forms(findings: Findings) -> list[Safe]:
    """Forms of the margins side by side on the same samples; nothing where no vector was held out."""
    judged = findings.provenance.get("forms", [])
    if not judged:
        return []
    rows = [
        [
            form["method"],
            FORMS[form["method"]],
            str(form["feasible"]),
            str(form["kept"]),
            number(100.0 * form["kept"] / form["feasible"], 1) if form["feasible"] else "–",
            str(form["false_passes"]),
            *(
                number(form["scores"][target][score], digits)
                for target, digits in (("voltage", 5), ("loss", 4))
                for score in ("mae", "worst_over")
            ),
        ]
        for form in judged
    ]
    return [
        paragraph(
            "Forms of the margins on the same samples: of the pairs of site and held-out vector that truly "
            "pass every fault in every period, over all modes and ratings, how many does each form let pass? "
            + (
                ""
                if any(form["method"] == "pieces" for form in judged)
                else "Pieces found from gradients are judged too with sampling.gradients = true."
            )
        ),
        table(
            "What each form keeps of what is feasible",
            [
                *("form", "what it is", "feasible pairs", "kept", "share kept (%)", "false passes"),
                *("voltage: MAE (pu)", "worst over-prediction (pu)"),
                *("loss: MAE (share; paper: MW)", "worst over-prediction (share; paper: MW)"),
            ],
            rows,
            words=[1],
        ),
    ]


def _validation_alt(findings: Findings, false: dict[tuple[str, str, str], int]) -> str:
    return "Scatter of simulated against predicted margins. " + " ".join(
        f"Method {method}, {mode_name(mode)}, {TARGETS[target]}: {count} false passes."
        for (method, mode, target), count in false.items()
    )


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
        text = (
            f"{mode_name(mode)}, β = {case.beta:g}, {case.h_mw:.1f} MW at bus {case.site}; fault "
            f"{case.fault}, period {case.period}. Voltage margin {number(case.v_margin_pu, 4)} pu, loss "
            f"margin {number(100 * case.loss_margin_share, 2)} % of the import before the fault: "
            f"{'passed' if passed else 'FAILED'}. Modes passed through: {path}."
        )
        parts.append(figure(picture, alt=f"Waveforms of the worst replayed run. {text}", caption=text))
    return section("The worst replayed cases", *parts)
