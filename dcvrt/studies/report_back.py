"""Second half of the report: grid, facility, simulations, assumptions, deviations, method, provenance."""

from __future__ import annotations

from dcvrt.dae import Row as ParameterRow
from dcvrt.studies.campaign import LOST
from dcvrt.studies.figures.faults import fault_name, retained
from dcvrt.studies.findings import Findings
from dcvrt.studies.page import Safe, definitions, escape, figure, number, paragraph, section, table
from dcvrt.studies.style import mode_name


def grid(findings: Findings) -> Safe:
    """Network, sites, faults with what they do to each site, and the hours that they are simulated in."""
    table_of = retained(findings.margins)
    lowest = {(row.fault, row.site): (row.min, row.max) for row in table_of.itertuples()}
    hardest = {site: min((f for f, s in lowest if s == site), key=lambda f, s=site: lowest[f, s][0], default="") for site in findings.sites}
    fault_rows = []
    for fault in findings.faults:
        name = fault_name(fault)
        cells = ["–" if (name, s) not in lowest else f"{lowest[name, s][0]:.3f} to {lowest[name, s][1]:.3f}" for s in findings.sites]
        why = [str(site) for site in findings.sites if hardest[site] == name]
        fault_rows.append([f"bus {fault.bus}", f"{fault.t_clear_ms:g}", f"{fault.x_pu:g}", *cells,
                           f"lowest voltage of all at bus {', '.join(why)}" if why else "–"])
    period_rows = [[name, str(p["hour"]), number(p["load_scale"], 3), number(p["dc_factor"], 3),
                    ", ".join(f"bus {bus}: {mw:.0f}" for bus, mw in p["wind"].items()) or "none"]
                   for name, p in findings.periods.items()]
    parts = [paragraph(f"Network: {findings.study.grid.case}. Candidate sites: bus {', '.join(map(str, findings.sites))}. Faults are "
                       f"three-phase, at buses without a data centre, and clear by themselves; simulated with {findings.study.grid.engine}.")]
    picture = findings.folder / "figures" / "network_map.svg"
    if picture.is_file():
        parts.append(figure(picture, alt="One-line map of the network. " + _map_text(findings), caption=(
            "The network. The layout follows the lines, not geography. The area of a site's square grows with its capacity in the plan "
            "without ride-through.")))
    else:
        parts.append(paragraph(f"The map of the network is not drawn: {findings.map_problem}"))
    parts += [
        table("Faults, and the lowest voltage that they leave at each site (pu, over all hosting vectors and periods)",
              ["fault", "cleared after (ms)", "reactance (pu)", *[f"bus {site}" for site in findings.sites], "limits"], fault_rows,
              words=[3 + len(findings.sites)]),
        figure(findings.folder / "figures" / "retained_voltage.svg", alt="Lowest voltage during each fault at each site; the numbers stand in "
               "the table above.", caption=(
                   "Lowest POI voltage by fault and site: the marker is the middle, the bar the range over hosting vectors and periods. The "
                   "dashed lines are (1 − allowed loss share) / β: a site left of the line of its rating loses more than is allowed, by the "
                   "static law of a current-limited converter at full load.")),
        table("Operating hours in which the faults are simulated", ["period", "hour of the year", "load factor", "data-centre factor",
                                                                  "wind (MW)"], period_rows, words=[4]),
    ]
    return section("Grid, faults and operating hours", *parts)


def _map_text(findings: Findings) -> str:
    return (f"Sites at bus {', '.join(map(str, findings.sites))}, wind at bus {', '.join(map(str, findings.wind_buses))}, faults at bus "
            f"{', '.join(str(f.bus) for f in findings.faults)}.")


