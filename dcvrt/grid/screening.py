r"""Which faults a study should simulate: a screen of the voltage that every bus fault leaves at the sites.

With every machine a constant voltage behind r_a + j x and every load an impedance the network is linear, and
a fault at bus `f` is a rank-1 change of its admittance:

.. math:: V_i = V_i^0 - \frac{Z_{if}}{Z_{ff} + z_f}\, V_f^0, \qquad Z = (Y + Y_{load} + Y_{machines})^{-1}

With x_d'' this is the instant after inception: exactly what ANDES finds where x_d'' = x_q''. With x_d' it is
the voltage that is left once the subtransient currents have decayed: on the IEEE 118-bus case within 0.015 pu
of ANDES at clearing after 100 ms. The screen uses the latter.

A converter with rating ratio beta that gives active current priority imports at most min(1, beta |V|) of its
full load. It keeps the loss within the share lambda when |V| >= (1 - lambda)/beta, so that a fault asks of a
site

.. math:: \beta_{if} = (1 - \lambda) / |V_i|

This static law only ranks faults; whether a site rides through is decided by the dynamic simulation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from dcvrt.errors import InfeasibleError, raise_all
from dcvrt.grid.faults import BusFault
from dcvrt.grid.grid import Grid
from dcvrt.grid.period import Period

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]
Phasors = npt.NDArray[np.complex128]


def retained_voltage(admittance: sp.spmatrix, v0: Phasors, sites: Integers, z_f: complex = 1e-4j) -> Phasors:
    """Voltage at `sites` under a fault at each bus, machines being constant voltages.

    Parameters
    ----------
    admittance : sparse matrix (buses, buses)
        Of network, loads and machines, pu.
    v0 : complex array (buses,)
        Before the fault, pu.
    sites : int array
        Positions of the buses that are looked at.
    z_f : complex
        Fault impedance, pu.

    Returns
    -------
    complex array (buses, sites)
        Row `f` is the fault at bus `f`.
    """
    lu = spla.splu(sp.csc_matrix(admittance))
    z = lu.solve(np.eye(len(v0), dtype=complex))
    return np.asarray(v0[sites] - (z[sites] * (v0 / (np.diag(z) + z_f))).T)


@dataclass(frozen=True)
class ScreenRow:
    """What one bus fault does to the sites.

    Parameters
    ----------
    bus : int
        Faulted bus.
    retained : tuple of float
        Lowest retained voltage over the periods with nothing hosted, pu, in the order of the sites.
    limits : int
        Site with the lowest one.
    beta : tuple of float
        Rating ratio that the fault asks of each site.
    closes : tuple of int
        Sites that would need more than `beta_max`, whatever is hosted.
    chosen : str
        Why the fault is in the list, or empty.
    """

    bus: int
    retained: tuple[float, ...]
    limits: int
    beta: tuple[float, ...]
    closes: tuple[int, ...]
    chosen: str = ""


@dataclass(frozen=True)
class FaultScreen:
    """Outcome of `screen_faults`.

    Parameters
    ----------
    sites : tuple of int
    rows : tuple of ScreenRow
        Every bus that is no site, most severe first.
    faults : tuple of BusFault
        The list for a study, by bus number.
    rejected : dict of int to str
        Buses that the rule chose and whose simulation did not reach its end, with the status.
    rule : str
        The rule in words, for a report.
    """

    sites: tuple[int, ...]
    rows: tuple[ScreenRow, ...]
    faults: tuple[BusFault, ...]
    rejected: dict[int, str]
    rule: str

    def table(self) -> Any:
        """All rows as a pandas DataFrame."""
        import pandas as pd

        return pd.DataFrame(
            [
                {
                    "bus": row.bus,
                    **{f"v_{site}_pu": v for site, v in zip(self.sites, row.retained, strict=True)},
                    "limits": row.limits,
                    "beta": max(row.beta),
                    "closes": ", ".join(map(str, row.closes)),
                    "chosen": row.chosen,
                }
                for row in self.rows
            ]
        )


def screen_faults(
    grid: Grid,
    periods: Sequence[Period],
    loss_share: float = 0.25,
    beta: tuple[float, float] = (1.10, 1.35),
    beta_max: float = 1.5,
    count: int = 7,
    start: float = 0.1,
    clear: float = 0.1,
    x_f: float = 1e-4,
    confirm_until: float | None = 2.5,
) -> FaultScreen:
    """Choose bus faults so that the sites are limited by different faults at different rating ratios.

    1. A fault at a site, or one that asks more than `beta_max` of any site with nothing hosted, is left out:
       it would close that site whatever is built.
    2. Each remaining fault belongs to the site of which it asks most.
    3. As many targets as sites, evenly spaced over `beta`, from the lowest: among the sites without a
       limiting fault, take the fault that asks for a rating ratio nearest the target, but not more of an
       earlier site than that site has.
    4. Then milder faults up to `count`, in turn from the most limited site on: that which asks for a ratio
       nearest half way between 1 and the site's own, more than 1, and not more of any site than it has by
       step 3.

    Ties go to the lower bus number.

    Parameters
    ----------
    grid : Grid
    periods : sequence of Period
        The lowest retained voltage over all of them counts.
    loss_share : float
        Share of the import that may be lost, lambda.
    beta : tuple of two floats
        Lowest and highest target.
    beta_max : float
        Largest rating ratio of the study.
    count : int
        Length of the list.
    start, clear, x_f : float
        Of every fault; see `BusFault`.
    confirm_until : float or None
        Simulate the chosen faults in every period up to this time with nothing hosted, and choose again
        without a bus whose simulation fails. None: do not.

    Raises
    ------
    InputError
        Values out of range.
    InfeasibleError
        When some site has no fault that it could be limited by.
    """
    _check(periods, loss_share, beta, beta_max, count, len(grid.sites))
    rows = _rows(grid, periods, 1j * x_f, loss_share, beta_max)
    rejected: dict[int, str] = {}
    while True:
        chosen = _choose([row for row in rows if row.bus not in rejected], grid.sites, beta, count)
        faults = tuple(BusFault(bus, start, clear, x_f) for bus in sorted(chosen))
        failed = (
            {}
            if confirm_until is None
            else {
                fault.bus: run.status
                for period in periods
                for fault, run in grid.waveforms_of({}, period, faults, confirm_until).items()
                if not run.completed
            }
        )
        if not failed:
            break
        rejected |= failed
    rule = (
        f"Bus faults of {1e3 * clear:g} ms that leave (machines behind x_d') every site above "
        f"{(1 - loss_share) / beta_max:.3f} "
        "pu with nothing hosted; one "
        f"for each site whose static law asks for a rating ratio nearest {beta[0]:g} to {beta[1]:g}, "
        "evenly spaced, and milder "
        f"ones up to {count}; lowest retained voltage over {len(periods)} period(s)."
    )
    marked = tuple(
        ScreenRow(row.bus, row.retained, row.limits, row.beta, row.closes, chosen.get(row.bus, ""))
        for row in rows
    )
    return FaultScreen(grid.sites, marked, faults, rejected, rule)


def _check(
    periods: Sequence[Period],
    loss_share: float,
    beta: tuple[float, float],
    beta_max: float,
    count: int,
    sites: int,
) -> None:
    problems = []
    if not periods:
        problems.append("periods is empty: at least one is needed.")
    if not 0 <= loss_share < 1:
        problems.append(f"loss_share = {loss_share} must be at least 0 and below 1.")
    if not 0 < beta[0] <= beta[1] <= beta_max:
        problems.append(
            f"beta = {beta} and beta_max = {beta_max} must increase: lowest target, highest target, "
            "largest ratio."
        )
    if count < sites:
        problems.append(f"count = {count} is less than one fault for each of the {sites} sites.")
    raise_all(problems, "screen_faults")


def _rows(
    grid: Grid, periods: Sequence[Period], z_f: complex, loss_share: float, beta_max: float
) -> list[ScreenRow]:
    """Every bus that is no site, most severe first."""
    network = grid.network
    sites = network.indices(grid.sites)
    lowest = np.full((len(network.bus), len(sites)), np.inf)
    for period in periods:
        point = grid.operating_point({}, period)
        shunts = sp.diags(point.load_admittance() + point.machine_admittance("transient"))
        lowest = np.minimum(
            lowest, np.abs(retained_voltage(network.admittance() + shunts, point.v0, sites, z_f))
        )
    rows = []
    for k in np.lexsort((network.bus, lowest.min(axis=1))):
        if int(network.bus[k]) not in grid.sites:
            beta = tuple(((1 - loss_share) / np.maximum(lowest[k], 1e-9)).tolist())
            rows.append(
                ScreenRow(
                    int(network.bus[k]),
                    tuple(lowest[k].tolist()),
                    grid.sites[int(np.argmin(lowest[k]))],
                    beta,
                    tuple(site for site, b in zip(grid.sites, beta, strict=True) if b > beta_max),
                )
            )
    return rows


def _choose(
    rows: Sequence[ScreenRow], sites: tuple[int, ...], beta: tuple[float, float], count: int
) -> dict[int, str]:
    """Steps 2 to 4 of the rule: bus -> why it was chosen."""
    open_rows = [row for row in rows if not row.closes]
    chosen: dict[int, str] = {}
    ratio: dict[int, float] = {}
    for target in np.linspace(*beta, len(sites)):
        fits = [
            row
            for row in open_rows
            if row.limits not in ratio
            and row.bus not in chosen
            and all(row.beta[sites.index(site)] <= ratio[site] for site in ratio)
        ]
        if not fits:
            left = ", ".join(str(site) for site in sites if site not in ratio)
            raise InfeasibleError(
                f"screen_faults: no fault limits site {left} without asking more of the others. Way out: a "
                "wider "
                "range of beta, a larger beta_max, or faults of your own."
            )
        best = min(fits, key=lambda row: (abs(max(row.beta) - target), row.bus))
        ratio[best.limits] = max(best.beta)
        chosen[best.bus] = f"limits site {best.limits} at beta {max(best.beta):.2f}"
    within = [row for row in open_rows if all(row.beta[sites.index(site)] <= ratio[site] for site in sites)]
    while len(chosen) < count:
        found = False
        for site in sorted(ratio, key=lambda site: -ratio[site]):
            half = 0.5 * (1 + ratio[site])
            milder = [row for row in within if row.limits == site and 1 < max(row.beta) < ratio[site]]
            milder = [row for row in milder if row.bus not in chosen]
            if milder and len(chosen) < count:
                best = min(milder, key=lambda row: (abs(max(row.beta) - half), row.bus))
                chosen[best.bus] = f"milder fault at site {site}, beta {max(best.beta):.2f}"
                found = True
        if not found:
            break
    return chosen
