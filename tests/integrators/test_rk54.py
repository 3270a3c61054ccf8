"""Coefficients that the driver steps with: conditions of order, dense output, stability, error estimate."""

from __future__ import annotations

import re
from fractions import Fraction
from importlib import resources
from itertools import pairwise

import numpy as np
import pytest

TEXT = (resources.files("dcvrt.integrators.kernel") / "driver" / "rk54.h").read_text(encoding="utf-8")
ALONE = (resources.files("dcvrt.integrators.kernel") / "driver" / "dp5.h").read_text(encoding="utf-8")
GRID = (resources.files("dcvrt.grid.native") / "driver" / "pair.h").read_text(encoding="utf-8")
STAGES = 7
Vector = list[Fraction]


def numbers(text: str) -> Vector:
    parts = [part.strip() for part in text.replace("\n", " ").split(",") if part.strip()]
    return [
        Fraction(a.rstrip(".")) / Fraction(b)
        for a, b in (p.split("/") if "/" in p else (p, "1") for p in parts)
    ]


def table(name: str) -> Vector:
    found = re.search(rf"{name}\[STAGES\] = \{{(.*?)\}};", TEXT, flags=re.DOTALL)
    assert found is not None
    return numbers(found[1])


def filled(row: Vector) -> Vector:
    return row + [Fraction(0)] * (STAGES - len(row))


found = re.search(r"A\[STAGES\]\[STAGES - 1\] = \{(.*?)\n\};", TEXT, flags=re.DOTALL)
assert found is not None
A = [filled(numbers(row)) for row in re.findall(r"\{(.*?)\}", found[1])]
C, ERROR, LAST = table("NODE"), table("ERROR"), table("LAST_TERM")
B = A[-1]
EMBEDDED = [b - e for b, e in zip(B, ERROR, strict=True)]


def times(*vectors: Vector) -> Vector:
    return [Fraction(np.prod(entries)) for entries in zip(*vectors, strict=True)]


def through(v: Vector) -> Vector:
    return [sum((a * x for a, x in zip(row, v, strict=True)), Fraction(0)) for row in A]


def trees() -> list[tuple[int, int, Vector]]:
    """Order, density and elementary weights of every rooted tree up to order 5."""
    one = [Fraction(1)] * STAGES
    c2, c3, Ac = times(C, C), times(C, C, C), through(C)
    Ac2, AAc = through(c2), through(Ac)
    return [
        (1, 1, one), (2, 2, C), (3, 3, c2), (3, 6, Ac),
        (4, 4, c3), (4, 8, times(C, Ac)), (4, 12, Ac2), (4, 24, AAc),
        (5, 5, times(c2, c2)), (5, 10, times(c2, Ac)), (5, 15, times(C, Ac2)), (5, 30, times(C, AAc)),
        (5, 20, times(Ac, Ac)), (5, 20, through(c3)), (5, 40, through(times(C, Ac))),
        (5, 60, through(Ac2)), (5, 120, through(AAc)),
    ]  # fmt: skip


def dot(a: Vector, b: Vector) -> Fraction:
    return sum((x * y for x, y in zip(a, b, strict=True)), Fraction(0))


def test_all_conditions_of_order_five_and_of_the_embedded_order_four() -> None:
    assert [sum(row) for row in A] == C
    assert C[-2:] == [1, 1]  # the last two stages are at the end of the step
    for order, density, weights in trees():
        assert dot(B, weights) == Fraction(1, density)
        assert (dot(EMBEDDED, weights) == Fraction(1, density)) == (order <= 4)


def dense(s: Fraction) -> Vector:
    """Weights of the stages inside the step, as the driver builds them."""
    first, last, u = filled([Fraction(1)]), [Fraction(0)] * (STAGES - 1) + [Fraction(1)], 1 - s
    found = []
    for b, e1, e7, d in zip(B, first, last, LAST, strict=True):
        bend = e1 - b
        found.append(s * (b + u * (bend + s * (b - e7 - bend + u * d))))
    return found


@pytest.mark.parametrize("s", [Fraction(k, 7) for k in range(8)])
def test_dense_output_has_order_four_everywhere(s: Fraction) -> None:
    for order, density, weights in trees():
        if order <= 4:
            assert dot(dense(s), weights) == s**order / density


def polynomial(weights: Vector) -> np.ndarray:
    """Coefficients of the growth of y' = lambda y by h lambda, beginning with the constant."""
    found, v = [Fraction(1)], [Fraction(1)] * STAGES
    for _ in range(STAGES):
        found.append(dot(weights, v))
        v = through(v)
    return np.array([float(x) for x in found])


def growth(coefficients: np.ndarray, z: complex | np.ndarray) -> np.ndarray:
    return np.abs(np.polyval(coefficients[::-1], z))


def test_the_region_of_stability_is_wide_and_the_dense_output_stays_within() -> None:
    along = -np.linspace(0, 5.7, 2000)
    assert growth(polynomial(B), along).max() <= 1.0
    assert growth(polynomial(B), -5.75) > 1.0
    for angle, reach in ((150, 4.0), (135, 3.8), (120, 3.6), (95, 3.3)):
        z = np.linspace(0, reach, 500) * np.exp(1j * np.deg2rad(angle))
        assert growth(polynomial(B), z).max() <= 1.0 + 1e-9, angle
    inside = -np.linspace(0, 5.0, 300)
    for s in np.linspace(0, 1, 21):
        assert growth(polynomial(dense(Fraction(s).limit_denominator(100))), inside).max() <= 1.0 + 1e-9


def test_the_error_estimate_sees_everything_that_the_step_may_reach() -> None:
    """It vanishes at -7.08, where a step grows 13 times: both drivers keep off by their limit of 5.3, and by
    the last term of the dense output where slow motion hides the fast."""
    estimate = polynomial(B) - polynomial(EMBEDDED)
    (limit,), (alone,) = (re.findall(r"#define REACH ([0-9.]+)", text) for text in (GRID, ALONE))
    assert alone == limit
    zeros = np.roots(np.trim_zeros(estimate[::-1], "f"))
    left = zeros[(zeros.real < -1e-9)]
    assert left == pytest.approx([-7.0848], abs=1e-3)
    assert growth(polynomial(B), left[0]) == pytest.approx(13.5, abs=0.1)
    for text in (GRID, ALONE):
        (still,) = re.findall(r"#define STILL ([0-9.]+)", text)
        assert growth(polynomial(B), left[0]) * float(still) < 0.5  # tolerances, of what is not looked at
    assert float(limit) < 5.7
    last = polynomial(LAST) - polynomial(filled([]))
    assert growth(last, left[0]) == pytest.approx(494, abs=1)
    size = growth(estimate, -np.linspace(1.0, 6.5, 400))
    assert all(b > a for a, b in pairwise(size[: int(400 * (5.3 - 1.0) / 5.5)]))  # grows up to the limit
    assert size[-1] > 0.5