def facility(findings: Findings) -> Safe:
    """What a facility does on the test waveform, and its supervisor."""
    parts = []
    for mode in findings.modes:
        text = (f"Response of the {mode_name(mode)} facility to the ERCOT-style test waveform: ramp, shallow fault, deep fault and high voltage. "
                "The waveform is our own composition and not ERCOT's official one.")
        parts.append(figure(findings.folder / "figures" / f"internal_response_{mode}.svg", alt=text, caption=text))
    dae = findings.facility(findings.modes[0])
    rows = "; ".join(row.text for automaton in dae.automata for row in automaton.rows)
    parts.append(figure(findings.folder / "figures" / "supervisor.svg", alt=f"Supervisor diagram. Transitions: {rows}.", caption=(
        "Supervisor of the facility, drawn from the transition table that the integrator runs. Values are the defaults.")))
    return section("The facility", *parts)


def simulations(findings: Findings) -> Safe:
    """How much was simulated, what failed and what was set aside."""
    counts = findings.summary["simulations"]
    minutes = findings.summary["wall_s"] / 60.0
    parts = [definitions([
        ("Fault simulations", counts["grid"]), ("Facility runs", counts["facility"]), ("Failed", counts["failed"]),
        ("Tasks set aside", counts["quarantined"]), ("Time spent", f"{minutes:.1f} min"),
        ("Hosting vectors", f"{int((findings.hostings.role == 'sample').sum())} sampled, "
                            f"{int((findings.hostings.role == 'plan').sum())} plans"),
    ])]
    away = findings.tasks[findings.tasks.status.isin(LOST)]
    if len(away):
        parts.append(table("Tasks that were set aside", ["task", "phase", "state", "message"],
                           [[task.hash[:12], task.phase, task.status, task.message] for task in away.itertuples()], words=[1, 2, 3]))
    failed = findings.margins[findings.margins.failed_in.isin(["grid", "facility"])]
    if len(failed):
        grouped = failed.groupby(["failed_in", "status"], sort=True).size().reset_index(name="rows")
        parts.append(table("Failed simulations by reason", ["failed in", "status", "rows"],
                           [[row.failed_in, row.status, str(row.rows)] for row in grouped.itertuples()], words=[1]))
    battery = findings.margins[(findings.margins.ok == 1)]
    if len(battery):
        visited = int((battery.battery == 1).sum())
        parts.append(paragraph(f"In {visited} of {len(battery)} facility runs with a result the supervisor visited BATTERY, where the import "
                               "is zero and the load loss 100 %."))
    return section("Simulations", *parts)


def assumptions(findings: Findings) -> Safe:
    """What the numbers rest on, and which of it is illustrative."""
    study = findings.study
    c, h = study.criteria, study.hosting
    criteria = definitions([
        ("Voltage criterion", f"The protected IT voltage must not stay below {c.v_it_min_pu:g} pu for {c.window_ms:g} ms "
                              f"({c.voltage_criterion}). Illustrative."),
        ("Loss criterion", f"At most {100 * c.loss_share:g} % of the import before the fault may be lost for {c.loss_window_ms:g} ms. "
                           "Illustrative."),
        ("Power factor", f"{h.pf:g} for every data centre. Illustrative."),
        ("Branch ratings", f"{h.rating_scale:g} times those of the case. The factor is illustrative."),
        ("Normal voltages", f"{h.v_min_pu:g} to {h.v_max_pu:g} pu in every hour."),
        *[(f"Hours: {name}", text) for name, text in findings.provenance.get("sources", {}).items()],
        ("Phases", "Positive sequence only. A compliance verdict on the worst phase can differ."),
        ("Waveforms", "The facility is driven by the grid's waveform with its load as the grid model has it; its own reaction does not act "
                      "back on the grid."),
        ("Nature of the result", "Screening. Facility parameters are not those of a product, and most are illustrative (table below)."),
    ])
    differing = _differing(findings)
    parts = [criteria]
    if len(findings.modes) > 1:
        parts.append(table("Parameters that differ between the modes", ["parameter", *[mode_name(m) for m in findings.modes], "why"], differing,
                           words=[1 + len(findings.modes)]) if differing else paragraph("No parameter that the modes share differs between them."))
    changed = sorted({(path, mode_name(mode), value) for mode in findings.modes for path, value in findings.parameters(mode).items()})
    if changed:
        parts.append(table("Parameters that the study file sets", ["parameter", "mode", "value"],
                           [[path, mode, f"{value:g}"] for path, mode, value in changed], words=[1]))
    tables = [table(f"Parameters of the {mode_name(mode)} facility", ["parameter", "value", "unit", "meaning", "source"],
                    [_parameter(row, findings.parameters(mode)) for row in findings.facility(mode).parameters], words=[2, 3, 4])
              for mode in findings.modes]
    counts = [f"{mode_name(mode)}: {sum('illustrative' in row.source for row in rows)} of {len(rows)} parameters are illustrative"
              for mode in findings.modes for rows in [findings.facility(mode).parameters]]
    parts.append(Safe(f"<details><summary>All facility parameters ({escape('; '.join(counts))})</summary>{''.join(tables)}</details>"))
    return section("Assumptions", *parts)


