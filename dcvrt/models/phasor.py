"""Complex arithmetic that is the same on numbers and on CasADi scalars."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca

Scalar = Any
"""A float, or a CasADi SX of one element: the equations cannot tell and must not ask."""


@dataclass(frozen=True)
class Phasor:
    """A complex number as its real and imaginary part; CasADi's SX has no complex type.

    Frames: a phasor in the network frame, which turns at `omega_0`, is seen from a frame that is ahead by the
    angle `delta` as ``v.turn(-delta)``.

    >>> v = Phasor(0.0, 1.0)
    >>> v * v.conj(), abs(complex(v / Phasor(0.0, 2.0)))
    (Phasor(re=1.0, im=0.0), 0.5)
    """

    re: Scalar
    im: Scalar

    @classmethod
    def polar(cls, magnitude: Scalar, angle: Scalar) -> Phasor:
        """Phasor of this magnitude and angle (rad)."""
        return cls(magnitude * ca.cos(angle), magnitude * ca.sin(angle))

    def __add__(self, other: Phasor) -> Phasor:
        return Phasor(self.re + other.re, self.im + other.im)

    def __sub__(self, other: Phasor) -> Phasor:
        return Phasor(self.re - other.re, self.im - other.im)

    def __neg__(self) -> Phasor:
        return Phasor(-self.re, -self.im)

    def __mul__(self, other: Phasor | Scalar) -> Phasor:
        if isinstance(other, Phasor):
            return Phasor(self.re * other.re - self.im * other.im, self.re * other.im + self.im * other.re)
        return Phasor(self.re * other, self.im * other)

    __rmul__ = __mul__

    def __truediv__(self, other: Phasor | Scalar) -> Phasor:
        if isinstance(other, Phasor):
            return self * other.conj() / other.abs2()
        return Phasor(self.re / other, self.im / other)

    def __complex__(self) -> complex:
        return complex(float(self.re), float(self.im))

    def conj(self) -> Phasor:
        """Complex conjugate."""
        return Phasor(self.re, -self.im)

    def abs2(self) -> Scalar:
        """Square of the magnitude: smooth everywhere, unlike the magnitude (see :func:`smooth.mag`)."""
        return self.re * self.re + self.im * self.im

    def turn(self, angle: Scalar) -> Phasor:
        """Multiply by exp(j angle): counter-clockwise by `angle` (rad)."""
        return self * Phasor(ca.cos(angle), ca.sin(angle))

    def angle(self) -> Scalar:
        """Angle in (-pi, pi]; for start values only, an equation that holds it would jump at pi."""
        return ca.atan2(self.im, self.re)
