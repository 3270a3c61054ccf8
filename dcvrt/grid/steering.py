"""Steps of many power flows from one Jacobian."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from dcvrt.grid.switching import Limited

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]


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
        self.dense = isinstance(jacobian, np.ndarray)
        self._factors: Any = None
        inner = jacobian[:basic, :basic]
        if self.dense:
            inverse = np.linalg.inv(inner)
            self._inverse = inverse.astype(np.float32)
        else:
            self._factors = spla.splu(sp.csc_matrix(inner))
        self._column, self._row, self._schur = np.zeros((basic, 0)), np.zeros((0, basic)), np.zeros((0, 0))
        if jacobian.shape[0] > basic:
            outer, below, corner = (
                jacobian[:basic, basic:],
                jacobian[basic:, :basic],
                jacobian[basic:, basic:],
            )
            if self.dense:
                self._column, self._row = inverse @ outer, below @ inverse
            else:
                outer, below, corner = (np.asarray(m.toarray(), float) for m in (outer, below, corner))
                self._column = np.asarray(self._factors.solve(outer), dtype=np.float64)
                self._row = np.asarray(self._factors.solve(below.T.copy(), "T").T, dtype=np.float64)
            self._schur = corner - below @ self._column
        self._inverted: dict[bytes, Floats] = {}

    def step(self, rest: Floats, at_limit: Limited) -> Floats:
        """Step for residuals (rows, hours): angles, sizes at `pq`, sizes at `pv` buses (0 where held)."""
        n = self._column.shape[0]
        inner = self._solve(rest[:n])
        if not at_limit.any():
            return np.vstack([inner, np.zeros((len(self._schur), rest.shape[1]))])
        short = rest[n:] - self._row @ rest[:n]
        size = np.zeros_like(short)
        for buses, hours in same_sets(at_limit != 0):
            key = buses.tobytes()
            if key not in self._inverted:
                block = np.linalg.inv(self._schur[np.ix_(buses, buses)])
                self._inverted[key] = np.asarray(block, dtype=np.float64)
            size[np.ix_(buses, hours)] = self._inverted[key] @ short[np.ix_(buses, hours)]
        return np.vstack([inner - self._column @ size, size])

    def _solve(self, rest: Floats) -> Floats:
        if not self.dense:
            return np.asarray(self._factors.solve(np.ascontiguousarray(rest)))
        size = max(float(abs(rest).max(initial=0.0)), 1e-300)  # scaled: single precision underflows
        return np.asarray(size * (self._inverse @ (rest / size).astype(np.float32)), dtype=np.float64)


def same_sets(chosen: npt.NDArray[np.bool_]) -> list[tuple[Integers, Integers]]:
    """Sets of rows that occur in columns, each with its columns; columns without any are left out."""
    packed = np.ascontiguousarray(np.packbits(chosen, axis=0).T)
    code = packed.view(np.dtype((np.void, packed.shape[1]))).ravel()
    order = np.argsort(code, kind="stable")
    _, begin = np.unique(code[order], return_index=True)
    groups = np.split(order, begin[1:])
    sets = [(np.flatnonzero(chosen[:, hours[0]]), hours) for hours in groups]
    return [(buses, hours) for buses, hours in sets if len(buses)]
