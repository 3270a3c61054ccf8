"""Inputs of a run as one table of pieces: on each every input is a cubic of time; between some they jump."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dcvrt.errors import InputError, did_you_mean
from dcvrt.integrators.equations import Equations
from dcvrt.waveform import Pieces, Waveform, check_samples, cubic_pieces

Array = NDArray[np.float64]
Inputs = Mapping[str, tuple[ArrayLike, ArrayLike]]
SAME_TIME = 1e-10
"""Breakpoints of different inputs that are closer than this, s, are one."""


@dataclass(frozen=True, eq=False)
class Channels:
    """Pieces of all inputs.

    Attributes
    ----------
    start, length : of each piece, s.
    C : row k holds start, length and the coefficients of every input, then of every tangent, over piece k.
    sections : number of the first piece of every section; sections are joined by jumps.
    first : value of every input before the first jump, for the equilibrium.
    first_tangent : its derivative by every theta (not scaled).
    """

    start: Array
    length: Array
    C: Array
    sections: NDArray[np.int64]
    first: Array
    first_tangent: Array


def channels(equations: Equations, waveform: Waveform, inputs: Inputs | None) -> Channels:
    """Lay the POI voltage and the other inputs on common pieces.

    Raises
    ------
    InputError
        an unknown input, unusable samples, samples that do not cover the waveform, a `wrt` that neither the
        system nor the waveform knows.
    """
    dae = equations.dae
    given = _checked(equations, waveform, dict(inputs or {}))
    pieces: dict[int, Pieces] = {}
    first = np.array([row.value for row in dae.inputs], dtype=float)
    if equations.voltage is not None:
        voltage = waveform.pieces()
        re, im = equations.voltage
        pieces[re], pieces[im] = _part(voltage, np.real), _part(voltage, np.imag)
        first[re], first[im] = waveform.v[0].real, waveform.v[0].imag
    else:
        voltage = cubic_pieces(waveform.t, np.zeros(len(waveform.t)))
    for name, (t, values) in given.items():
        k = dae.u_names.index(name)
        pieces[k] = cubic_pieces(t, values)
        first[k] = pieces[k].at(waveform.start)
    start, length, after_jump = _common(voltage, list(pieces.values()))
    C = np.zeros((len(start), 2 + equations.n_coefficients))
    C[:, 0], C[:, 1] = start, length
    for k in range(equations.nu):
        columns = slice(2 + 4 * k, 6 + 4 * k)
        if k in pieces:
            C[:, columns] = pieces[k].on(start, length)
        else:
            C[:, 2 + 4 * k] = first[k]
    first_tangent = _tangents(equations, waveform, start, length, C)
    sections = np.concatenate(([0], np.flatnonzero(after_jump[1:]) + 1))
    return Channels(start, length, C, sections, first, first_tangent)


def _checked(
    equations: Equations, waveform: Waveform, inputs: dict[str, Any]
) -> dict[str, tuple[Array, Array]]:
    dae, driven = equations.dae, equations.voltage or ()
    free = [n for k, n in enumerate(dae.u_names) if k not in driven]
    result = {}
    for name, samples in inputs.items():
        if name not in free:
            raise InputError(f"{dae.name} has no free input {name!r}.{did_you_mean(name, free)}")
        t, values = (np.asarray(part, dtype=float) for part in samples)
        problems = check_samples(t, values, "values")
        if not problems and (t[0] > waveform.start + SAME_TIME or t[-1] < waveform.until - SAME_TIME):
            problems = [
                f"it covers {t[0]:g} to {t[-1]:g} s, "
                f"the waveform {waveform.start:g} to {waveform.until:g} s; give samples for the whole run."
            ]
        if problems:
            raise InputError(f"input {name!r}: " + "\n".join(problems))
        result[name] = (t, values)
    return result


def _part(pieces: Pieces, take: Any) -> Pieces:
    return Pieces(pieces.start, pieces.length, take(pieces.coefficients), pieces.after_jump)


def _common(base: Pieces, others: list[Pieces]) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Breakpoints of all pieces within the span of `base`, and where something jumps."""
    end = base.start[-1] + base.length[-1]
    known = np.append(base.start, end)
    jumps = [base.start[base.after_jump]]
    points = [known]
    for other in others:
        near = np.clip(np.searchsorted(known, other.start), 1, len(known) - 1)
        left, right = known[near - 1], known[near]
        snapped = np.where(np.abs(other.start - left) < SAME_TIME, left, other.start)
        snapped = np.where(np.abs(other.start - right) < SAME_TIME, right, snapped)
        points.append(snapped[(snapped > known[0]) & (snapped < end)])
        jumps.append(snapped[other.after_jump])
    all_points = np.unique(np.concatenate(points))
    start = all_points[:-1]
    return start, np.diff(all_points), np.isin(start, np.concatenate(jumps))


def _tangents(equations: Equations, waveform: Waveform, start: Array, length: Array, C: Array) -> Array:
    first = np.zeros((equations.nu, equations.nw))
    unknown = [c.name for c in equations.columns if c.parameter is None and c.name not in waveform.tangents]
    if unknown:
        known = [*equations.dae.p_names, *waveform.tangents]
        raise InputError(
            "\n".join(
                f"wrt: {name!r} is neither a parameter of {equations.dae.name} nor a tangent of the waveform."
                f"{did_you_mean(name, known)}"
                for name in unknown
            )
        )
    if not equations.tangents or equations.voltage is None:
        return first
    for j, column in enumerate(equations.columns):
        if column.name not in waveform.tangents:
            continue
        pieces = waveform.pieces(column.name)
        on_pieces = pieces.on(start, length) * column.scale
        for part, (k, take) in enumerate(zip(equations.voltage, (np.real, np.imag), strict=True)):
            at = 2 + 4 * (equations.nu + 2 * j + part)
            C[:, at : at + 4] = take(on_pieces)
            first[k, j] = take(waveform.tangents[column.name][0])
    return first
