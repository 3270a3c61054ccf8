"""What dcvrt is measured against: other integrators on the same stretches of the same run.

A baseline is a function ``make(rtol)`` that returns a :class:`Solver` for one tolerance. All of them get the
times of jumps and events, and what sensitivities jump by there, from the reference run.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class CannotRun(RuntimeError):  # noqa: N818 - an outcome that a row tells
    """A baseline failed at this tolerance; the message says how."""


class NotInstalled(RuntimeError):  # noqa: N818 - an outcome that is told
    """The package of a baseline is not there; the message names it and the extra that brings it."""


@dataclass(frozen=True)
class Solver:
    """One baseline at one tolerance.

    Attributes
    ----------
    run : integrates the whole run and keeps the states at the ends of the stretches: this is timed.
    path : the same with samples inside, (stretches, points, states): the error is taken on these.
    """

    run: Callable[[], object]
    path: Callable[[], Array]
