"""Smooth stand-ins for max, clip, |.| and steps: every one is told its own width `eps`.

All are infinitely often differentiable for eps > 0 and tend to the sharp function as eps tends to 0, so that
the equations have derivatives everywhere and no branch. `eps` has the unit of the argument.
"""

from __future__ import annotations

import casadi as ca

from dcvrt.models.phasor import Phasor, Scalar


def pos(x: Scalar, eps: Scalar) -> Scalar:
    r"""max(x, 0) as :math:`(x + \sqrt{x^2 + \epsilon^2})/2`: above it by at most eps/2, at x = 0."""
    return 0.5 * (x + ca.sqrt(x * x + eps * eps))


def sat(x: Scalar, low: Scalar, high: Scalar, eps: Scalar) -> Scalar:
    """`x` held within [low, high]; never outside it, and exactly `low` where low = high.

    Off the sharp function by at most eps/2, at the corners.
    """
    return low + pos(x - low, eps) - pos(x - high, eps)


def dead(x: Scalar, width: Scalar, eps: Scalar) -> Scalar:
    """What of `x` lies outside [-width, width]; odd in x, so that it is 0 at 0 for every eps."""
    return pos(x - width, eps) - pos(-x - width, eps)


def minimum(a: Scalar, b: Scalar, eps: Scalar) -> Scalar:
    """The smaller of two; below it by at most eps/2, where they are equal."""
    return a - pos(a - b, eps)


def maximum(a: Scalar, b: Scalar, eps: Scalar) -> Scalar:
    """The larger of two; above it by at most eps/2, where they are equal."""
    return a + pos(b - a, eps)


def root(x: Scalar, eps: Scalar) -> Scalar:
    """Square root of x >= 0 with a finite slope at 0, where it is 0; never above the sharp root."""
    return ca.sqrt(x + eps * eps) - eps


def mag(p: Phasor, eps: Scalar) -> Scalar:
    """Magnitude of a phasor, differentiable at 0, where it is eps."""
    return ca.sqrt(p.abs2() + eps * eps)


def step(x: Scalar, eps: Scalar) -> Scalar:
    """0 for x well below 0, 1 well above, 1/2 at 0; within eps^2/(4 x^2) of them."""
    return 0.5 * (1.0 + x / ca.sqrt(x * x + eps * eps))
