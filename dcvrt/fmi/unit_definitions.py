"""Units of dcvrt as FMI describes them: exponents of the SI base units and a factor."""

from __future__ import annotations

import math

from dcvrt.units import dimension

SI = {
    "s": ({"s": 1}, 1.0),
    "h": ({"s": 1}, 3600.0),
    "rad": ({"rad": 1}, 1.0),
    "deg": ({"rad": 1}, math.pi / 180),
    "Hz": ({"s": -1}, 1.0),
    "MW": ({"kg": 1, "m": 2, "s": -3}, 1e6),
    "Mvar": ({"kg": 1, "m": 2, "s": -3}, 1e6),
    "MVA": ({"kg": 1, "m": 2, "s": -3}, 1e6),
}
"""Bases of dcvrt that have a size in SI; the per-unit kinds have none and keep their names."""


def base_unit(unit: str) -> dict[str, str]:
    """Attributes of the `BaseUnit` of a unit: exponents that are not zero, and a factor that is not one.

    >>> base_unit("rad/s2"), base_unit("h"), base_unit("pu(V)")
    ({'s': '-2', 'rad': '1'}, {'s': '1', 'factor': '3600.0'}, {})
    """
    exponents = dict.fromkeys(("kg", "m", "s", "A", "K", "mol", "cd", "rad"), 0)
    factor = 1.0
    for base, power in dimension(unit):
        parts, size = SI.get(base, ({}, 1.0))
        factor *= size**power
        for name, exponent in parts.items():
            exponents[name] += exponent * power
    attributes = {name: str(exponent) for name, exponent in exponents.items() if exponent}
    if factor != 1.0:
        attributes["factor"] = repr(factor)
    return attributes
