"""The facility models: response, supervisor, assumptions, and where they differ from the paper."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from dcvrt.dae import Row as ParameterRow
from dcvrt.studies.figures.internal_response import on_test_waveform
from dcvrt.studies.findings import Findings
from dcvrt.studies.report.page import Safe, definitions, escape, figure, paragraph, section, table
from dcvrt.studies.report.sensitivity import reference
from dcvrt.studies.style import mode_name


def facility(findings: Findings) -> Safe:
    """What a facility does on the test waveform, and its supervisor."""
    parts = []
    for mode in findings.modes:
        text = (
            f"Response of the {mode_name(mode)} facility to the ERCOT-style test waveform: ramp, shallow "
            "fault, deep fault and high voltage. The waveform is our own composition and not ERCOT's "
            "official one."
        )
        picture = findings.folder / "figures" / f"internal_response_{mode}.svg"
        if picture.is_file():
            parts.append(figure(picture, alt=text, caption=text))
        else:
            _, status = on_test_waveform(findings, mode)
            parts.append(paragraph(f"{mode_name(mode)}: no response to the test waveform: {status}"))
    dae = findings.facility(findings.modes[0])
    rows = "; ".join(row.text for automaton in dae.automata for row in automaton.rows)
    parts.append(
        figure(
            findings.folder / "figures" / "supervisor.svg",
            alt=f"Supervisor diagram. Transitions: {rows}.",
            caption=(
                "Supervisor of the facility, drawn from the transition table that the integrator runs. "
                "Values are those of the study."
            ),
        )
    )
    return section("The facility", *parts)


def assumptions(findings: Findings) -> Safe:
    """What the numbers rest on, and which of it is illustrative."""
    study = findings.study
    c, h = study.criteria, study.hosting
    criteria = definitions(
        [
            (
                "Voltage criterion",
                f"The protected IT voltage must not stay below {c.v_it_min_pu:g} pu for {c.window_ms:g} ms "
                f"({c.voltage_criterion}). Illustrative.",
            ),
            (
                "Loss criterion",
                f"At most {100 * c.loss_share:g} % of the import before the fault may be lost for "
                f"{c.loss_window_ms:g} ms. Illustrative.",
            ),
            ("Power factor", f"{h.pf:g} for every data centre. Illustrative."),
            ("Branch ratings", f"{h.rating_scale:g} times those of the case. The factor is illustrative."),
            ("Normal voltages", f"{h.v_min_pu:g} to {h.v_max_pu:g} pu in every hour."),
            (
                "Reactive power",
                "Generators hold their voltages as far as their reactive limits let them, in the power flow "
                "of the plans and before every fault."
                if h.reactive_limits
                else "Generators hold their voltages; their reactive limits are not enforced, neither in the "
                "power flow of the plans nor before the faults.",
            ),
            *[(f"Hours: {name}", text) for name, text in findings.provenance.get("sources", {}).items()],
            ("Phases", "Positive sequence only. A compliance verdict on the worst phase can differ."),
            (
                "Waveforms",
                "The facility is driven by the grid's waveform with its load as the grid model has it; "
                "its own reaction does not act back on the grid.",
            ),
            (
                "Nature of the result",
                "Screening. Facility parameters are not those of a product, and most are illustrative "
                "(table below).",
            ),
        ]
    )
    differing = _differing(findings)
    parts = [criteria]
    if len(findings.modes) > 1:
        parts.append(
            table(
                "Parameters that differ between the modes",
                ["parameter", *[mode_name(m) for m in findings.modes], "why"],
                differing,
                words=[1 + len(findings.modes)],
            )
            if differing
            else paragraph("No parameter that the modes share differs between them.")
        )
        if differing:
            parts.append(reference(findings, [str(row[0]) for row in differing]))
    changed = sorted(
        {
            (path, mode_name(mode), value)
            for mode in findings.modes
            for path, value in findings.parameters(mode).items()
        }
    )
    if changed:
        parts.append(
            table(
                "Parameters that the study file sets",
                ["parameter", "mode", "value"],
                [[path, mode, f"{value:g}"] for path, mode, value in changed],
                words=[1],
            )
        )
    given = _set_by_the_study(findings)
    tables = [
        table(
            f"Parameters of the {mode_name(mode)} facility",
            ["parameter", "value", "unit", "meaning", "source"],
            [_parameter(row, given) for row in findings.facility(mode).parameters],
            words=[2, 3, 4],
        )
        for mode in findings.modes
    ]
    counts = [
        f"{mode_name(mode)}: {sum('illustrative' in row.source for row in rows)} of {len(rows)} parameters "
        "are illustrative"
        for mode in findings.modes
        for rows in [[row for row in findings.facility(mode).parameters if row.path not in given]]
    ]
    parts.append(
        Safe(
            "<details><summary>All facility parameters "
            f"({escape('; '.join(counts))})</summary>{''.join(tables)}</details>"
        )
    )
    return section("Assumptions", *parts)


def _parameter(row: ParameterRow, given: Mapping[str, str]) -> list[object]:
    if row.path in given:
        return [row.path, given[row.path], row.unit, row.doc, "set by the study"]
    return [row.path, f"{row.value:g}", row.unit, row.doc, row.source or "not stated"]


def _set_by_the_study(findings: Findings) -> dict[str, str]:
    """Values of the parameters that are not the facility's own: each run has those of its place."""
    factors = [period["dc_factor"] for period in findings.periods.values()]
    return {
        "H": "1, on the base of the site's capacity",
        "beta": _span(findings.study.facility.beta),
        "d": _span(factors),
        "pf": f"{findings.study.hosting.pf:g}",
    }


def _span(values: Sequence[float]) -> str:
    low, high = f"{min(values):g}", f"{max(values):g}"
    return low if low == high else f"{low} to {high}"


def _differing(findings: Findings) -> list[list[object]]:
    """Parameters that all modes have and that do not have the same value in all."""
    tables = {mode: {row.path: row for row in findings.facility(mode).parameters} for mode in findings.modes}
    shared = [path for path in tables[findings.modes[0]] if all(path in t for t in tables.values())]
    rows: list[list[object]] = []
    for path in shared:
        values = [tables[mode][path].value for mode in findings.modes]
        if len(set(values)) > 1:
            why = "; ".join(
                dict.fromkeys(f"{mode_name(mode)}: {tables[mode][path].source}" for mode in findings.modes)
            )
            rows.append([path, *[f"{value:g}" for value in values], why])
    return rows


def deviations(findings: Findings) -> Safe:
    """Where the facility differs from the paper, as its blocks say it."""
    notes: dict[str, list[str]] = {}
    for mode in findings.modes:
        for note in findings.facility(mode).notes:
            notes.setdefault(note, []).append(mode_name(mode))
    rows = [
        [note.partition(": ")[0], note.partition(": ")[2], ", ".join(modes)] for note, modes in notes.items()
    ]
    return section(
        "Where the models differ from the paper",
        paragraph(
            "The paper leaves equations and all parameter values open. Each block says how it settles its "
            "gap."
        ),
        table("Differences by block", ["block", "what differs", "modes"], rows, words=[1, 2]),
    )
