"""Reader of MATPOWER case files, version 2: the tables `bus`, `gen` and `branch` as arrays."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from dcvrt.errors import InputError, raise_all

BUS_NUMBER, BUS_TYPE, BUS_P, BUS_Q, BUS_G, BUS_B, BUS_ANGLE, BUS_BASE_KV = 0, 1, 2, 3, 4, 5, 8, 9
GEN_BUS, GEN_P, GEN_Q_MAX, GEN_Q_MIN, GEN_VOLTAGE, GEN_STATUS, GEN_P_MAX, GEN_P_MIN = 0, 1, 3, 4, 5, 7, 8, 9
BRANCH_R, BRANCH_X, BRANCH_B, BRANCH_RATING, BRANCH_TAP, BRANCH_SHIFT, BRANCH_STATUS = 2, 3, 4, 5, 8, 9, 10
PV, SLACK, ISOLATED = 2, 3, 4
COLUMNS = {"bus": 13, "gen": 10, "branch": 11}
"""Columns that each table must have; more are allowed."""


@dataclass(frozen=True)
class Case:
    """Tables of a case file as they stand there; the column numbers are the constants of this module."""

    base_mva: float
    bus: npt.NDArray[np.float64]
    gen: npt.NDArray[np.float64]
    branch: npt.NDArray[np.float64]


def read(path: Path) -> Case:
    """Read a case file.

    Raises
    ------
    InputError
        Naming every table that is missing or unreadable, with the first bad line of each.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file. Way out: give the path of a MATPOWER case (.m).")
    lines = [line.split("%", 1)[0].rstrip() for line in path.read_text(errors="replace").splitlines()]
    text = "\n".join(lines)
    problems: list[str] = []
    base = re.search(r"mpc\.baseMVA\s*=\s*([-+.\deE]+)", text)
    if base is None or float(base.group(1)) <= 0:
        problems.append("has no positive mpc.baseMVA.")
    version = re.search(r"mpc\.version\s*=\s*'(\w+)'", text)
    if version is None or version.group(1) != "2":
        problems.append(
            "is not a version 2 case (mpc.version = '2'). "
            "Way out: convert it with MATPOWER's loadcase and savecase."
        )
    tables = {name: _table(text, name, problems) for name in COLUMNS}
    raise_all(problems, str(path))
    assert base is not None
    return Case(float(base.group(1)), tables["bus"], tables["gen"], tables["branch"])


def _table(text: str, name: str, problems: list[str]) -> npt.NDArray[np.float64]:
    """One table; what is wrong with it is appended to `problems`."""
    nothing = np.zeros((0, COLUMNS[name]))
    found = re.search(rf"mpc\.{name}\s*=\s*\[(.*?)\]", text, re.DOTALL)
    if found is None:
        problems.append(f"has no table mpc.{name}.")
        return nothing
    first_line = text.count("\n", 0, found.start(1)) + 1
    rows: list[list[float]] = []
    for offset, line in enumerate(found.group(1).split("\n")):
        for part in filter(str.strip, line.split(";")):
            where = f"line {first_line + offset}: mpc.{name}"
            try:
                row = [float(word) for word in part.replace(",", " ").split()]
            except ValueError:
                problems.append(f"{where} has a word that is not a number: {part.strip()!r}.")
                return nothing
            if len(row) < COLUMNS[name] or (rows and len(row) != len(rows[0])):
                want = len(rows[0]) if rows else COLUMNS[name]
                problems.append(
                    f"{where} has {len(row)} columns, expected {'' if rows else 'at least '}{want}."
                )
                return nothing
            rows.append(row)
    if not rows:
        problems.append(f"table mpc.{name} is empty.")
        return nothing
    return np.array(rows)
