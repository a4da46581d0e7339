"""Tables of comma-separated numbers, with or without a line of names, and with or without gaps."""

from __future__ import annotations

import csv
import os
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import DataError, brief, listing, repeats
from brainbench.core.reading.regular import MOST_TABLE, readable
from brainbench.core.reading.texts import read_text


def read_rows(path: str | os.PathLike[str], kind: str) -> list[list[str]]:
    """Return the cells of a comma-separated file; lines without any are left out."""
    return [row for row in _rows(path, kind) if any(row)]


def read_columns(
    path: str | os.PathLike[str], kind: str, *, gaps: bool = False
) -> tuple[list[str], NDArray[np.float64]]:
    """Return the names in the first line of a comma-separated file, and the numbers [line, column] below.

    With ``gaps`` cells may be empty, ``na`` or ``nan``, which are NaN; lines without any are left out.
    """
    header, *rows = (read_rows(path, kind) if gaps else _trimmed(path, kind)) or [[]]
    if twice := repeats(filter(None, header)):
        raise DataError(f"{brief(os.fspath(path))} has several columns {listing(twice, limit=4)}; a name stands once.")
    table = to_numbers(rows, path, kind, first=2, columns=len(header), gaps=gaps)
    if not gaps and not np.isfinite(table).all():
        row, column = np.argwhere(~np.isfinite(table))[0]
        raise DataError(
            f"{brief(os.fspath(path))}: {brief(header[column])} in row {row + 2} is {table[row, column]}; a finite "
            "number is needed."
        )
    return header, table


def read_numbers(path: str | os.PathLike[str], kind: str = "table of comma-separated numbers") -> NDArray[np.float64]:
    """Return the numbers [line, column] of a comma-separated file; lines may end with a comma.

    NaN and infinity are numbers here: some tables have gaps, and their readers say what these mean.
    """
    return to_numbers(_trimmed(path, kind), path, kind)


def to_numbers(
    rows: Sequence[Sequence[str]],
    path: str | os.PathLike[str],
    kind: str,
    *,
    first: int = 1,
    columns: int | None = None,
    gaps: bool = False,
) -> NDArray[np.float64]:
    """Return the numbers [line, column] of rows of cells.

    Args:
        rows: cells of each line.
        path, kind: file that they are of, and what it should be, for messages.
        first: number of the first line, for messages.
        columns: cells of a line; those of the first when None.
        gaps: True where cells may be empty, as for :func:`read_columns`.
    """
    name = brief(os.fspath(path))
    if not rows:
        raise DataError(f"{name} holds no table of numbers.")
    table = np.empty((len(rows), len(rows[0]) if columns is None else columns))
    for index, row in enumerate(rows):
        if len(row) != table.shape[1]:
            raise DataError(
                f"{name} is not a {kind}: row {index + first} has {len(row)} columns, row 1 {table.shape[1]}."
            )
        try:
            table[index] = ["nan" if cell.lower() in ("", "na") else cell for cell in row] if gaps else row
        except ValueError as error:
            raise DataError(f"{name} is not a {kind}: row {index + first} is {brief(','.join(row))}.") from error
    return table


def _trimmed(path: str | os.PathLike[str], kind: str) -> list[list[str]]:
    """Return rows without the empty cells at their ends, which commas at the ends of lines make."""
    rows = _rows(path, kind)
    for row in rows:
        while row and not row[-1]:
            row.pop()
    return rows


def _rows(path: str | os.PathLike[str], kind: str) -> list[list[str]]:
    lines = [line for line in read_text(path, kind, most=MOST_TABLE).splitlines() if line.strip()]
    with readable(path, kind):
        return [[cell.strip() for cell in row] for row in csv.reader(lines)]
