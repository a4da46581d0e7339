"""Tables of comma-separated numbers, with or without a line of names."""

from __future__ import annotations

import os

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import DataError, shown
from brainbench.core.reading.regular import MOST_TABLE
from brainbench.core.reading.texts import read_text


def read_columns(path: str | os.PathLike[str], kind: str) -> tuple[list[str], NDArray[np.float64]]:
    """Return the names in the first line of a comma-separated file, and the numbers [line, column] below.

    Raises:
        DataFileNotFoundError: there is no such file.
        DataError: something is no finite number, or lines differ in length.
    """
    lines = _lines(path, kind)
    header = [cell.strip() for cell in lines[0].split(",")] if lines else []
    table = _table(lines[1:], path, kind, first=2, columns=len(header))
    if not np.isfinite(table).all():
        row, column = np.argwhere(~np.isfinite(table))[0]
        raise DataError(
            f"{shown(os.fspath(path))}: {shown(header[column])} in row {row + 2} is {table[row, column]}; a finite "
            "number is needed."
        )
    return header, table


def read_numbers(path: str | os.PathLike[str], kind: str = "table of comma-separated numbers") -> NDArray[np.float64]:
    """Return the numbers [line, column] of a comma-separated file; lines may end with a comma.

    NaN and infinity are numbers here: some tables have gaps, and their readers say what these mean.

    Raises:
        DataError: there is no such file, something is no number, or lines differ in length.
    """
    return _table(_lines(path, kind), path, kind)


def _lines(path: str | os.PathLike[str], kind: str) -> list[str]:
    return [line.rstrip(",\r ") for line in read_text(path, kind, most=MOST_TABLE).split("\n") if line.strip()]


def _table(
    lines: list[str], path: str | os.PathLike[str], kind: str, *, first: int = 1, columns: int = 0
) -> NDArray[np.float64]:
    name = shown(os.fspath(path))
    rows: list[NDArray[np.float64]] = []
    for number, line in enumerate(lines, first):
        try:
            rows.append(np.array(line.split(","), dtype=float))
        except ValueError as error:
            raise DataError(f"{name} is not a {kind}: row {number} is {shown(line)}.") from error
        if len(rows[-1]) != (columns or len(rows[0])):
            raise DataError(
                f"{name} is not a {kind}: row {number} has {len(rows[-1])} columns, row 1 {columns or len(rows[0])}."
            )
    if not rows:
        raise DataError(f"{name} holds no table of numbers.")
    return np.stack(rows)
