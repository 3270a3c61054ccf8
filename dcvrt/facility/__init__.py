"""The facility variants, wired from blocks.

Per unit on S_B; import positive; network frame at omega_0; energy in pu*s. Every power, gain and limit is
proportional to the hosted capacity `H`, so that a run on the base S_B = H (``H=1``) is the run of every size.
"""

from __future__ import annotations

from collections.abc import Callable

from dcvrt.errors import InputError, did_you_mean
from dcvrt.facility.double_conversion import gfl, gfm
from dcvrt.models import Diagram

__all__ = ["VARIANTS", "get", "gfl", "gfm", "names"]

VARIANTS: dict[str, Callable[[], Diagram]] = {"gfl": gfl, "gfm": gfm}


def names() -> tuple[str, ...]:
    """Names of the shipped variants.

    >>> names()
    ('gfl', 'gfm')
    """
    return tuple(VARIANTS)


def get(name: str) -> Diagram:
    """A new diagram of the variant `name`, to change or to compile.

    Raises
    ------
    InputError
        no variant has this name.
    """
    if name not in VARIANTS:
        raise InputError(f"there is no facility variant {name!r}.{did_you_mean(name, VARIANTS)}")
    return VARIANTS[name]()
