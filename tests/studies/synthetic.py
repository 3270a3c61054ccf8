"""A study folder with made-up grid and facility answers, written through the real store, fits and tables.

The retained voltage is affine in the hosted capacities and the loss follows the static law
loss = 1 - min(1, beta V): physically consistent, known in closed form, and made in a second.
"""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from dcvrt.planning import replay
from dcvrt.planning.sampling import sample_hosting
from dcvrt.planning.verdict import verdict
from dcvrt.studies import fits, outputs, plans, simulations
from dcvrt.studies.config import StudyFile, load
from dcvrt.studies.setting import criteria
from dcvrt.studies.store import Store, records

SITES = (21, 75, 106, 108)
CORNER = (31.4, 153.9, 102.4, 104.1)
PERIODS = {"peak": (8730, 1.0, 1.00, 40.0), "light": (1234, 0.45, 0.90, 260.0)}
LEAST = {
    32: (0.690, 0.93, 0.95, 0.96),
    65: (0.90, 0.730, 0.92, 0.93),
    94: (0.95, 0.90, 0.760, 0.80),
    111: (0.96, 0.94, 0.88, 0.670),
}
"""Retained voltage by fault at each site with nothing hosted, pu."""
SLOPE = 1.5e-4
"""Fall of the retained voltage per MW at the site itself, pu; a fifth of it per MW elsewhere."""


STUDY = """
[study]
name = "A study of four sites"
[grid]
case = "ieee118"
sites = [21, 75, 106, 108]
[facility]
beta = [1.0, 1.15, 1.35, 1.5]
[criteria]
loss_share = 0.10
[sampling]
n = 16
"""


def study_file(name: str) -> StudyFile:
    """Return a study with the faults and periods above."""
    text = STUDY + "".join(f"[[fault]]\nbus = {bus}\n" for bus in LEAST)
    text += "".join(f'[[period]]\nname = "{key}"\nhour = {hour}\n' for key, (hour, *_) in PERIODS.items())
    file = load(text, "synthetic")
    return file.model_copy(update={"study": file.study.model_copy(update={"name": name})})


def retained(fault: int, site: int, H: np.ndarray, d: float) -> float:
    """Voltage that a fault leaves at a site."""
    k = SITES.index(site)
    own = np.where(np.arange(len(SITES)) == k, 1.0, 0.2)
    return LEAST[fault][k] - SLOPE * d * float(own @ H)


def checked_run(
    file: StudyFile, period: str, fault: Any, site: int, mode: str, beta: float, H: np.ndarray
) -> dict[str, Any]:
    """One row of margins by the static loss law."""
    d, h = PERIODS[period][2], float(H[SITES.index(site)])
    v = retained(fault.bus, site, H, d)
    share = 1.0 - min(1.0, beta * v)
    limit = file.criteria.loss_share
    helps = {"gfl": 0.0, "gfm": 0.03}[mode]
    return {
        "period": period,
        "fault": f"bus {fault.bus}, {fault.t_clear_ms:g} ms",
        "site": site,
        "mode": mode,
        "beta": beta,
        "h_mw": h,
        "p_mw": d * h,
        "v_margin_pu": 0.08 + helps - 0.25 * max(0.0, 1.0 - beta * v),
        "loss_margin_share": limit - share,
        "loss_margin_mw": d * h * (limit - share),
        "loss_share": share,
        "loss_mw": d * h * share,
        "v_poi_min_pu": v,
        "status": "completed",
        "ok": 1,
        "failed_in": "",
        "sequence": "NORMAL>MIXED>NORMAL",
        "battery": 0,
        "diagnostics": {},
    }


def make(
    folder: Path,
    *,
    failing: bool = True,
    lost: bool = False,
    nothing: bool = False,
    name: str = "A study of four sites",
) -> Path:
    """Write a finished study folder.

    Parameters
    ----------
    failing : the replay finds one per cent less voltage than the samples, so that some plans fail it.
    lost : one sampled task was set aside.
    nothing : every facility run failed.
    """
    file = study_file(name)
    folder.mkdir(parents=True, exist_ok=True)
    samples = sample_hosting(
        CORNER,
        file.sampling.n,
        1,
        high_share=0.5,
        high_from=0.6,
        validation_share=file.sampling.validation_share,
    )
    periods = {
        key: {
            "name": key,
            "hour": hour,
            "load_scale": load_scale,
            "dc_factor": d,
            "wind": {"69": wind, "80": wind, "89": wind},
        }
        for key, (hour, load_scale, d, wind) in PERIODS.items()
    }
    setting = SimpleNamespace(file=file, sites=SITES, d={key: p["dc_factor"] for key, p in periods.items()})
    (folder / "study.toml").write_text(STUDY, encoding="utf-8")
    with Store(folder / "study.sqlite", write=True) as store:
        _note(store, file, periods)
        for k, H in enumerate(samples.hosting):
            key = f"s{k:04}"
            store.put(
                "hostings",
                [
                    simulations.hosting_row(
                        key,
                        "sample",
                        "fit" if samples.fit[k] else "validation",
                        dict(zip(SITES, H, strict=True)),
                    )
                ],
            )
            rows = [_failed(row) for row in _rows(file, H)] if nothing else _rows(file, H)
            store.put("margins", [{"hosting": key, **row} for row in rows])
        if lost:
            _lose(store, file)
        fits.run_fits(store, setting)  # type: ignore[arg-type]
        _plans(store, file, failing)
        _sensitivities(store, file)
        outputs.write_results(folder, store)
    return folder