def _parameter(row: ParameterRow, given: dict[str, float]) -> list[object]:
    value, source = (given[row.path], "study file") if row.path in given else (row.value, row.source or "not stated")
    return [row.path, f"{value:g}", row.unit, row.doc, source]


def _differing(findings: Findings) -> list[list[object]]:
    """Parameters that all modes have and that do not have the same value in all."""
    tables = {mode: {row.path: row for row in findings.facility(mode).parameters} for mode in findings.modes}
    shared = [path for path in tables[findings.modes[0]] if all(path in t for t in tables.values())]
    rows: list[list[object]] = []
    for path in shared:
        values = [findings.parameters(mode).get(path, tables[mode][path].value) for mode in findings.modes]
        if len(set(values)) > 1:
            why = "; ".join(dict.fromkeys(f"{mode_name(mode)}: {tables[mode][path].source}" for mode in findings.modes))
            rows.append([path, *[f"{value:g}" for value in values], why])
    return rows


def deviations(findings: Findings) -> Safe:
    """Where the facility differs from the paper, as its blocks say it."""
    notes: dict[str, list[str]] = {}
    for mode in findings.modes:
        for note in findings.facility(mode).notes:
            notes.setdefault(note, []).append(mode_name(mode))
    rows = [[note.partition(": ")[0], note.partition(": ")[2], ", ".join(modes)] for note, modes in notes.items()]
    return section("Where the models differ from the paper", paragraph(
        "The paper leaves equations and all parameter values open. Each block says how it settles its gap."),
        table("Differences by block", ["block", "what differs", "modes"], rows, words=[1, 2]))


def method(findings: Findings) -> Safe:
    """The chain of the study."""
    return section("Method", figure(findings.folder / "figures" / "framework.svg", alt=(
        "Hosting proposals go through fault simulation, POI waveforms and the facility model to margins; margins become tightened affine rows "
        "of the hosting programme; every plan is replayed through the whole chain."), caption=(
            "The chain of a study. Only the replay accepts a plan: the fitted margins are a way to find it.")))


def provenance(findings: Findings) -> Safe:
    """What the study was made from and with."""
    known = findings.provenance
    made_with = ", ".join(f"{name} {version}" for name, version in findings.summary["versions"].items())
    pairs: list[tuple[object, object]] = [
        ("Versions", made_with), ("Platform", known.get("platform", "–")), ("Seed", known.get("seed", "–")),
        ("Facility evaluation", "; ".join(f"{mode_name(m)}: {text}" for m, text in dict(known.get("backends", {})).items()) or "–"),
        ("Files beside this report", "study.toml, study.sqlite (everything), summary.json, table.csv, validation.csv, figures/ (SVG and PNG)"),
        ("Again", "the same 'dcvrt study run' on this folder repeats nothing; 'dcvrt study report' writes tables, figures and report anew"),
    ]
    text = Safe(f"<details><summary>Study file</summary><pre>{escape(known.get('study_text', ''))}</pre></details>")
    return section("Provenance", definitions(pairs), text)
