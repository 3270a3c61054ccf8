"""Voltage columns of a delimited table: what they may be called, and the phasor they hold."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dcvrt.delimited import read_table
from dcvrt.errors import InputError, raise_all
from dcvrt.samples import negative

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

TIME_NAMES = ("t", "time", "t_s", "time_s", "seconds")
MAGNITUDE_NAMES = ("v", "vm", "v_mag", "v_pu", "v_poi", "v_poi_pu", "magnitude", "voltage")
ANGLE_NAMES = ("angle", "angle_deg", "v_angle", "v_angle_deg", "v_deg")
PHASE_NAMES = (("v_a", "v_b", "v_c"), ("va", "vb", "vc"), ("v_l1", "v_l2", "v_l3"), ("l1", "l2", "l3"))


def columns(path: Path) -> dict[str, Array]:
    """Columns of a table with a header by name: lower case, without a unit in brackets."""
    table = read_table(path)
    if not table.header:
        raise InputError(f"{path}: the table has no header; name its columns, for example t,v_re,v_im.")
    names = [name.split("[")[0].split("(")[0].strip().lower() for name in table.header]
    return dict(zip(names, table.numbers(range(table.width)).T, strict=True))


def column(table: Mapping[str, Array], names: Sequence[str], where: str) -> Array:
    """Column that has one of the names.

    Raises
    ------
    InputError
        none has, with the columns found.
    """
    for name in names:
        if name in table:
            return table[name]
    raise InputError(
        f"{where} has no column {names[0]!r} (or {', '.join(names[1:])}). Found: {', '.join(table)}."
    )


def voltage(table: Mapping[str, Array], phases: str | None, where: str) -> ComplexArray:
    """Phasor in pu from its parts, from a magnitude with or without angle, or from three phases.

    Raises
    ------
    InputError
        three phases and no word on how to reduce them, a negative magnitude, no voltage column.
    """
    if "v_re" in table and "v_im" in table:
        return table["v_re"] + 1j * table["v_im"]
    for three in PHASE_NAMES:
        if all(name in table for name in three):
            if phases not in ("minimum", "mean"):
                raise InputError(
                    f"{where} has three phases {', '.join(three)}: say phases='minimum' or phases='mean'; "
                    "the model is positive-sequence."
                )
            stacked = np.stack([table[name] for name in three])
            return (stacked.min(axis=0) if phases == "minimum" else stacked.mean(axis=0)) + 0j
    for name in MAGNITUDE_NAMES:
        if name in table:
            raise_all(negative(table[name], name), where)
            angle = next((table[a] for a in ANGLE_NAMES if a in table), None)
            turn = np.zeros(len(table[name])) if angle is None else np.deg2rad(angle)
            return np.asarray(table[name] * np.exp(1j * turn), dtype=complex)
    raise InputError(
        f"{where} has no voltage column: v_re and v_im, or one of {', '.join(MAGNITUDE_NAMES)} "
        f"(with angle_deg), or v_a, v_b and v_c. Found: {', '.join(table)}."
    )
