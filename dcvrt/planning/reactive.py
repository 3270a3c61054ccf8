r"""Reactive power that units give to hold their voltages, beside the limits that the power flow does not
enforce.

.. math::
    Q^g_{k,t} = \operatorname{Im}\Big\{V_{k,t} \Big(\sum_m Y_{km} V_{m,t}\Big)^*\Big\} + Q^d_{k,t}

at every bus with units that holds its voltage; Q^d is the demand there, hosted load included.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dcvrt.grid.network import Network

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]
Phasors = npt.NDArray[np.complex128]

TOLERANCE_MVAR = 1e-3
"""Excess over a reactive limit that does not count, Mvar."""


@dataclass(frozen=True)
class ReactiveExcess:
    """Reactive output of the units beyond their limits, over all hours that have a solution.

    Units at one bus share its output: they are beyond together, when the bus is beyond the sum of theirs.

    Parameters
    ----------
    above, below : int
        Units above q_max and units below q_min in the worst hour, the one with most units beyond.
    hour : int or None
        The worst hour; None when no unit is beyond in any hour.
    hours : int
        Hours with a unit beyond.
    excess_mvar : float
        Largest distance of a bus beyond its limit in any hour.
    excess_bus, excess_hour : int or None
        Where and when it is.
    """

    above: int
    below: int
    hour: int | None
    hours: int
    excess_mvar: float
    excess_bus: int | None
    excess_hour: int | None

    @property
    def units(self) -> int:
        """Units beyond either limit in the worst hour."""
        return self.above + self.below

    def __str__(self) -> str:
        if self.hour is None:
            return "no unit beyond a limit in any hour"
        kinds = (self.above, "above q_max"), (self.below, "below q_min")
        counts = " and ".join(f"{count} {kind}" for count, kind in kinds if count)
        return (
            f"{counts} in hour {self.hour}, the worst; at most {self.excess_mvar:.4g} Mvar "
            f"beyond, at bus {self.excess_bus} in hour {self.excess_hour}"
        )


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
    over, under = output - buses.high[:, None], buses.low[:, None] - output
    beyond = np.maximum(over, under)
    if not beyond.size or beyond.max() <= TOLERANCE_MVAR:
        return ReactiveExcess(0, 0, None, 0, 0.0, None, None)
    above, below = (buses.count @ (far > TOLERANCE_MVAR) for far in (over, under))
    worst = int((above + below).argmax())
    k, t = np.unravel_index(int(beyond.argmax()), beyond.shape)
    return ReactiveExcess(
        int(above[worst]),
        int(below[worst]),
        int(hours[worst]),
        int((above + below > 0).sum()),
        float(beyond[k, t]),
        int(network.bus[buses.at[k]]),
        int(hours[t]),
    )