def _rows(file: StudyFile, H: np.ndarray, scale: float = 1.0) -> list[dict[str, Any]]:
    rows = [
        checked_run(file, period.name, fault, site, mode, beta, H)
        for period in file.period
        for fault in file.fault
        for site in SITES
        for mode in file.facility.modes
        for beta in file.facility.beta
    ]
    return [_weakened(row, file, scale) for row in rows] if scale != 1.0 else rows


def _failed(row: dict[str, Any]) -> dict[str, Any]:
    mode, H = row["mode"], row["h_mw"]
    where = (row["period"], row["fault"], row["site"], mode, row["beta"])
    status = f"{mode}: no equilibrium at the first value of the waveform. Largest residuals:\n  dc.w = 1"
    return replay._row(*where, H, status, "start")


def _weakened(row: dict[str, Any], file: StudyFile, scale: float) -> dict[str, Any]:
    v = scale * row["v_poi_min_pu"]
    share = 1.0 - min(1.0, row["beta"] * v)
    margin = file.criteria.loss_share - share
    return row | {
        "v_poi_min_pu": v,
        "loss_share": share,
        "loss_margin_share": margin,
        "loss_mw": row["p_mw"] * share,
        "loss_margin_mw": row["p_mw"] * margin,
    }


def _note(store: Store, file: StudyFile, periods: dict[str, Any]) -> None:
    store.note(
        study=file.canonical(),
        study_name=file.study.name,
        study_text=STUDY,
        quick=True,
        versions={"dcvrt": "0.1.0", "python": "3.11"},
        platform="test",
        engine="andes",
        seed=1,
        periods=periods,
        criteria=criteria(file),
        sites=list(SITES),
        sources={"load": "made up", "wind": "made up"},
        network="ieee118",
        faults=[f.model_dump() for f in file.fault],
        backends={"gfl": "made up"},
        wall_s=12.0,
    )


def _lose(store: Store, file: StudyFile) -> None:
    store.add_tasks([("feed", "samples", '{"case":"ieee118","dynamics":null}')])
    store.set_task("feed", "timeout", "took longer than 600 s", 600.0)
    request = {
        "faults": [f.model_dump() for f in file.fault],
        "sites": SITES,
        "hosting": CORNER,
        "runs": [[m, b] for m in file.facility.modes for b in file.facility.beta],
        "period": {"name": file.period[0].name},
    }
    store.put(
        "margins",
        [{"hosting": "s0000", **row} for row in replay.lost_rows(request, "timeout: 600 s", "task")],
    )


def _plans(store: Store, file: StudyFile, failing: bool) -> None:
    """Open the sites whose fitted margins pass at the corner of the box; replay them."""
    fits = store.surrogates().to_dict("records")
    everything = dict(zip(SITES, CORNER, strict=True))
    plans = [_plan("none", "", 0.0, everything, {})]
    for method in file.surrogate.methods:
        for mode in file.facility.modes:
            for beta in file.facility.beta:
                shut = {}
                for fit in fits:
                    if (fit["method"], fit["mode"]) == (method, mode) and fit["beta"] in (0.0, beta):
                        margin = fit["intercept"] + sum(
                            fit["slopes"][str(s)] * H for s, H in everything.items()
                        )
                        if margin + fit["rating_slope"] * beta * everything[fit["site"]] < 0:
                            shut[fit["site"]] = f"{fit['target']} at bus {fit['site']}, fault {fit['fault']}"
                plans.append(
                    _plan(
                        method, mode, beta, {s: 0.0 if s in shut else H for s, H in everything.items()}, shut
                    )
                )
    for plan in plans:
        by_site = {int(b): mw for b, mw in plan["by_site"].items()}
        store.put("hostings", [simulations.hosting_row(plan["hosting"], "plan", "", by_site)])
        if plan["method"] == "none":
            store.put("plans", [plan])
            continue
        H = np.array([by_site[s] for s in SITES])
        rows = [
            row
            for row in _rows(file, H, 0.96 if failing else 1.0)
            if (row["mode"], row["beta"]) == (plan["mode"], plan["beta"])
        ]
        expected = int((H > 0).sum()) * len(file.period) * len(file.fault)
        if H.any():  # a plan of nothing is not replayed
            store.put("margins", [{"hosting": plan["hosting"], **row} for row in rows])
        store.put("plans", [plan | verdict(rows, by_site, expected) | {"replayed": 1}])
        _waveforms(store, file, plan, rows)


