"""Steps of many power flows from one Jacobian."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
import scipy.sparse.linalg as spla

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]
Sets = list[tuple[Integers, Integers]]
"""Sets of `pv` buses at a limit, each with the columns in which it is at one."""


class Steering:
    """Approximate Newton steps of many hours from one Jacobian: it only steers, residuals are exact.

    With unit limits enforced the Jacobian is kept in blocks, so that every hour can have its own buses that
    hold Q instead of their voltage: of the rows and columns of those the Schur complement is inverted, once
    for each set of buses that occurs.

    Parameters
    ----------
    jacobian : matrix
        By angles of `free`, sizes of `pq`, then sizes of `pv` buses; rows P of `free`, Q of `pq`, Q of `pv`.
    basic : int
        Rows and columns without the `pv` part.
    """

    def __init__(self, jacobian: Any, basic: int) -> None:
        inner = jacobian[:basic, :basic]
        outer, below, corner = jacobian[:basic, basic:], jacobian[basic:, :basic], jacobian[basic:, basic:]
        self._basic = basic
        self._first: Any = None
        self._factors: Any = None
        if isinstance(jacobian, np.ndarray):  # single precision is enough to steer
            inverse = np.linalg.inv(inner)
            column = inverse @ outer
            self._first = np.vstack([inverse, -below @ inverse]).astype(np.float32)
            self._column = column.astype(np.float32)
        else:
            self._factors = spla.splu(sp.csc_matrix(inner))
            outer, below, corner = (np.asarray(m.toarray(), float) for m in (outer, below, corner))
            self._column = column = np.asarray(self._factors.solve(outer), dtype=np.float64)
            self._below = below
        self._schur = corner - below @ column
        self._inverted: dict[bytes, Floats] = {}

    def step(self, rest: Floats, at_limit: Sets) -> Floats:
        """Step for residuals (rows, hours): angles, sizes at `pq`, sizes at `pv` buses (0 where held).

        `at_limit` are the `pv` buses at a limit, as `same_sets` gives them.
        """
        n = self._basic
        largest = max(float(abs(rest).max(initial=0.0)), 1e-300)  # scaled: single precision underflows
        if self._factors is None:
            found = self._first @ (rest[:n] / largest).astype(np.float32)
        else:
            inner = self._factors.solve(rest[:n] / largest)
            found = np.vstack([inner, -self._below @ inner])
        size = found[n:]  # of the rows of `pv` buses: what is left of their residuals once the others are met
        short = size + rest[n:] / largest if at_limit else size
        size[:] = 0.0
        for buses, hours in at_limit:
            if len(hours) == rest.shape[1]:
                size[buses] = self._inverse(buses) @ short[buses]
            else:
                at = np.ix_(buses, hours)
                size[at] = self._inverse(buses) @ short[at]
        if at_limit:
            used = np.unique(np.concatenate([buses for buses, _ in at_limit]))
            found[:n] -= self._column[:, used] @ size[used]
        return np.multiply(found, largest, dtype=np.float64)

    def _inverse(self, buses: Integers) -> Floats:
        """Inverse of the Schur complement of some `pv` buses."""
        key = buses.tobytes()
        if key not in self._inverted:
            block = np.linalg.inv(self._schur[np.ix_(buses, buses)])
            self._inverted[key] = np.asarray(block, dtype=self._column.dtype)
        return self._inverted[key]


def same_sets(chosen: npt.NDArray[np.bool_]) -> Sets:
    """Sets of rows that occur in columns, each with its columns; columns without any are left out."""
    if not chosen.any():
        return []
    packed = np.packbits(chosen, axis=0)
    words = np.zeros((-(-len(packed) // 8) * 8, packed.shape[1]), dtype=np.uint8)
    words[: len(packed)] = packed
    code = np.ascontiguousarray(words.T).view(np.uint64)
    order = np.lexsort(code.T)
    same = (code[order[1:]] == code[order[:-1]]).all(axis=1)
    groups = np.split(order, np.flatnonzero(~same) + 1)
    sets = [(np.flatnonzero(chosen[:, hours[0]]), hours) for hours in groups]
    return [(buses, hours) for buses, hours in sets if len(buses)]
