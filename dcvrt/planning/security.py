r"""N-1 security: branch flows after the outage of any one branch, by line outage distribution factors.

.. math::
    f_{l|k} = f_l + L_{lk} f_k, \qquad
    L_{lk} = \frac{\varphi_{lk}}{1 - \varphi_{kk}}, \qquad L_{kk} = -1

with :math:`\varphi_{lk}` the DC flow on l per MW sent from one end of k to the other. Where the denominator
is zero the outage splits the network, and no factors exist.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dcvrt.errors import did_you_mean
from dcvrt.grid.network import Network

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

SPLITS = 1e-8
"""1 - phi_kk below which an outage counts as splitting the network."""


@dataclass(frozen=True)
class N1:
    """Which outages a plan must survive, and what branches may carry after one.

    No redispatch is assumed: the units give after the outage what they gave before.

    Parameters
    ----------
    emergency : float
        Factor on the rating that holds after an outage.
    outages : sequence of str or None
        Labels of the branches that may fail, such as `77-80`; parallel ones fail one at a time. None: all.
        Those that split the network are left out and reported as `plan.security.islanding`.
    """

    emergency: float = 1.0
    outages: Sequence[str] | None = None

    def faults(self, network: Network) -> list[str]:
        """What is wrong with these for a network, as sentences."""
        labels = [network.branches.label(k) for k in range(len(network.branches))]
        problems = [
            f"outage {label!r} is not a branch of {network.name}.{did_you_mean(label, labels)}"
            for label in self.outages or ()
            if label not in labels
        ]
        if not 0 < self.emergency < np.inf:
            problems.append(f"emergency is {self.emergency:g}; it must be a finite number above 0.")
        return problems


@dataclass(frozen=True)
class SecurityInfo:
    """What N-1 security covers in a plan.

    Parameters
    ----------
    emergency : float
        Factor on the ratings after an outage.
    outages : int
        Branches whose outage every hour survives.
    islanding : tuple of str
        Branches whose outage splits the network. They are not covered.
    pairs : int
        Pairs of branch and outage that entered a dispatch programme; all others were checked.
    """

    emergency: float
    outages: int
    islanding: tuple[str, ...]
    pairs: int


class Outages:
    """The outages of a network and their distribution factors.

    Parameters
    ----------
    network : Network
        Its ratings hold before an outage.
    rule : N1 or None
        None: no outages, so that every check below is empty.

    Attributes
    ----------
    branch : int array (outages,)
        Branch that fails.
    factors : array (branches, outages)
        L above.
    rating : array (branches,)
        Largest flow after an outage, MVA.
    islanding : tuple of str
    """

    def __init__(self, network: Network, rule: N1 | None) -> None:
        self.rule = rule
        lines = network.branches
        labels = [lines.label(k) for k in range(len(lines))]
        chosen = set(() if rule is None else labels if rule.outages is None else rule.outages)
        candidates = np.flatnonzero([label in chosen for label in labels])
        exchange = network.transfer(network.incidence[candidates].T.toarray())
        remaining = 1.0 - exchange[candidates, np.arange(len(candidates))]
        whole = remaining > SPLITS
        self.branch: Integers = candidates[whole]
        self.factors = exchange[:, whole] / remaining[whole]
        self.factors[self.branch, np.arange(len(self.branch))] = -1.0
        self.rating = lines.rating * (1.0 if rule is None else rule.emergency)
        self.islanding = tuple(labels[k] for k in candidates[~whole])

    def __len__(self) -> int:
        return len(self.branch)

    def over(self, flow: Floats) -> Floats:
        """MW beyond the emergency rating of each branch after each outage, for the flows before one."""
        return abs(flow[:, None] + self.factors * flow[self.branch]) - self.rating[:, None]

    def survived(self, flow: Floats, tolerance: float) -> npt.NDArray[np.bool_]:
        """Hours, columns of `flow` in MW, in which no outage overloads a branch by more than `tolerance`.

        Pairs that the largest flows of all hours cannot overload are passed over, which is exact.
        """
        good = np.ones(flow.shape[1], dtype=bool)
        if not len(self.branch) or not flow.shape[1]:
            return good
        largest = abs(flow).max(axis=1)
        possible = largest[:, None] + abs(self.factors) * largest[self.branch] > self.rating[:, None]
        for k in np.flatnonzero(possible.any(axis=0)):
            rows, hours = np.flatnonzero(possible[:, k]), np.flatnonzero(good)
            after = flow[np.ix_(rows, hours)] + np.outer(self.factors[rows, k], flow[self.branch[k], hours])
            good[hours] = (abs(after) <= self.rating[rows, None] + tolerance).all(axis=0)
        return good
