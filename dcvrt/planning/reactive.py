r"""Reactive power that units give to hold their voltages, beside the limits that the power flow does not
enforce.

.. math::
    Q^g_{k,t} = \operatorname{Im}\Big\{V_{k,t} \Big(\sum_m Y_{km} V_{m,t}\Big)^*\Big\} + Q^d_{k,t}

at every bus with units that holds its voltage; Q^d is the demand there, hosted load included.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from dcvrt.grid.network import Network

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]
Phasors = npt.NDArray[np.complex128]

TOLERANCE_MVAR = 1e-3
"""Excess over a reactive limit that does not count, Mvar."""


@dataclass(frozen=True)
class Beyond:
    """Units beyond one of their two reactive limits, over all hours that have a solution.

    Units at one bus share its output: they are beyond together, when the bus is beyond the sum of theirs.

    Parameters
    ----------
    units : int
        Units beyond in the worst hour, the one with most of them.
    hour : int or None
        The worst hour; None when no unit is beyond in any hour.
    excess_mvar : float
        Largest distance of a bus beyond its limit in any hour.
    bus, excess_hour : int or None
        Where and when that is.
    """

    units: int = 0
    hour: int | None = None
    excess_mvar: float = 0.0
    bus: int | None = None
    excess_hour: int | None = None

    def text(self, limit: str) -> str:
        """What is told of it.

        >>> Beyond(3, 17, 12.345, 77, 19).text("above q_max")
        '3 above q_max (hour 17), by up to 12.3 Mvar (bus 77, hour 19)'
        >>> Beyond().text("above q_max")
        'none above q_max'
        """
        if not self.units:
            return f"none {limit}"
        return (
            f"{self.units} {limit} (hour {self.hour}), by up to {self.excess_mvar:.1f} Mvar (bus {self.bus}, "
            f"hour {self.excess_hour})"
        )


@dataclass(frozen=True)
class ReactiveExcess:
    """Reactive output of the units beyond their limits.

    Parameters
    ----------
    above, below : Beyond
        Units above q_max, and units below q_min.
    """

    above: Beyond = Beyond()
    below: Beyond = Beyond()

    def __bool__(self) -> bool:
        return bool(self.above.units or self.below.units)

    def __str__(self) -> str:
        return f"{self.above.text('above q_max')}; {self.below.text('below q_min')}"

    @classmethod
    def of(cls, sides: Mapping[str, Mapping[str, Any]]) -> ReactiveExcess:
        """Undo `dataclasses.asdict`."""
        return cls(Beyond(**sides["above"]), Beyond(**sides["below"]))


@dataclass(frozen=True, eq=False)
class UnitBuses:
    """Buses whose units hold the voltage, with the reactive limits of each bus.

    Parameters
    ----------
    at : int array (buses,)
        Positions of the buses in the network.
    count : int array (buses,)
        Units there.
    low, high : arrays (buses,)
        Sum of their q_min and of their q_max, Mvar.
    """

    at: Integers
    count: Integers
    low: Floats
    high: Floats

    @classmethod
    def of(cls, network: Network) -> UnitBuses:
        """The buses of a network that are not `pq` and have units."""
        holds = np.array(network.kind) != "pq"
        at, place = np.unique(network.generator_index, return_inverse=True)
        units = network.generators
        count, low, high = (
            np.bincount(place, weights=w, minlength=len(at))
            for w in (np.ones(len(units)), units.q_min, units.q_max)
        )
        keep = holds[at]
        return cls(at[keep], count[keep].astype(np.int64), low[keep], high[keep])


def unit_output(network: Network, buses: UnitBuses, v: Phasors, scheduled: Phasors) -> Floats:
    """Reactive output of the units at each bus and hour, Mvar.

    Parameters
    ----------
    v : complex array (all buses, hours)
        Voltages of a solved power flow, pu.
    scheduled : complex array (all buses, hours)
        Injections that the power flow was given, MVA; their imaginary part is the demand alone.
    """
    injected = v[buses.at] * (network.admittance()[buses.at] @ v).conj()
    return np.asarray(injected.imag * network.base_mva - scheduled[buses.at].imag)


def excess(network: Network, buses: UnitBuses, output: Floats, hours: Integers) -> ReactiveExcess:
    """Count the units beyond their limits and find the largest excess.

    Parameters
    ----------
    output : array (buses, hours)
        As `unit_output` gives it.
    hours : int array (hours,)
        Names of the hours.
    """
    sides = output - buses.high[:, None], buses.low[:, None] - output
    return ReactiveExcess(*(_beyond(network, buses, far, hours) for far in sides))


def _beyond(network: Network, buses: UnitBuses, far: Floats, hours: Integers) -> Beyond:
    """Count what lies farther than the tolerance beyond a limit, `far` Mvar at each bus and hour."""
    if not far.size or far.max() <= TOLERANCE_MVAR:
        return Beyond()
    units = buses.count @ (far > TOLERANCE_MVAR)
    worst = int(units.argmax())
    k, t = np.unravel_index(int(far.argmax()), far.shape)
    return Beyond(
        int(units[worst]),
        int(hours[worst]),
        float(far[k, t]),
        int(network.bus[buses.at[k]]),
        int(hours[t]),
    )
