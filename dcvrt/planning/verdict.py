"""Whether a replayed plan passes: every site by its own criteria, or all together within a limit."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dcvrt.planning.exact import Exact
from dcvrt.planning.requirement import SystemLimit, lost_whole

ALL = 1.0 - 1e-6
"""Lost share from which on nothing is left."""


def verdict(rows: Sequence[Mapping[str, Any]], by_site: Mapping[int, float], expected: int) -> dict[str, Any]:
    """Whether a plan rides through: the worst margins over all faults, periods and open sites.

    Parameters
    ----------
    rows : checked runs of the plan at its mode and rating, all sites.
    by_site : capacities; a site with 0 MW has no facility that could fail.
    expected : number of runs that the check consists of (faults x periods x open sites).

    Returns
    -------
    dict
        `passed`; `worst_voltage_margin_pu`, `worst_loss_margin_mw` (None when nothing is hosted or nothing
        ran); `aggregate_loss_mw`: largest sum of the sites' losses in one fault and period; `worst`: where
        each of these occurs; `n_failed`: runs that failed or are missing. With any of these the plan has not
        passed.
    """
    here = [r for r in rows if by_site[r["site"]] > 0]
    good = [r for r in here if r["ok"]]
    n_failed = expected - len(good)
    answer: dict[str, Any] = {
        "passed": n_failed == 0,
        "worst_voltage_margin_pu": None,
        "worst_loss_margin_mw": None,
        "aggregate_loss_mw": 0.0 if expected == 0 else None,
        "worst": {},
        "n_failed": n_failed,
    }
    if not good:
        return answer
    voltage = min(good, key=lambda r: r["v_margin_pu"])
    loss = min(good, key=lambda r: r["loss_margin_mw"])
    aggregate: dict[tuple[str, str], float] = {}
    for r in good:
        aggregate[r["period"], r["fault"]] = aggregate.get((r["period"], r["fault"]), 0.0) + r["loss_mw"]
    at = max(aggregate, key=lambda key: aggregate[key])
    where = ("site", "fault", "period", "sequence")
    return answer | {
        "passed": bool(n_failed == 0 and voltage["v_margin_pu"] >= 0.0 and loss["loss_margin_mw"] >= 0.0),
        "worst_voltage_margin_pu": voltage["v_margin_pu"],
        "worst_loss_margin_mw": loss["loss_margin_mw"],
        "aggregate_loss_mw": aggregate[at],
        "worst": {
            "voltage": {key: voltage[key] for key in where},
            "loss": {key: loss[key] for key in where},
            "aggregate": {"period": at[0], "fault": at[1]},
        },
    }


def limit_verdict(replayed: Sequence[Exact], limit: SystemLimit, expected: int) -> dict[str, Any]:
    """Whether the load that drops off at once stays within a limit, under every fault in every period.

    Parameters
    ----------
    replayed : what the replay found at the hosting vector of a plan, at its mode and rating.
    limit : what has to be met.
    expected : number of faults times periods.

    Returns
    -------
    dict
        `passed`; `aggregate_loss_mw`: the largest loss of all sites together, None when none is known;
        `losses`: one by one, period, fault, loss_mw, limit_mw and `whole`, the open sites that lose all of
        their load; `n_failed`: faults and periods in which an open site has no result, or that are missing.
        With any of these the plan has not passed.
    """
    losses: list[dict[str, Any]] = []
    passed = True
    for one in replayed:
        margins = limit.margins(one)
        passed &= not margins.missed()
        left = float(margins.value[0])
        if not math.isfinite(left):
            continue
        allowed = limit.mw + limit.share * float(margins.size[0])
        whole = (one.H > 0) & (lost_whole(one) | (one.loss >= ALL))
        buses = [limit.sites[k] for k in np.flatnonzero(whole)]
        place = dict(zip(("period", "fault"), one.place, strict=True))
        losses.append(place | {"loss_mw": allowed - left, "limit_mw": allowed, "whole": buses})
    n_failed = expected - len(losses)
    return {
        "passed": passed and n_failed == 0,
        "aggregate_loss_mw": max((e["loss_mw"] for e in losses), default=None) if expected else 0.0,
        "losses": losses,
        "n_failed": n_failed,
    }
