"""The facility variants, wired from blocks.

Per unit on S_B; import positive; network frame at omega_0; energy in pu*s. Every power, gain and limit is
proportional to the hosted capacity `H`, so that a run on the base S_B = H (``H=1``) is the run of every size.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable

from dcvrt.errors import InputError, did_you_mean
from dcvrt.facility.double_conversion import (
    gfl,
    gfl_sag_counter,
    gfl_support,
    gfl_vfd_cooling,
    gfm,
    gfm_droop,
)
from dcvrt.facility.eco_mode import eco_mode
from dcvrt.facility.line_interactive import line_interactive
from dcvrt.facility.no_ups import no_ups
from dcvrt.models import Diagram

__all__ = [
    "VARIANTS",
    "eco_mode",
    "get",
    "gfl",
    "gfl_sag_counter",
    "gfl_support",
    "gfl_vfd_cooling",
    "gfm",
    "gfm_droop",
    "line_interactive",
    "names",
    "no_ups",
]

VARIANTS: dict[str, Callable[[], Diagram]] = {
    "gfl": gfl,
    "gfm": gfm,
    "gfm-droop": gfm_droop,
    "line-interactive": line_interactive,
    "eco-mode": eco_mode,
    "no-ups": no_ups,
    "gfl-vfd-cooling": gfl_vfd_cooling,
    "gfl-sag-counter": gfl_sag_counter,
    "gfl-support": gfl_support,
}


def names() -> tuple[str, ...]:
    """Names of the shipped variants.

    >>> names()[:3]
    ('gfl', 'gfm', 'gfm-droop')
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
    variant = VARIANTS[name]
    diagram = variant()
    diagram.page = diagram.page or inspect.getdoc(variant) or ""
    return diagram
