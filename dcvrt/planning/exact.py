"""Exact margins with their total gradients: what simulated faults say about a facility mode at a rating.

What a plan has to meet, the margins of every site or the loss of all of them together, is made from these in
`dcvrt.planning.requirement`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Run = tuple[str, float]
"""Facility mode and rating ratio."""
Place = tuple[str, str]
"""Period and fault."""
TARGETS = ("voltage", "loss")
COLUMNS = ("v_margin_pu", "loss_margin_share")


@dataclass(frozen=True, eq=False)
class Exact:
    """Margins at all sites under one fault, in one period, at one hosting vector, for one mode and rating.

    Attributes
    ----------
    H : array (sites,)
        Hosted capacities, MW.
    place : (str, str)
        Period and fault.
    value : array (sites, 2)
        Voltage margin, pu, and loss margin, share of the import before the fault; NaN for a run that failed.
    slope : array (sites, 2, sites)
        Total derivative of each margin by every H_j, per MW; NaN where it was not asked for.
    by_beta : array (sites, 2)
        Derivative by the rating ratio.
    loss : array (sites,)
        Lost share of the import before the fault; 1 for a run that failed on its way, NaN where there is no
        load that could be lost: no waveform, or a facility without an equilibrium before the fault.
    v_slope : array (sites, sites)
        Derivative of the lowest POI voltage, pu per MW.
    sequence : tuple of str
        Modes that the supervisor passed through at each site: margins of different sequences do not lie on
        one smooth surface.
    status : tuple of str
        How each run ended.
    """

    H: Floats
    place: Place
    value: Floats
    slope: Floats
    by_beta: Floats
    loss: Floats
    v_slope: Floats
    sequence: tuple[str, ...]
    status: tuple[str, ...]


def exact_of(
    rows: Iterable[Mapping[str, Any]], sites: Sequence[int], hosting: Sequence[float]
) -> dict[Run, list[Exact]]:
    """Group the rows of `dcvrt.planning.replay.check_hosting` at one hosting vector.

    Parameters
    ----------
    rows : checked runs, every site of each fault among them.
    sites : candidate buses.
    hosting : capacities in their order, MW.

    Returns
    -------
    dict of (mode, beta) to list of Exact
        In the order in which the rows first name them.
    """
    n = len(sites)
    place_of = {bus: k for k, bus in enumerate(sites)}
    grouped: dict[tuple[str, float, str, str], dict[int, Mapping[str, Any]]] = {}
    for row in rows:
        key = (str(row["mode"]), float(row["beta"]), str(row["period"]), str(row["fault"]))
        grouped.setdefault(key, {})[place_of[int(row["site"])]] = row
    found: dict[Run, list[Exact]] = {}
    for (mode, beta, period, fault), at in grouped.items():
        value, by_beta = np.full((n, 2), np.nan), np.full((n, 2), np.nan)
        slope, v_slope = np.full((n, 2, n), np.nan), np.full((n, n), np.nan)
        loss = np.full(n, np.nan)
        for k, row in at.items():
            if not row["ok"]:
                loss[k] = 1.0 if row["failed_in"] == "facility" else np.nan
                continue
            loss[k] = row["loss_share"]
            value[k] = [row[column] for column in COLUMNS]
            gradients = row.get("gradients")
            if gradients:
                for t, target in enumerate(TARGETS):
                    by_beta[k, t] = gradients[target]["beta"]
                    slope[k, t] = [gradients[target][f"H_{bus}"] for bus in sites]
                v_slope[k] = [gradients["v_poi"][f"H_{bus}"] for bus in sites]
        words = [at.get(k, {}) for k in range(n)]
        found.setdefault((mode, beta), []).append(
            Exact(
                np.asarray(hosting, dtype=float),
                (period, fault),
                value,
                slope,
                by_beta,
                loss,
                v_slope,
                tuple(str(row.get("sequence", "")) for row in words),
                tuple(str(row.get("status", "not run")) for row in words),
            )
        )
    return found
