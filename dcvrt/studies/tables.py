"""Tables that a study reads and writes as CSV."""

from __future__ import annotations

import csv
import re
from pathlib import Path

import numpy as np

from dcvrt.errors import InputError, raise_all
from dcvrt.planning.profiles import Year

WIND = re.compile(r"wind_(\d+)_mw")


def read_profiles(path: Path) -> Year:
    """Operating hours from a CSV with the columns `hour`, `load`, `dc` and `wind_<bus>_mw` for each wind bus.

    Raises
    ------
    InputError
        With every problem at once: missing columns, cells that are not numbers, values out of range.
    """
    if not path.is_file():
        raise InputError(f"{path.name}: no such file.")
    with path.open(newline="", encoding="utf-8-sig") as file:
        rows = list(csv.reader(file))
    if not rows:
        raise InputError(f"{path.name}: is empty.")
    header = [name.strip() for name in rows[0]]
    needed = ["hour", "load", "dc"]
    problems = [f"no column {name!r}. It has: {', '.join(header)}." for name in needed if name not in header]
    problems += [
        f"column {name!r} is none of hour, load, dc, wind_<bus>_mw."
        for name in header
        if name not in needed and not WIND.fullmatch(name)
    ]
    problems += [
        f"line {k} has {len(row)} cells, the header has {len(header)}."
        for k, row in enumerate(rows[1:], start=2)
        if len(row) != len(header)
    ][:3]
    raise_all(problems, path.name)
    columns = {}
    for c, name in enumerate(header):
        try:
            columns[name] = np.array([float(row[c]) for row in rows[1:]])
        except ValueError as error:
            problems.append(f"column {name!r}: {error}.")
    raise_all(problems, path.name)
    if (columns["hour"] != np.round(columns["hour"])).any():
        raise InputError(f"{path.name}: column 'hour' must hold whole numbers.")
    wind = {int(found[1]): columns[name] for name in header if (found := WIND.fullmatch(name))}
    return Year(
        hours=columns["hour"].astype(np.int64),
        load=columns["load"],
        dc=columns["dc"],
        wind=wind,
        sources=dict.fromkeys(("load", "dc", "wind"), path.name),
    )
