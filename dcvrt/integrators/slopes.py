"""Derivatives that are not numbers yet: linear forms in the derivatives of samples.

A functional of a run is evaluated once, with these in place of the columns of a forward sensitivity. What
comes out is the recipe of its gradient: so much of dy/dtheta at this sample, so much of dt_e/dtheta of that
break. An adjoint sweep then pulls the recipe back to every theta at once.
"""

from __future__ import annotations

import heapq
import itertools
from typing import Any

import numpy as np
from numpy.typing import NDArray

Leaf = tuple[str, int, int]
"""What a form is made of: ("value" or "rate", sample, output), or ("break", number of the break, 0)."""


class Slope:
    """Sum of other slopes times numbers, or the derivative of one sample; made by arithmetic."""

    __slots__ = ("leaf", "number", "parts")
    _count = itertools.count()

    def __init__(self, parts: tuple[tuple[float, Slope], ...] = (), leaf: Leaf | None = None) -> None:
        self.parts, self.leaf, self.number = parts, leaf, next(Slope._count)

    def __add__(self, other: object) -> Slope:
        if isinstance(other, Slope):
            return Slope(((1.0, self), (1.0, other)))
        constant = float(other)  # type: ignore[arg-type]
        if constant == 0.0:
            return self
        return Slope(((np.nan, self),))  # no derivative is a number but 0 and 'there is none'

    __radd__ = __add__

    def __mul__(self, factor: float) -> Slope:
        return Slope(((float(factor), self),))

    __rmul__ = __mul__

    def __truediv__(self, divisor: float) -> Slope:
        return Slope(((1.0 / float(divisor) if divisor else np.nan, self),))

    def __neg__(self) -> Slope:
        return self * -1.0

    def __sub__(self, other: object) -> Slope:
        return self + (-1.0) * other  # type: ignore[operator]

    def __rsub__(self, other: object) -> Slope:
        return -self + other

    def weights(self) -> dict[Leaf, float]:
        """The form as weights on derivatives of samples."""
        found: dict[Leaf, float] = {}
        pending = {self.number: (self, 1.0)}
        order = [-self.number]
        while order:  # latest first: a slope is complete once everything made from it has been seen
            slope, weight = pending.pop(-heapq.heappop(order))
            if slope.leaf is not None:
                found[slope.leaf] = found.get(slope.leaf, 0.0) + weight
            for factor, part in slope.parts:
                if part.number in pending:
                    pending[part.number] = (part, pending[part.number][1] + weight * factor)
                else:
                    pending[part.number] = (part, weight * factor)
                    heapq.heappush(order, -part.number)
        return found


class Columns:
    """Stands where a forward run has sensitivities (samples, outputs, thetas): one column of slopes.

    ``columns[:, k]`` is that of output k.
    """

    def __init__(self, kind: str, samples: int) -> None:
        self.kind, self.samples = kind, samples

    def __getitem__(self, key: tuple[slice, int]) -> NDArray[Any]:
        made = np.empty((self.samples, 1), dtype=object)
        made[:, 0] = [Slope(leaf=(self.kind, i, key[1])) for i in range(self.samples)]
        return made


def breaks(count: int) -> NDArray[Any]:
    """One slope per break: the derivative of its time."""
    made = np.empty((count, 1), dtype=object)
    made[:, 0] = [Slope(leaf=("break", i, 0)) for i in range(count)]
    return made
