r"""What a plan has to meet under every fault in every period, as margins that a search can cut with.

Two requirements are told apart by who bears the risk. `EverySite`: each open site meets its own criteria,

.. math::
    V^{IT}_i - V_{min} \ge 0, \qquad \lambda - s_i \ge 0 \qquad\text{for every open site } i.

`SystemLimit`: what drops off the grid at once stays within what the system can stand,

.. math::
    L = \sum_i d H_i s_i \;\le\; \ell + \lambda_{sys} P, \qquad P = \sum_i d H_i,

with s_i the lost share of the import of site i, d the data-centre factor of the period and P the load before
the fault. Single sites may then fail.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from dcvrt.errors import raise_all
from dcvrt.planning.exact import TARGETS, Exact, Place

Floats = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
UNITS = {"voltage": "pu", "loss": "share of load"}


@dataclass(frozen=True, eq=False)
class Margins:
    """Margins of a requirement under one fault, in one period, at one hosting vector, positive where met.

    Attributes
    ----------
    at : what was simulated.
    requirement : what these are the margins of.
    value : array (margins,)
        In the units of the requirement; NaN where a run that decides it has no result.
    slope : array (margins, sites)
        Total derivative by every H_j, per MW.
    by_beta : array (margins,)
        Derivative by the rating ratio.
    size : array (margins,)
        What tolerances of a margin are shares of: 1 for a margin of one site; the load P before the fault,
        MW, for the loss of all of them.
    size_slope : array (margins, sites)
        Its derivative by every H_j; size is affine in H.
    words : tuple of str
        How each site came through: margins of different words do not lie on one smooth surface.
    unknown : bool array (sites,)
        Sites that cannot be open as far as this point tells.
    """

    at: Exact
    requirement: Requirement
    value: Floats
    slope: Floats
    by_beta: Floats
    size: Floats
    size_slope: Floats
    words: tuple[str, ...]
    unknown: Flags

    @property
    def H(self) -> Floats:
        """Hosted capacities, MW."""
        return self.at.H

    @property
    def place(self) -> Place:
        """Period and fault."""
        return self.at.place

    def linear(self, H: Floats) -> Floats:
        """First-order prediction of the margins at another hosting vector."""
        return np.asarray(self.value + self.slope @ (H - self.H))

    def size_at(self, H: Floats) -> Floats:
        """What tolerances are shares of at another hosting vector."""
        return np.asarray(self.size + self.size_slope @ (H - self.H))

    def missed(self, need: Floats | float = 0.0) -> list[int]:
        """Margins that count here and are below a share of their size; one without a value is."""
        met = self.value >= need * self.size
        return np.flatnonzero(self.requirement.counts(self.H) & ~met).tolist()

    def same_course(self, other: Margins, number: int) -> bool:
        """Whether all sites that decide a margin came through two points in the same way."""
        return all(self.words[i] == other.words[i] for i in self.requirement.involved(number))


class Requirement(ABC):
    """What a plan has to meet, as a number of margins under each fault in each period.

    Attributes
    ----------
    sites : candidate buses.
    name : what reports call it.
    owners : the position of the site that each margin belongs to, which counts only while that site is open;
        None for one of the system as a whole, which always counts and is met where nothing is hosted.
    """

    sites: tuple[int, ...]
    name: str
    owners: tuple[int | None, ...]

    @abstractmethod
    def margins(self, one: Exact) -> Margins:
        """The margins of what was simulated."""

    @abstractmethod
    def label(self, number: int) -> str:
        """What reports call a margin."""

    @abstractmethod
    def target(self, number: int) -> str:
        """`voltage`, `loss` or `aggregate loss`."""

    @abstractmethod
    def unit(self, number: int) -> str:
        """Unit of a margin."""

    def involved(self, number: int) -> tuple[int, ...]:
        """Positions of the sites whose runs decide a margin."""
        owner = self.owners[number]
        return tuple(range(len(self.sites))) if owner is None else (owner,)

    def counts(self, H: Floats) -> Flags:
        """Margins that a hosting vector has to meet, (margins,)."""
        return np.array([owner is None or H[owner] > 0 for owner in self.owners])


@dataclass(frozen=True, eq=False)
class EverySite(Requirement):
    """Every open site meets its own criteria: the IT voltage in pu, the loss as a share of its import.

    Parameters
    ----------
    sites : candidate buses.
    """

    sites: tuple[int, ...]
    name = "every site"

    @cached_property
    def owners(self) -> tuple[int | None, ...]:  # type: ignore[override]
        """Two margins a site, in the order of the sites."""
        return tuple(site for site in range(len(self.sites)) for _ in TARGETS)

    def margins(self, one: Exact) -> Margins:
        """Voltage and loss margin of every site, site by site."""
        n = len(self.sites)
        m = n * len(TARGETS)
        return Margins(
            one,
            self,
            one.value.reshape(m),
            one.slope.reshape(m, n),
            one.by_beta.reshape(m),
            np.ones(m),
            np.zeros((m, n)),
            tuple(map(_course, one.sequence, one.status)),
            np.asarray(np.isnan(one.value).any(axis=1)),
        )

    def label(self, number: int) -> str:
        """For instance 'loss at bus 75'."""
        return f"{self.target(number)} at bus {self.sites[number // len(TARGETS)]}"

    def target(self, number: int) -> str:
        """`voltage` or `loss`."""
        return TARGETS[number % len(TARGETS)]

    def unit(self, number: int) -> str:
        """Pu or share of load."""
        return UNITS[self.target(number)]


@dataclass(frozen=True, eq=False)
class SystemLimit(Requirement):
    r"""The load that drops off at once in one fault stays within a limit; single sites may fail.

    .. math::
        m(H) = \ell + \lambda_{sys} P - L, \qquad L = \sum_i d H_i s_i, \qquad
        \frac{\partial L}{\partial H_j} = d s_j + \sum_i d H_i \frac{\partial s_i}{\partial H_j}

    in MW. A site counts as lost whole (s_i = 1) when its run ended before its time, or when its IT voltage
    stays below what keeps servers running: they drop off, whatever the converter still draws. One that visits
    BATTERY loses all by its own share. There L jumps, and the gradient, which holds within the sequence of
    modes of all sites together, says nothing of it. A site without a waveform, or without an equilibrium
    before the fault, is no load that could be lost: it cannot be open.

    Parameters
    ----------
    sites : candidate buses.
    d : data-centre factor by period.
    mw : loss that is allowed, MW.
    share : loss that is allowed, as a share of the load before the fault; adds to `mw`.

    Raises
    ------
    InputError
        For a limit that is negative or not finite, or a share above 1.

    Examples
    --------
    >>> SystemLimit((21, 75), {"peak": 1.0}, mw=50.0).name
    '50 MW'
    >>> SystemLimit((21, 75), {"peak": 1.0}, share=0.1).name
    '10 % of the load'
    """

    sites: tuple[int, ...]
    d: Mapping[str, float]
    mw: float = 0.0
    share: float = 0.0
    owners = (None,)

    def __post_init__(self) -> None:
        problems = []
        if not 0 <= self.mw < np.inf:
            problems.append(f"mw = {self.mw:g} must be finite and at least 0.")
        if not 0 <= self.share <= 1:
            problems.append(f"share = {self.share:g} must lie in [0, 1].")
        raise_all(problems, "system limit")

    @property
    def name(self) -> str:  # type: ignore[override]
        """The limit in words."""
        parts = [f"{self.mw:g} MW"] if self.mw or not self.share else []
        parts += [f"{100 * self.share:g} % of the load"] if self.share else []
        return " and ".join(parts)

    def margins(self, one: Exact) -> Margins:
        """What is left of the limit, MW."""
        H, d, n = one.H, self.d[one.place[0]], len(self.sites)
        whole = lost_whole(one)
        share = np.where(whole, 1.0, one.loss)
        share_slope = np.where(whole[:, None], 0.0, -one.slope[:, 1])
        is_open = H > 0
        # Nothing is known of a site without a load: it adds nothing while closed, and all of it once open.
        own = np.where(np.isnan(share), 1.0, share)
        slope = d * own + d * H[is_open] @ share_slope[is_open]
        faster = np.where(whole, 0.0, one.by_beta[:, 1])
        before = d * float(H.sum())
        return Margins(
            one,
            self,
            np.array([self.mw + self.share * before - d * float(H[is_open] @ share[is_open])]),
            (self.share * d - slope)[None],
            np.array([d * float(H[is_open] @ faster[is_open])]),
            np.array([before]),
            np.full((1, n), d),
            tuple(map(_course, one.sequence, one.status, whole.tolist())),
            np.isnan(share),
        )

    def label(self, number: int) -> str:
        """'loss of all sites'."""
        return "loss of all sites"

    def target(self, number: int) -> str:
        """'aggregate loss'."""
        return "aggregate loss"

    def unit(self, number: int) -> str:
        """MW."""
        return "MW"


def lost_whole(one: Exact) -> Flags:
    """Sites that drop off altogether: the run ended before its time, or the IT voltage is not held."""
    return np.asarray(np.isfinite(one.loss) & ~(one.value[:, 0] >= 0))


def _course(sequence: str, status: str, gone: bool = False) -> str:
    """How a site came through: its modes, what took it away, or why it has no result."""
    if gone:
        return f"{sequence}, lost with its IT voltage" if sequence else "lost as its run ended"
    return sequence or status
