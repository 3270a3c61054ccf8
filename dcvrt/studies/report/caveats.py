"""What the numbers leave out or hold by construction, counted on the rows of the study."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from dcvrt.criteria import LIMITED_BEFORE_FAULT
from dcvrt.planning.reactive import ReactiveExcess
from dcvrt.studies.findings import Findings
from dcvrt.studies.rows import Row, binding, by_site, carried
from dcvrt.studies.setting import NO_VRT, REACTIVE
from dcvrt.studies.style import mode_name

if TYPE_CHECKING:
    import pandas as pd


def name_of(row: Row) -> str:
    """Mode, rating and method of a row in words."""
    return f"{mode_name(row['mode'])}, β = {row['beta']:g}, method {row['method']}"


# -- reactive limits -----------------------------------------------------------------------------------------


def reactive_excess(plan: Row, where: str = "plan") -> ReactiveExcess | None:
    """Units beyond their reactive limits at a plan of the store, or with nothing hosted (`where` 'unhosted').

    None when the store does not say, as the power flow failed or the study was made before it was recorded.
    """
    found = plan["worst"].get(REACTIVE, {}).get(where)
    return None if found is None else ReactiveExcess.of(found)


def no_vrt(findings: Findings) -> Row:
    """The plan without ride-through, as the store has it."""
    plans = findings.plans
    return dict(plans[plans.method == NO_VRT].iloc[0])


def reactive_limits(findings: Findings) -> list[str]:
    """How far units are beyond their reactive limits at the largest plan, and with nothing hosted.

    Empty when none is, or when the store does not say.
    """
    best = findings.best()
    if best is None:
        plan, name = no_vrt(findings), "the plan without ride-through"
    else:
        plan, name = findings.plan(best), f"the largest plan ({name_of(best)})"
    hosted, unhosted = reactive_excess(plan), reactive_excess(plan, "unhosted")
    if hosted is None or unhosted is None or not (hosted or unhosted):
        return []
    return [
        f"Units beyond their limits at {name}, in the worst hours: {hosted}.",
        f"The same with nothing hosted: {unhosted}. The difference is due to the hosted load.",
        "A passed AC power flow is a verdict on voltages that rest on this reactive power; with the limits "
        "enforced (hosting.reactive_limits), buses would leave their set points and the capacities would "
        "change.",
    ]


# -- the sampled box -----------------------------------------------------------------------------------------


def lower_bounds(findings: Findings) -> list[str]:
    """A sentence for each mode, method and site whose capacity is capped by the sampled region.

    A plan that reaches the capacity without ride-through is not one of them: no plan hosts more.
    """
    found: dict[tuple[str, str, int], list[Row]] = {}
    for row in findings.rows():
        if row["total_mw"] < findings.no_vrt_mw - findings.tolerance_mw:
            for entry in binding(row):
                if entry["label"].startswith("sampled box"):
                    found.setdefault((row["mode"], row["method"], entry["bus"]), []).append(row)
    return [
        f"{mode_name(mode)}, method {method}, β = {_ratings(rows)}: bus {bus} stands at {_sizes(rows, bus)} "
        "MW, the edge of the sampled region."
        for (mode, method, bus), rows in found.items()
    ]


def _ratings(rows: list[Row]) -> str:
    return ", ".join(f"{row['beta']:g}" for row in rows)


def _sizes(rows: list[Row], bus: int) -> str:
    return " or ".join(dict.fromkeys(f"{by_site(row, [bus])[0]:.1f}" for row in rows))


LOWER_BOUNDS = (
    "Plans stay inside the region that was sampled. Where its edge binds, the capacity is a lower bound: how "
    "much more would ride through, up to the capacity without ride-through, is not known. A "
    "larger sampling.h_max_mw in the study file tells."
)


# -- capacity over the rating --------------------------------------------------------------------------------


def why_it_never_falls(findings: Findings) -> str:
    """How much of 'capacity never falls as the rating rises' is a result, and how much construction."""
    rows = findings.rows()
    count = sum(bool(carried(row)) for row in rows)
    text = f"{count} of {len(rows)} plans were carried over from a smaller rating"
    if "paper" in findings.methods:
        text += "; the paper fit cannot fall by construction"
    return text


# -- the converter before the fault --------------------------------------------------------------------------


def limited_before_fault(findings: Findings) -> list[str]:
    """Whether any plan has facilities whose current limiter is active before the fault, and which.

    The first sentence says how it is, the others name the plans.
    """
    loading = [(row, run) for row in findings.rows() for run in _most_loaded(findings, row)]
    if not loading:
        return ["The store does not say how the converters of the plans are loaded before the fault."]
    limited = [(row, run) for row, run in loading if run.preload >= LIMITED_BEFORE_FAULT]
    if not limited:
        row, run = max(loading, key=lambda pair: pair[1].preload)
        return [
            "In no plan is the current limiter of a converter active before the fault. The largest loading "
            f"then is {run.preload:.3f} of the current limit, at bus {run.site} ({name_of(row)})."
        ]
    return [
        f"In {len(limited)} of {len(loading)} plans the current limiter of a converter is already active "
        "before the fault. Such a facility draws less reactive power than the grid model assumes.",
        *[f"{name_of(row)}: at bus {run.site}, period {run.period}" for row, run in limited],
    ]


def _most_loaded(findings: Findings, row: Row) -> Iterator[pd.Series]:
    """The replayed run of a plan with the largest loading before the fault, if one is recorded."""
    if not row["total_mw"] > 0:
        return
    runs = findings.margins
    runs = runs[
        (runs.hosting == findings.plan(row)["hosting"])
        & (runs["mode"] == row["mode"])
        & (runs.beta == row["beta"])
        & (runs.ok == 1)
        & (runs.h_mw > 0)
    ]
    preload = [found.get("preload", float("nan")) for found in runs.diagnostics]
    runs = runs.assign(preload=preload).dropna(subset=["preload"])
    if len(runs):
        yield runs.loc[runs.preload.idxmax()]
