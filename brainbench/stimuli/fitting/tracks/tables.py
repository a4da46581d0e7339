"""Comma-separated tables with a line of names, in which cells may be empty."""

from __future__ import annotations

import csv
import os

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import DataError, shown
from brainbench.core.reading.regular import MOST_TABLE
from brainbench.core.reading.texts import read_text


def read_rows(path: str | os.PathLike[str], kind: str) -> list[list[str]]:
    """Return the cells of a comma-separated file; lines without any are left out."""
    rows = csv.reader(read_text(path, kind, most=MOST_TABLE).splitlines())
    found = [[cell.strip() for cell in row] for row in rows]
    return [row for row in found if any(row)]


def read_table(path: str | os.PathLike[str], kind: str) -> tuple[list[str], NDArray[np.float64]]:
    """Return the names of a table's first line and the numbers [line, column] below; empty cells are NaN.

    Raises:
        DataFileNotFoundError: there is no such file.
        DataError: a cell is no number, or lines differ in length.
    """
    rows = read_rows(path, kind)
    if len(rows) < 2:
        raise DataError(f"{shown(os.fspath(path))} holds no line below its names; a {kind} is needed.")
    return rows[0], numbers_of(rows[1:], path, kind, first=2, columns=len(rows[0]))


def numbers_of(
    rows: list[list[str]], path: str | os.PathLike[str], kind: str, *, first: int, columns: int
) -> NDArray[np.float64]:
    """Return the numbers [line, column] of rows of cells; ``first`` is the number of the first line, for messages."""
    values = np.full((len(rows), columns), np.nan)
    for index, row in enumerate(rows):
        if len(row) != columns:
            raise DataError(
                f"{shown(os.fspath(path))} is no {kind}: line {index + first} has {len(row)} cells, its first "
                f"{columns}."
            )
        for column, cell in enumerate(row):
            if cell and cell.lower() not in ("nan", "na"):
                try:
                    values[index, column] = float(cell)
                except ValueError:
                    raise DataError(
                        f"{shown(os.fspath(path))} is no {kind}: line {index + first} has {shown(cell)} where a number "
                        "is needed."
                    ) from None
    return values
