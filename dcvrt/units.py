"""Units of symbols, and the per-unit kinds that must never mix.

Per-unit numbers look alike whatever they measure, so that a voltage can be wired to a current without anyone
noticing. dcvrt therefore writes the kind with the unit: ``pu(V)``, ``pu(I)``, ``pu(S)``, ``pu(Z)``. Two ports
may be wired when their units are the same product of the same bases; nothing is converted silently.
"""

from __future__ import annotations

import re
from functools import cache

from dcvrt.errors import ModelError, did_you_mean

BASES = {
    "1": "no unit: a ratio or a share",
    "s": "second",
    "h": "hour",
    "rad": "radian",
    "deg": "degree of angle",
    "Hz": "hertz",
    "K": "kelvin: a difference of temperature",
    "pu(V)": "voltage over its base",
    "pu(I)": "current over its base",
    "pu(S)": "power, active, reactive or apparent, over S_B",
    "pu(Z)": "impedance over its base",
    "MW": "megawatt",
    "Mvar": "megavar",
    "MVA": "megavolt-ampere",
}
"""What a unit may be made of."""

_FACTOR = re.compile(r"^(?P<base>pu\([A-Z]\)|[A-Za-z]+|1)(?P<power>-?\d+)?$")

Dimension = tuple[tuple[str, int], ...]


@cache
def dimension(unit: str) -> Dimension:
    """Exponents of the bases of `unit`, sorted by base.

    A unit is written as factors with a space between them, each with an optional whole exponent, and ``/``
    before every factor that divides: ``pu(S) s``, ``rad/s2``, ``rad/s/pu(V)``.

    Raises
    ------
    ModelError
        a factor that is not known, and plain ``pu``, which does not say what it measures.

    >>> dimension("rad/s2")
    (('rad', 1), ('s', -2))
    >>> dimension("pu(S)/pu(S)")
    ()
    """
    powers: dict[str, int] = {}
    for part, sign in [(piece, -1 if k else 1) for k, piece in enumerate(unit.split("/"))]:
        # only the factor right after a slash is divided by; those after a space multiply again
        for place, factor in enumerate(part.split()):
            match = _FACTOR.match(factor)
            if factor == "pu":
                raise ModelError(
                    f"unit {unit!r}: plain 'pu' does not say of what. Write pu(V), pu(I), pu(S) or pu(Z)."
                )
            if match is None or match["base"] not in BASES:
                raise ModelError(f"unit {unit!r}: {factor!r} is not known.{did_you_mean(factor, BASES)}")
            power = int(match["power"] or 1) * (sign if place == 0 else 1)
            powers[match["base"]] = powers.get(match["base"], 0) + power
    if not unit.strip():
        raise ModelError("a unit is missing. Write '1' for a ratio.")
    return tuple(sorted((base, power) for base, power in powers.items() if power and base != "1"))


def same_unit(one: str, other: str) -> bool:
    """Whether two units are the same product of the same bases.

    The bases of power and impedance follow from those of voltage and current, S = V I and Z = V/I.

    >>> same_unit("pu(S)/s", "pu(S) s-1"), same_unit("pu(V)", "pu(I)")
    (True, False)
    >>> same_unit("pu(V)/pu(I)", "pu(Z)"), same_unit("pu(S)/pu(V)", "pu(I)")
    (True, True)
    """
    return reduced(dimension(one)) == reduced(dimension(other))


def product(*factors: tuple[Dimension, int]) -> Dimension:
    """Product of dimensions, each to a power.

    >>> product((dimension("pu(V)"), 2), (dimension("s"), -1))
    (('pu(V)', 2), ('s', -1))
    """
    powers: dict[str, int] = {}
    for factor, exponent in factors:
        for base, power in factor:
            powers[base] = powers.get(base, 0) + power * exponent
    return tuple(sorted((base, power) for base, power in powers.items() if power))


def reduced(given: Dimension) -> Dimension:
    """The dimension with power and impedance written in voltage and current."""
    powers = dict(given)
    s, z = powers.pop("pu(S)", 0), powers.pop("pu(Z)", 0)
    return product((tuple(powers.items()), 1), ((("pu(I)", s - z), ("pu(V)", s + z)), 1))


def unit_text(given: Dimension) -> str:
    """The unit that has this dimension.

    >>> unit_text(dimension("rad/s2/pu(V)")), unit_text(())
    ('rad/pu(V)/s2', '1')
    """

    def power(base: str, exponent: int) -> str:
        return base if exponent == 1 else f"{base}{exponent}"

    over = " ".join(power(base, n) for base, n in given if n > 0) or "1"
    return over + "".join(f"/{power(base, -n)}" for base, n in given if n < 0)
