"""How the units share a change of load: hosted capacity, another load level, wind."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from dcvrt.errors import InfeasibleError, InputError, did_you_mean

Floats = npt.NDArray[np.float64]

RULES = ("proportional", "slack")
"""`proportional`: all scheduled units follow; `slack`: the unit at the slack bus takes the whole change."""


def check_rule(rule: str) -> None:
    """Raise `InputError` when `rule` is not one of `RULES`."""
    if rule not in RULES:
        raise InputError(f"redispatch = {rule!r} is not known.{did_you_mean(rule, RULES)}")


def share(
    p_set: Floats, p_max: Floats, total: float, base_mva: float = 1.0, where: str = "redispatch"
) -> Floats:
    r"""Output of each unit when all units follow the total in proportion to their schedule.

    .. math:: p_k = \min(p_k^{max}, \kappa\, p_k^{set}), \qquad \sum_k p_k = p_{total}

    A unit that reaches its limit stays there and the others take over its part. Units that are scheduled to
    generate nothing (condensers) or to take power in stay as they are, and no other unit goes below 0.

    Parameters
    ----------
    p_set, p_max : array (units,)
        Schedule and upper limit, pu on `base_mva`; MW when it is not given.
    total : float
        What they must generate together.
    base_mva : float
    where : str
        What messages call the operating point.

    Raises
    ------
    InfeasibleError
        When the units that follow cannot generate so much, or would have to take power in.

    Examples
    --------
    >>> share(np.array([300.0, 100.0, 0.0]), np.array([330.0, 200.0, 50.0]), 480.0).tolist()
    [330.0, 150.0, 0.0]
    """
    follows = p_set > 0
    weight, ceiling = np.where(follows, p_set, 0.0), np.where(follows, p_max, 0.0)
    fixed = np.where(follows, 0.0, p_set)
    total = total - fixed.sum()
    if not 0 <= total <= ceiling.sum():
        way_out = (
            "more wind than load and losses: lower the wind or raise load_scale."
            if total < 0
            else "host less, lower load_scale or raise p_max of some unit."
        )
        raise InfeasibleError(
            f"{where}: the {int(follows.sum())} units that follow the load can generate 0 to "
            f"{base_mva * ceiling.sum():.5g} MW together, {base_mva * total:.5g} MW are needed. "
            f"Way out: {way_out}"
        )
    p, at_limit = np.zeros_like(weight), np.zeros(len(weight), dtype=bool)
    while True:
        left, free = total - ceiling[at_limit].sum(), weight * ~at_limit
        kappa = left / free.sum() if free.sum() > 0 else 0.0
        p = np.where(at_limit, ceiling, kappa * weight)
        over = (p > ceiling) & ~at_limit
        if not over.any():
            return p + fixed
        at_limit |= over
