"""How the answer changes with the facilities in the network during the fault."""

from __future__ import annotations

from typing import TYPE_CHECKING

from dcvrt.studies.findings import Findings
from dcvrt.studies.report.caveats import name_of
from dcvrt.studies.report.page import Safe, badge, number, paragraph, section, table
from dcvrt.studies.rows import Row, verdict

if TYPE_CHECKING:
    import pandas as pd

TITLE, ANCHOR = "Facilities in the network", "coupling"
SHOWN = 12
"""Runs of a plan that the page shows; all of them stand in coupling.csv."""


def coupling(findings: Findings) -> Safe:
    """Margins in closed loop beside those of the open loop, for the plans that were simulated in both."""
    compared = [(row, frame) for row in findings.rows() if len(frame := of_plan(findings, row))]
    if not compared:
        if findings.study.grid.engine == "andes":
            why = "ANDES, which simulates the faults of this study, has no model of a facility"
        elif findings.best() is None:
            why = "no plan passed"
        else:
            why = "the store holds no comparison"
        return section(TITLE, paragraph(f"Closed and open loop were not compared: {why}."), name=ANCHOR)
    if findings.study.grid.coupling == "closed":
        asked = (
            "As the study asks, samples and searches are in closed loop too. A plan has passed only if it "
            "rides through there and in its replay, which takes hosted load as an impedance in the fault "
            "(open loop)."
        )
    else:
        asked = (
            "Samples, searches and replays take hosted load as an impedance in the fault (open loop). Every "
            "plan is compared; its verdict elsewhere in this report stays that of the open "
            'loop. coupling = "closed" in [grid] searches for plans that ride through in closed loop.'
        )
    largest = [findings.best(mode) for mode in findings.modes]
    return section(
        TITLE,
        paragraph(
            "In closed loop the facilities are ports of the network, with their control, limits and "
            f"supervisor, so that they act on the voltage that they see. {asked} Both loops here are by the "
            "native engine; differences are closed less open, and a negative one means less margin."
        ),
        table(
            "Largest differences of each plan, over all faults, periods and sites",
            ["plan", "MW", "lowest POI voltage (pu)", "voltage margin (pu)", "loss margin (share of load)",
             "runs", "other event sequence", "without result", "open loop", "closed loop"],
            [_summary(row, frame) for row, frame in compared],
            words=[8, 9],
        ),
        *[_runs(row, frame) for row, frame in compared if row in largest],
    )  # fmt: skip


def of_plan(findings: Findings, row: Row) -> pd.DataFrame:
    """Compared runs of a plan; none where it was not compared."""
    frame, plan = findings.coupling, findings.plan(row)
    return frame[
        (frame.hosting == plan["hosting"]) & (frame["mode"] == plan["mode"]) & (frame.beta == plan["beta"])
    ]


def turned(findings: Findings) -> list[str]:
    """A sentence for every plan that passed its replay and does not ride through in closed loop."""
    said = []
    for row in findings.rows():
        frame = of_plan(findings, row)
        bad = frame[frame.passed_closed != 1]
        if len(bad) and (frame.passed_open == 1).all():
            first = bad.iloc[0]
            said.append(
                f"{name_of(row)}: {len(bad)} of {len(frame)} runs, the first at bus {first.site}, fault "
                f"{first.fault}, {first.period}: {first.status or 'a margin is negative'}"
            )
    return said


def _difference(frame: pd.DataFrame, name: str) -> pd.Series[float]:
    difference: pd.Series[float] = frame[f"{name}_closed"] - frame[f"{name}_open"]
    return difference


def _largest(frame: pd.DataFrame, name: str, digits: int) -> str:
    """The difference of largest size, signed."""
    moved = _difference(frame, name).dropna()
    return "–" if moved.empty else number(float(moved.iloc[int(moved.abs().to_numpy().argmax())]), digits)


def _summary(row: Row, frame: pd.DataFrame) -> list[object]:
    both = frame[frame.status == ""]
    rides = "passed" if (frame.passed_closed == 1).all() else "failed"
    return [
        name_of(row),
        number(row["total_mw"], 1),
        _largest(frame, "v_poi_min", 4),
        _largest(frame, "voltage", 4),
        _largest(frame, "loss", 4),
        str(len(frame)),
        str(int((both.same_sequence == 0).sum())),
        str(int((frame.status != "").sum())),
        badge("passed" if (frame.passed_open == 1).all() else "failed"),
        badge(rides),
    ]


def _runs(row: Row, frame: pd.DataFrame) -> Safe:
    """The runs of one plan whose margins move most."""
    size = _difference(frame, "voltage").abs().fillna(1.0) + _difference(frame, "loss").abs().fillna(1.0)
    most = frame.loc[size.sort_values(ascending=False, kind="stable").index[:SHOWN]]
    return table(
        f"{name_of(row)}, {row['total_mw']:.1f} MW, {verdict(row)}: the {len(most)} of {len(frame)} runs "
        "whose margins move most (coupling.csv has all)",
        ["fault", "period", "bus", "lowest voltage, open (pu)", "closed", "voltage margin, open (pu)",
         "closed", "loss margin, open (share)", "closed", "same sequence", "status"],
        [
            [
                run["fault"],
                run["period"],
                str(run["site"]),
                *[
                    number(run[f"{name}_{loop}"], 4)
                    for name in ("v_poi_min", "voltage", "loss")
                    for loop in ("open", "closed")
                ],
                "yes" if run["same_sequence"] else "no",
                run["status"] or "–",
            ]
            for run in most.to_dict("records")
        ],
        words=[1, 9, 10],
    )  # fmt: skip
