"""A study whose network and facilities answer in closed form, run by real searches, campaign and store."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from dcvrt.planning import replay
from dcvrt.studies import frontier, plans, simulations
from dcvrt.studies.campaign import Campaign, crew_of
from dcvrt.studies.config import SystemLimitSection
from dcvrt.studies.progress import Silent
from dcvrt.studies.setting import Setting
from dcvrt.studies.store import Store, records
from tests.planning.closed_form import Programme
from tests.studies.synthetic import CORNER, PERIODS, SITES, SLOPE, checked_run, study_file

LOSS_MW, LOSS_SHARE = [0.0, 15.0, 40.0, 500.0], [0.1, 1.0]
WORSE = 0.005
"""How much more of its import a site loses in the replay than in the search."""


class Capped(Programme):
    """Sites of the synthetic study under one limit on their total, as a hosting problem."""

    def __init__(self) -> None:
        super().__init__(len(SITES), 0.8 * sum(CORNER))
        self.sites = SITES
        self.upper = np.array(CORNER)

    def solve(self, rows: Any = (), bounds: Any = None, thorough: bool = True) -> Any:
        bounds = bounds or {bus: (0.0, mw) for bus, mw in zip(SITES, CORNER, strict=True)}
        return super().solve(rows, bounds, thorough)


def answers(file: Any, asked: list[dict[str, Any]], worse: float = WORSE) -> Any:
    """`check_hosting` by the closed form of the synthetic study; the replay finds a little more loss."""

    def check_hosting(request: dict[str, Any]) -> dict[str, Any]:
        asked.append(request)
        H, period = np.array(request["hosting"]), request["period"]["name"]
        buses = [fault["bus"] for fault in request["faults"]]
        rows = []
        for fault in [fault for fault in file.fault if fault.bus in buses]:
            for k, site in enumerate(SITES):
                for mode, beta in request["runs"]:
                    row = checked_run(file, period, fault, site, mode, beta, H)
                    more = 0.0 if request["gradients"] else worse
                    share = row["loss_share"] + more
                    row |= {"loss_share": share, "loss_margin_share": row["loss_margin_share"] - more}
                    row |= {"loss_mw": row["p_mw"] * share, "gradients": {}}
                    if request["gradients"]:
                        row["gradients"] = gradients(k, row, beta, PERIODS[period][2])
                    rows.append(row)
        return {"rows": rows, "waveforms": [], "grid": len(buses), "facility": len(rows)}

    return check_hosting


def gradients(k: int, row: dict[str, Any], beta: float, d: float) -> dict[str, dict[str, float]]:
    """Derivatives of the static law: V falls by SLOPE per MW at the site and a fifth of that elsewhere."""
    v = {f"H_{s}": -SLOPE * d * (1.0 if j == k else 0.2) for j, s in enumerate(SITES)}
    active = float(beta * row["v_poi_min_pu"] < 1.0)
    loss = {name: active * beta * slope for name, slope in v.items()}
    return {
        "voltage": {name: 0.25 * slope for name, slope in loss.items()} | {"beta": 0.0},
        "loss": loss | {"beta": active * row["v_poi_min_pu"]},
        "v_poi": v,
    }


def stand_in(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """Put the closed form in place of simulations and AC power flow; the requests that it gets."""
    requests: list[dict[str, Any]] = []
    monkeypatch.setattr(replay, "check_hosting", answers(study_file("limits"), requests))
    monkeypatch.setattr(plans, "power_flow", lambda problem, plan: {"ac_passed": 1, "ac_status": "made up"})
    return requests


def setting(**changes: Any) -> Setting:
    file = study_file("limits")
    limits = SystemLimitSection(
        **{"loss_mw": LOSS_MW, "loss_share": LOSS_SHARE, "beta": [1.15, 1.35]} | changes
    )
    periods = {
        name: {"name": name, "hour": hour, "load_scale": load, "dc_factor": d, "wind": {}}
        for name, (hour, load, d, _) in PERIODS.items()
    }
    problem = Capped()
    no_vrt = SimpleNamespace(by_site=dict(zip(SITES, CORNER, strict=True)), total_mw=sum(CORNER))
    file = file.model_copy(update={"system_limit": limits})
    made = Setting(file, Path(), problem, periods)  # type: ignore[arg-type]
    made.__dict__["no_vrt"] = no_vrt  # as if it had been solved
    return made


def run(folder: Path, study: Setting) -> list[dict[str, Any]]:
    """Search and replay; the plans under limits."""
    folder.mkdir(exist_ok=True)
    with Store(folder / "study.sqlite", write=True) as store, crew_of(1) as crew:
        campaign = Campaign(store, crew)
        assert frontier.run_frontier(campaign, study, Silent()) == []
        assert simulations.run_replays(campaign, study) == []
        return records(store.system_plans())
