r"""PV-PQ switching: which buses hold their voltage, and which are at a reactive limit of their units instead.

.. math::
    \underline Q \le Q \le \overline Q, \qquad
    V = V^{set} \;\text{or}\; (Q = \overline Q,\, V \le V^{set}) \;\text{or}\;
    (Q = \underline Q,\, V \ge V^{set})
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from dcvrt.grid.network import Network

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]
Limited = npt.NDArray[np.int8]
"""Of each bus: 1 at its largest, -1 at its smallest reactive output, 0 where it holds its voltage."""

LIMIT_TOLERANCE = 1e-8
"""Excess over a reactive limit, and difference to a set point, that switches no bus, pu."""
LOOKS = 40
"""Looks at a power flow before it counts as unsolved; after half of them no bus is released any more."""


def reactive_limits_at(network: Network, buses: Integers) -> tuple[Floats, Floats]:
    """Least and largest reactive output at buses, pu; units at one bus are taken together."""
    units, at, count = network.generators, network.generator_index, len(network.bus)
    low, high = (np.bincount(at, q, count)[buses] / network.base_mva for q in (units.q_min, units.q_max))
    return low, high


def switched(
    limited: Limited,
    q: Floats,
    size: Floats,
    held: Floats,
    q_low: Floats,
    q_high: Floats,
    back: bool | npt.NDArray[np.bool_] = True,
) -> Limited:
    """Which limit each bus is at after one look at a solution.

    A bus that holds its voltage beyond a limit goes to that limit. One at its upper limit has let the voltage
    sag: once that is above the set point, it holds it again; the same for the lower limit.

    Parameters
    ----------
    limited : int array (buses,) or (buses, hours)
        Limits that the solution was made with.
    q, size : arrays of the same shape
        Reactive output and voltage of the solution, pu.
    held, q_low, q_high : arrays (buses,)
        Set points and limits, pu.
    back : bool or bool array (hours,)
        Whether buses may hold their voltage again.
    """
    held, q_low, q_high = (a.reshape((-1,) + (1,) * (q.ndim - 1)) for a in (held, q_low, q_high))
    beyond = (q > q_high + LIMIT_TOLERANCE).astype(np.int8)
    beyond -= q < q_low - LIMIT_TOLERANCE
    wrong = ((limited > 0) & (size > held + LIMIT_TOLERANCE)) | (
        (limited < 0) & (size < held - LIMIT_TOLERANCE)
    )
    kept = np.where(wrong & back, 0, limited)
    return np.where(limited == 0, beyond, kept).astype(np.int8)
