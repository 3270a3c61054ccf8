"""Faults that a grid is simulated under."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dcvrt.errors import raise_all


@dataclass(frozen=True)
class BusFault:
    """Three-phase fault at a bus that is cleared by itself; the network is the same before and after.

    Parameters
    ----------
    bus : int
        Bus number.
    start : float
        Inception, s; after 0.
    clear : float
        Time from inception to clearing, s.
    x_f, r_f : float
        Reactance and resistance to ground, pu on the system base.

    Raises
    ------
    InputError
        With every fault of the values at once.

    Examples
    --------
    >>> BusFault(23, start=1.0, clear=0.1).cleared_at
    1.1
    """

    bus: int
    start: float = 0.1
    clear: float = 0.1
    x_f: float = 1e-4
    r_f: float = 0.0

    def __post_init__(self) -> None:
        problems = [
            f"{name} = {value} is not a finite number."
            for name, value in (
                ("start", self.start),
                ("clear", self.clear),
                ("x_f", self.x_f),
                ("r_f", self.r_f),
            )
            if not np.isfinite(value)
        ]
        if not problems:
            if self.start <= 0:
                problems.append(
                    f"start = {self.start:g} s must be after 0 s, where the simulation begins before the "
                    "fault."
                )
            if self.clear <= 0:
                problems.append(
                    f"clear = {self.clear:g} s: the fault would be cleared before it starts. `clear` is the "
                    "time from inception to clearing and must be positive."
                )
            if self.x_f < 0 or self.r_f < 0:
                problems.append(f"x_f = {self.x_f:g}, r_f = {self.r_f:g} pu: neither may be negative.")
            if self.x_f == 0 and self.r_f == 0:
                problems.append(
                    "x_f and r_f are both 0: the power balance at the bus has no solution in voltage "
                    "magnitude and angle. Way out: x_f = 1e-4 pu is a bolted fault for every purpose."
                )
        raise_all(problems, f"fault at bus {self.bus}")

    @property
    def cleared_at(self) -> float:
        """Time of clearing, s."""
        return self.start + self.clear

    @property
    def label(self) -> str:
        """What tables call it."""
        return f"bus {self.bus}, {1e3 * self.clear:g} ms"
