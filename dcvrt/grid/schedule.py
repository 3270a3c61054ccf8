"""What buses are scheduled to feed in: units that follow the net load, loads, wind, hosted load."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from dcvrt.errors import InputError
from dcvrt.grid.network import Network

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]
Phasors = npt.NDArray[np.complex128]


def participation(network: Network) -> Floats:
    """Share of each generator in a change of net load: its scheduled output over the sum of all.

    Units that are scheduled to take power in, or nothing, have share 0. The shares sum to 1.

    Raises
    ------
    InputError
        When no unit is scheduled to generate.
    """
    scheduled = np.maximum(network.generators.p_set, 0.0)
    if scheduled.sum() <= 0:
        raise InputError(
            f"{network.name}: no generator is scheduled to generate, so none can follow the load. "
            "Way out: give p_set of at least one unit."
        )
    return scheduled / scheduled.sum()


def dispatch(network: Network, net_load: Floats | float) -> Floats:
    """Output of each generator, MW, when all follow the net load in proportion to their schedule.

    Losses are not in it: the slack bus takes them. The limits p_min and p_max are not looked at.

    Parameters
    ----------
    net_load : float or array (hours,)
        Load and hosted load less wind, MW.

    Returns
    -------
    array (generators,) or (generators, hours)
    """
    return np.multiply.outer(participation(network), net_load)


def injections(
    network: Network, load: Floats, wind: Mapping[int, Floats], hosted: Mapping[int, Phasors] | None = None
) -> Phasors:
    """Scheduled bus injections in MVA, generation positive, of many operating hours.

    Parameters
    ----------
    load : array (hours,)
        Factor on every active and reactive load.
    wind : mapping of bus number to array (hours,)
        Wind power in MW, at unity power factor.
    hosted : mapping of bus number to complex array (hours,)
        Hosted load P + jQ in MVA, import positive.

    Returns
    -------
    complex array (buses, hours)
        Units follow the net load as `dispatch` says. At `pv` and `slack` buses Q is what holds the voltage.
    """
    load = np.atleast_1d(np.asarray(load, dtype=float))
    power = -np.outer(network.p_load + 1j * network.q_load, load)
    for bus, mw in wind.items():
        power[network.index(bus)] += mw
    for bus, mva in (hosted or {}).items():
        power[network.index(bus)] -= mva
    units = dispatch(network, -power.real.sum(axis=0))
    np.add.at(power, network.generator_index, units)
    return power


def hosting_directions(network: Network, sites: Sequence[int] | Integers, pf: float) -> Phasors:
    r"""Change of all scheduled injections per MW hosted at each site, MVA.

    The site takes :math:`1 + j\tan\arccos \mathrm{pf}`, and the units share the active part
    (`participation`).

    Returns
    -------
    complex array (sites, buses)
    """
    change = np.zeros((len(sites), len(network.bus)), dtype=complex)
    np.add.at(
        change.T, network.generator_index, np.repeat(participation(network)[:, None], len(sites), axis=1)
    )
    change[np.arange(len(sites)), network.indices(sites)] -= 1.0 + 1j * np.tan(np.arccos(pf))
    return change
