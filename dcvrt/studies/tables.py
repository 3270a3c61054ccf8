"""Tables that a study reads and writes as CSV."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from dcvrt.delimited import read_table
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
    table = read_table(path)
    header = table.header
    if not header:
        raise InputError(
            f"{path}: the table has no header; its columns are hour, load, dc and wind_<bus>_mw."
        )
    needed = ["hour", "load", "dc"]
    problems = [f"no column {name!r}. It has: {', '.join(header)}." for name in needed if name not in header]
    problems += [
        f"column {name!r} is none of hour, load, dc, wind_<bus>_mw."
        for name in header
        if name not in needed and not WIND.fullmatch(name)
    ]
    raise_all(problems, str(path))
    columns = dict(zip(header, table.numbers(range(table.width)).T, strict=True))
    if (columns["hour"] != np.round(columns["hour"])).any():
        raise InputError(f"{path}: column 'hour' must hold whole numbers.")
    wind = {int(found[1]): columns[name] for name in header if (found := WIND.fullmatch(name))}
    return Year(
        hours=columns["hour"].astype(np.int64),
        load=columns["load"],
        dc=columns["dc"],
        wind=wind,
        sources=dict.fromkeys(("load", "dc", "wind"), path.name),
    )
