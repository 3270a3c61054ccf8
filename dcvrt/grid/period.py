"""The operating period that a hosting vector is simulated in."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np

from dcvrt.errors import raise_all


@dataclass(frozen=True)
class Period:
    """State of the grid that a fault meets, apart from what is hosted.

    Parameters
    ----------
    name : str
        What tables call it.
    load_scale : float
        Factor on every load of the network, active and reactive.
    wind : mapping of int to float
        Wind injection by bus number, MW, at unity power factor.
    dc_factor : float
        Data-centre load over hosted capacity, d_t.
    hour : int, optional
        Hour of the year that it stands for.

    Raises
    ------
    InputError
        With every fault of the values at once.

    Examples
    --------
    >>> Period("light", load_scale=0.5, wind={69: 180.0}).dc_factor
    1.0
    """

    name: str = "base"
    load_scale: float = 1.0
    wind: Mapping[int, float] = field(default_factory=dict)
    dc_factor: float = 1.0
    hour: int | None = None

    def __post_init__(self) -> None:
        problems = []
        for name, value in (("load_scale", self.load_scale), ("dc_factor", self.dc_factor)):
            if not np.isfinite(value) or value < 0:
                problems.append(f"{name} = {value} must be a number of at least 0.")
        for bus, mw in self.wind.items():
            if not np.isfinite(mw) or mw < 0:
                problems.append(f"wind at bus {bus} = {mw} MW must be a number of at least 0.")
        raise_all(problems, f"period {self.name!r}")
        object.__setattr__(self, "wind", MappingProxyType(dict(self.wind)))

    def __reduce__(self) -> tuple[object, ...]:
        return Period, (self.name, self.load_scale, dict(self.wind), self.dc_factor, self.hour)

    def __hash__(self) -> int:
        return hash((self.name, self.load_scale, tuple(sorted(self.wind.items())), self.dc_factor, self.hour))
