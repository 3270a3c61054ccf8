"""Network, faults and operating hours of the study."""

from __future__ import annotations

from dcvrt.planning.replay import fault_label
from dcvrt.studies.figures.faults import retained
from dcvrt.studies.findings import Findings
from dcvrt.studies.report.page import Safe, figure, number, paragraph, section, table


def grid(findings: Findings) -> Safe:
    """Network, sites, faults with what they do to each site, and the hours that they are simulated in."""
    table_of = retained(findings.margins)
    lowest: dict[tuple[str, int], tuple[float, float]] = {
        (str(row["fault"]), int(row["site"])): (float(row["min"]), float(row["max"]))
        for row in table_of.to_dict("records")
    }
    hardest = {}
    for site in findings.sites:
        ranked = sorted((low, fault) for (fault, bus), (low, _) in lowest.items() if bus == site)
        hardest[site] = ranked[0][1] if ranked else ""
    fault_rows = []
    for fault in findings.faults:
        name = fault_label(fault.model_dump())
        cells = [
            "–" if (name, s) not in lowest else f"{lowest[name, s][0]:.3f} to {lowest[name, s][1]:.3f}"
            for s in findings.sites
        ]
        why = [str(site) for site in findings.sites if hardest[site] == name]
        fault_rows.append(
            [
                f"bus {fault.bus}" + (f", opens {fault.opens[0]}-{fault.opens[1]}" if fault.opens else ""),
                f"{fault.t_clear_ms:g}",
                f"{fault.x_pu:g}",
                *cells,
                f"lowest voltage of all at bus {', '.join(why)}" if why else "–",
            ]
        )
    period_rows = [
        [
            name,
            str(p["hour"]),
            number(p["load_scale"], 3),
            number(p["dc_factor"], 3),
            ", ".join(f"bus {bus}: {mw:.0f}" for bus, mw in p["wind"].items()) or "none",
        ]
        for name, p in findings.periods.items()
    ]
    study = findings.study
    parts = [
        paragraph(
            f"Network: {study.grid.case}. Candidate sites: bus "
            f"{', '.join(map(str, findings.sites))}. Faults are three-phase, at buses without a data "
            "centre, and clear by themselves or with the branch that opens. Samples and searches are "
            f"simulated by {_engine(study.grid.engine)}, the replays of plans by "
            f"{_engine(study.replay.engine)}."
        )
    ]
    picture = findings.folder / "figures" / "network_map.svg"
    if picture.is_file():
        parts.append(
            figure(
                picture,
                alt="One-line map of the network. " + _map_text(findings),
                caption=(
                    "The network. The layout follows the lines, not geography. The area of a site's "
                    "square grows with its capacity in the plan without ride-through."
                ),
            )
        )
    else:
        parts.append(paragraph(f"The map of the network is not drawn: {findings.map_problem}"))
    parts += [
        table(
            "Faults, and the lowest voltage that they leave at each site (pu, over all hosting vectors "
            "and periods)",
            [
                "fault",
                "cleared after (ms)",
                "reactance (pu)",
                *[f"bus {site}" for site in findings.sites],
                "limits",
            ],
            fault_rows,
            words=[3 + len(findings.sites)],
        ),
        figure(
            findings.folder / "figures" / "retained_voltage.svg",
            alt="Lowest voltage during each fault at each site; the numbers stand in the table above.",
            caption=(
                "Lowest POI voltage by fault and site: the marker is the middle, the bar the range over "
                "hosting vectors and periods. The dashed lines are (1 − allowed loss share) / β: a site "
                "left of the line of its rating loses more than is allowed, by the static law of a "
                "current-limited converter at full load."
            ),
        ),
        table(
            "Operating hours in which the faults are simulated",
            ["period", "hour of the year", "load factor", "data-centre factor", "wind (MW)"],
            period_rows,
            words=[4],
        ),
    ]
    return section("Grid, faults and operating hours", *parts)


def _map_text(findings: Findings) -> str:
    return (
        f"Sites at bus {', '.join(map(str, findings.sites))}, wind at bus "
        f"{', '.join(map(str, findings.wind_buses))}, faults at bus "
        f"{', '.join(str(f.bus) for f in findings.faults)}."
    )


def _engine(name: str) -> str:
    return "ANDES" if name == "andes" else "the native engine"
