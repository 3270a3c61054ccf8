"""Samples where a signal turns a corner: between two samples a cubic would cut it off.

Limits and saturations are smoothed over widths far below the distance of samples. Where the slope of an
output changes much more in one interval than in its neighbours, the interval is integrated again with more
samples, and again inside, until what a cubic can miss of the corner is small.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dcvrt.integrators.run import Phase, Run

Array = NDArray[np.float64]
MISSED = 2e-5
"""What a cubic may miss of a corner, over the largest value of the output."""
SHARPER = 1.5
"""A corner is where the curvature is this many times that of both neighbouring intervals."""
POINTS = 8
LEVELS = 5


def outputs_with_corners(run: Run, phase: Phase) -> tuple[Array, Array, Array, list[Array]]:
    """Times, states, algebraic variables and outputs of a phase, with samples added at corners."""
    t: Array = np.concatenate(phase.t)
    X: Array = np.concatenate(phase.X)
    Z: Array = np.concatenate(phase.Z)
    piece = np.concatenate(phase.piece)
    outputs = run.model.on("outputs", t, X, Z, phase.P, run.inputs.C[piece])
    for _ in range(LEVELS):
        at = corners(t, outputs[0][:, :, 0], outputs[1][:, :, 0])
        if not len(at):
            break
        added = [run.between(phase.P, t[i], X[i], Z[i], t[i + 1], int(piece[i + 1]), POINTS) for i in at]
        place = np.repeat(at + 1, POINTS - 1)
        new_t, new_X, new_Z = (np.concatenate(part) for part in zip(*added, strict=True))
        new_piece = np.repeat(piece[at + 1], POINTS - 1)
        new = run.model.on("outputs", new_t, new_X, new_Z, phase.P, run.inputs.C[new_piece])
        t, piece = np.insert(t, place, new_t), np.insert(piece, place, new_piece)
        X, Z = np.insert(X, place, new_X, axis=0), np.insert(Z, place, new_Z, axis=0)
        outputs = [np.insert(old, place, extra, axis=0) for old, extra in zip(outputs, new, strict=True)]
    return t, X, Z, outputs


def corners(t: Array, y: Array, rate: Array) -> NDArray[np.int64]:
    """Intervals in which some column of `y` turns a corner that the cubic misses."""
    if len(t) < 3:
        return np.zeros(0, dtype=np.int64)
    h = np.diff(t)[:, None]
    turn = np.abs(np.diff(rate, axis=0))
    curvature = turn / h
    none = np.zeros((1, y.shape[1]))
    beside = np.maximum(np.vstack((none, curvature[:-1])), np.vstack((curvature[1:], none)))
    missed = turn * h / 8 > MISSED * np.maximum(np.abs(y).max(axis=0), 1e-3)
    return np.flatnonzero((missed & (curvature > SHARPER * beside)).any(axis=1))
