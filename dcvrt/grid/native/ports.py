r"""The network as its ports see it: impedances of a factored admittance matrix, faults as updates of rank
one.

With the units as source currents s at their ports, and all that is linear in the admittance matrix,

.. math:: V = Z s, \qquad Z = (Y + Y_{load} + Y_{unit})^{-1},

of which the columns of ports and the rows of ports and points are kept. A shunt y at bus f changes it to

.. math:: Z - \frac{z_{\cdot f}\, z_{f \cdot}}{Z_{ff} + 1/y}.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from dcvrt.grid.native.run import BLOCK, NetworkTable

Integers = npt.NDArray[np.int64]
Phasors = npt.NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class Ports:
    """Impedances of one topology at one operating point.

    Parameters
    ----------
    y : sparse complex matrix (buses, buses)
        Everything that is linear: lines, shunts, loads, what the network holds for the units.
    buses : int array
        Buses that ports or points stand at, each once.
    """

    y: sp.csc_matrix
    buses: Integers

    @cached_property
    def _factors(self) -> spla.SuperLU:
        return spla.splu(self.y)

    @cached_property
    def _transposed(self) -> spla.SuperLU:
        return spla.splu(self.y.T.tocsc())

    def columns(self, buses: Integers) -> Phasors:
        """Columns of Z (buses of the network, buses asked for)."""
        right = np.zeros((self.y.shape[0], len(buses)), dtype=complex)
        right[buses, np.arange(len(buses))] = 1.0
        return np.asarray(self._factors.solve(right), dtype=complex)

    def rows(self, buses: Integers) -> Phasors:
        """Rows of Z (buses asked for, buses of the network)."""
        right = np.zeros((self.y.shape[0], len(buses)), dtype=complex)
        right[buses, np.arange(len(buses))] = 1.0
        return np.asarray(self._transposed.solve(right), dtype=complex).T

    @cached_property
    def from_ports(self) -> Phasors:
        """Z (all buses, `buses`)."""
        return self.columns(self.buses)

    @cached_property
    def to_ports(self) -> Phasors:
        """Z (`buses`, all buses)."""
        return self.rows(self.buses)

    def impedances(
        self, shunts: dict[int, complex], dy: Phasors | None = None
    ) -> tuple[Phasors, Sequence[Phasors]]:
        """Z between `buses` with fault shunts, and its derivatives.

        Parameters
        ----------
        shunts : mapping of bus position to admittance, pu
        dy : complex array (buses, parameters), optional
            Derivatives of the diagonal of the admittance matrix.

        Returns
        -------
        z : complex array (len(buses), len(buses))
        dz : list of the same, one a parameter
        """
        right = self.from_ports
        left = self.to_ports if dy is not None else None
        if shunts:
            at = np.array(list(shunts), dtype=np.int64)
            z_f = np.diag(1.0 / np.array(list(shunts.values())))
            column, row = self.columns(at), self.rows(at)
            small = np.linalg.inv(column[at] + z_f)
            right = right - column @ (small @ right[at])
            if left is not None:
                left = left - (column[self.buses] @ small) @ row
        z = right[self.buses]
        if dy is None or left is None:
            return z, []
        moved = [k for k in range(dy.shape[1]) if dy[:, k].any()]
        dz: list[Phasors] = [np.zeros((0, 0), dtype=complex)] * dy.shape[1]
        for k in moved:
            own = np.flatnonzero(dy[:, k])
            dz[k] = -(left[:, own] * dy[own, k]) @ right[own]
        return z, dz


def table(z: Phasors, dz: Sequence[Phasors], units: Integers, points: Integers) -> NetworkTable:
    """Impedances as the engine reads them.

    Parameters
    ----------
    z, dz : between the buses of `Ports`
    units, points : int arrays
        Position among those buses of every unit and point.
    """
    filled = np.zeros(-(-len(units) // BLOCK) * BLOCK + -(-len(points) // BLOCK) * BLOCK, dtype=np.int64)
    filled[: len(units)] = units
    filled[-(-len(units) // BLOCK) * BLOCK :][: len(points)] = points

    def spread(m: Phasors) -> Phasors:
        return np.asarray(m[filled[:, None], units])

    return NetworkTable(spread(z), [spread(d) if d.size else None for d in dz])