def _sensitivities(store: Store, file: StudyFile) -> None:
    """One plan that a margin holds, with made-up effects, and one that the network alone holds."""
    plans = {}
    for mode in file.facility.modes:
        hosting = [p for p in records(store.plans()) if p["mode"] == mode and p["total_mw"] > 0]
        if not hosting:
            continue
        plan = hosting[0]
        margin = {"period": "peak", "fault": "bus 111, 100 ms", "site": 108, "target": "loss"}
        held = mode == "gfm"
        plans[mode] = {
            "beta": plan["beta"],
            "hosting": plan["hosting"],
            "total_mw": plan["total_mw"],
            "by_site": plan["by_site"],
            "binding": [margin | {"label": "loss", "price": 1200.0, "by_beta": 700.0}] if held else [],
            "by_sequence": [],
            "limits": ["line 80-99"],
            "closed": {},
            "near": [],
            "rerun_mw": plan["total_mw"] + 0.2 if held else None,
        }
        share = {"path": "criteria.loss_share", "doc": "largest loss of import", "value": 0.10}
        gain = {"path": "dc_loop.K_p", "doc": "proportional gain over H", "value": 1.0}
        deep = {"path": "sup.V_deep", "doc": "deep dip below", "value": 0.5}
        common = {"mode": mode, "unit": "1", "source": "illustrative"}
        rows = [
            share
            | {"by_unit": 1200.0, "sides": {"low": _end(0.08, -24.0, -24.5), "high": _end(0.12, 24.0, 11.0)}},
            deep | {"by_unit": 0.0, "sides": {"low": _end(0.4, 0.0), "high": _end(0.6, 0.0, unseen=True)}},
            gain | {"by_unit": -3.0, "sides": {"low": _end(0.8, 0.6), "high": _end(1.2, refused="no <gap>")}},
            {"path": "sup.T_dip", "doc": "shallow dip tolerated", "value": 0.25, "by_unit": 0.0}
            | {"sides": {"low": _end(0.2, 0.0), "high": _end(0.3, 0.0)}},
        ]
        for number, row in enumerate(rows, start=1):
            sides = row["sides"] if held else {side: _end(end["value"]) for side, end in row["sides"].items()}
            by_unit = row["by_unit"] if held else None
            for end in sides.values():
                if end["rerun_mw"] is not None:  # changes are given; the store holds totals
                    end["rerun_mw"] += plans[mode]["rerun_mw"]
            stake = max(end["stake_mw"] for end in sides.values())
            store.put(
                "sensitivities",
                [common | row | {"sides": sides, "by_unit": by_unit, "number": number, "stake_mw": stake}],
            )
    store.note(sensitivity_plans=plans, sensitivity_runs={"grid": 12, "facility": 345})


def _end(
    value: float, mw: float | None = None, again: float | None = None, unseen: bool = False, refused: str = ""
) -> dict[str, Any]:
    """One end of a range; `again`: the change that a search has found."""
    return {
        "value": value,
        "linear_mw": mw,
        "gradient_mw": mw,
        "refused": refused,
        "unseen": {"106": "fault bus 94, 100 ms, peak: the <link> collapsed"} if unseen else {},
        "stake_mw": 50.0 if unseen else abs(mw or 0.0),
        "rerun_mw": again,
        "rerun_by_site": {},
        "rerun_settled": None if again is None else True,
    }


def _plan(
    method: str, mode: str, beta: float, by_site: dict[int, float], shut: dict[int, str]
) -> dict[str, Any]:
    H = {str(s): mw for s, mw in by_site.items()}
    binding = [
        {
            "kind": "line",
            "label": "80-99",
            "price": 0.52,
            "unit": "MW/MVA",
            "limit": 90.0,
            "hour": 17,
            "bus": None,
        }
    ]
    return {
        "method": method,
        "mode": mode,
        "beta": beta,
        "hosting": plans.plan_name(H),
        "total_mw": sum(H.values()),
        "by_site": H,
        "binding": binding,
        "closed": {str(s): why for s, why in shut.items()},
        "carried_from": None,
        "ac_passed": 1,
        "ac_v_min_pu": 0.9412,
        "ac_v_error_pu": 4e-5,
        "ac_status": "solved in every hour",
    }


def _waveforms(store: Store, file: StudyFile, plan: dict[str, Any], rows: list[dict[str, Any]]) -> None:
    t = np.linspace(0.0, file.grid.t_end_s, 401)
    inside = [row for row in rows if row["h_mw"] > 0]
    if not inside:
        return
    worst = min(inside, key=lambda row: min(row["v_margin_pu"], row["loss_margin_share"]))
    start = file.fault[0].t_start_s
    dip = (t >= start) & (t < start + 0.1)
    for row in rows:
        if (row["period"], row["fault"]) == (worst["period"], worst["fault"]):
            v = np.where(dip, row["v_poi_min_pu"], 1.0 - 0.05 * np.exp(-(t - start) / 0.3) * (t >= start))
            store.put_waveform(
                {"t_s": t, "v_re_pu": v, "v_im_pu": 0 * t},
                hosting=plan["hosting"],
                period=row["period"],
                fault=row["fault"],
                site=row["site"],
            )
