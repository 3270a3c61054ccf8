"""The least converter rating with which a facility rides through given waveforms."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from dcvrt.errors import InputError

if TYPE_CHECKING:
    from dcvrt.criteria import Criteria
    from dcvrt.integrators import Simulator
    from dcvrt.waveform import Waveform


def least_rating(
    simulator: Simulator,
    waveforms: Sequence[Waveform],
    d: float | Sequence[float],
    pf: float,
    criteria: Criteria,
    low: float = 1.0,
    high: float = 2.0,
    tolerance: float = 0.005,
    parameters: Mapping[str, float] | None = None,
) -> float | None:
    r"""Smallest rating ratio at which both margins are met on every waveform, by bisection.

    .. math::
        \beta^\ast = \max_w \min \{\beta \in [\beta_{low}, \beta_{high}] :
        m_V(w, \beta) \ge 0,\; m_L(w, \beta) \ge 0\}

    Waveforms are taken from the lowest retained voltage up, round after round. One that is not ridden through
    at the rating found so far raises it by bisection between that rating and `high`; the search ends when
    every waveform in a row has been ridden through at one and the same rating.

    Assumed: the margins of each waveform grow with the rating. Where they do not, the returned rating is
    still one at which every waveform was run and ridden through, but a smaller one may exist; and None says
    that `high` does not pass, not that nothing between does. A run that fails counts as not ridden through.

    Parameters
    ----------
    simulator : compiled facility with the parameters H, beta, d and pf; runs on the base S_B = H.
    waveforms : POI voltages.
    d : load factor, one for all waveforms or one each.
    pf : power factor of the import.
    criteria : what riding through means.
    low, high : ratings searched, over the hosted capacity.
    tolerance : the result lies at most so far above the least rating.
    parameters : values other than the simulator's own, by path.

    Returns
    -------
    float or None
        `low` when that is already enough; None when a waveform is not ridden through at `high`.

    Raises
    ------
    InputError
        No waveform, load factors that do not match them, limits or a tolerance that leave nothing to search;
        parameters that the facility does not have or that lie outside their bounds.
    """
    factors = (
        np.broadcast_to(np.asarray(d, dtype=float), len(waveforms)) if np.ndim(d) == 0 else np.asarray(d)
    )
    if not len(waveforms):
        raise InputError("least rating: there is no waveform to ride through.")
    if len(factors) != len(waveforms):
        raise InputError(
            f"least rating: {len(factors)} load factors for {len(waveforms)} waveforms. Give one for all or "
            "one each."
        )
    if not low < high or not tolerance > 0:
        raise InputError(
            f"least rating: nothing to search between low = {low:g} and high = {high:g} with a tolerance of "
            f"{tolerance:g}."
        )

    def rides_through(k: int, beta: float) -> bool:
        table = {**(parameters or {}), "H": 1.0, "d": float(factors[k]), "pf": pf, "beta": beta}
        (found,) = simulator.batch([waveforms[k]], table, criteria=criteria).margins
        return found is not None and found.passed

    order = np.argsort([float(w.magnitude.min()) for w in waveforms], kind="stable").tolist()
    beta, in_a_row, at = low, 0, 0
    while in_a_row < len(order):
        k = order[at % len(order)]
        at += 1
        if rides_through(k, beta):
            in_a_row += 1
            continue
        if not rides_through(k, high):
            return None
        fails, beta = beta, high
        while beta - fails > tolerance:
            middle = 0.5 * (fails + beta)
            if rides_through(k, middle):
                beta = middle
            else:
                fails = middle
        in_a_row = 1
    return beta
