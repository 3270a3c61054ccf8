"""Delimited tables of numbers, as instruments and offices write them."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dcvrt.errors import InputError, raise_all

SHOWN = 10
"""Most problems of one table that are listed."""


@dataclass(frozen=True)
class Table:
    """Cells of a file below its header.

    Attributes
    ----------
    path : the file.
    header : names of the columns as written; empty when the file has none.
    rows, lines : cells of every row, and the line of the file that it stands in.
    width : number of columns.
    decimal_comma : whether ``0,5`` is a half.
    """

    path: Path
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    lines: NDArray[np.int64]
    width: int
    decimal_comma: bool

    def numbers(self, columns: Sequence[int]) -> NDArray[np.float64]:
        """Columns by number as floats, (rows, columns).

        Raises
        ------
        InputError
            cells that are not numbers, with line and column.
        """
        problems, values = [], []
        for line, row in zip(self.lines.tolist(), self.rows, strict=True):
            cells = [row[k] for k in columns]
            found = [number(cell, self.decimal_comma) for cell in cells]
            values.append([np.nan if value is None else value for value in found])
            problems += [
                f"line {line}, column {self.header[k] if self.header else k!r}: {cell!r} is not a number."
                for k, cell, value in zip(columns, cells, found, strict=True)
                if value is None
            ]
        raise_all(problems[:SHOWN], str(self.path))
        return np.array(values, dtype=float).reshape(len(self.rows), len(columns))


def number(cell: str, decimal_comma: bool) -> float | None:
    """Value of a cell, None when it is not a number."""
    try:
        return float(cell.strip().replace(",", ".") if decimal_comma else cell.strip())
    except ValueError:
        return None


def read_table(path: Path) -> Table:
    """Read a table separated by ``;``, tabs or ``,``.

    A byte-order mark, a decimal comma (unless the comma separates), empty lines, lines that begin with ``#``,
    and narrower lines above the table are understood. The first line as wide as the table is the header,
    unless one of its cells is a number: then there is none.

    Raises
    ------
    InputError
        no such file, not text, no line with two columns or more, rows of different width.
    """
    if not path.is_file():
        raise InputError(f"{path}: there is no such file.")
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read as text: {error}.") from None
    separator = next((s for s in (";", "\t", ",") if s in text), ",")
    decimal_comma = separator != "," and "," in text
    rows = [
        (line, tuple(cell.strip() for cell in row))
        for line, row in enumerate(csv.reader(io.StringIO(text), delimiter=separator), 1)
        if any(cell.strip() for cell in row) and not row[0].startswith("#")
    ]
    width = max((len(row) for _, row in rows), default=0)
    if width < 2:
        raise InputError(f"{path}: no line has two columns or more.")
    begin = next(k for k, (_, row) in enumerate(rows) if len(row) == width)
    header = rows[begin][1]
    if any(number(cell, decimal_comma) is not None for cell in header):
        header = ()
    body = rows[begin + bool(header) :]
    ragged = [
        f"line {line} has {len(row)} cells, the table {width}." for line, row in body if len(row) != width
    ]
    raise_all(ragged[:SHOWN], str(path))
    return Table(
        path=path,
        header=header,
        rows=tuple(row for _, row in body),
        lines=np.array([line for line, _ in body], dtype=np.int64),
        width=width,
        decimal_comma=decimal_comma,
    )
