"""JSON, TOML and tables of numbers, of bounded size, depth and digits; no value is NaN or infinite."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from brainbench.core.errors import DataError, shown
from brainbench.core.reading.regular import MOST_TABLE, MOST_TEXT, check_file, readable, reason

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

MOST_LEVELS = 64
"""Levels of nesting."""
LARGEST_WHOLE = 2**63 - 1
"""Largest magnitude of a whole number."""


def read_text(path: str | os.PathLike[str], kind: str = "text file", *, most: int = MOST_TEXT) -> str:
    """Read UTF-8 text.

    Raises:
        DataFileNotFoundError: there is no such file.
        DataError: it is no regular file, is too large, or is no UTF-8 text.
    """
    found = check_file(path, kind, most=most)
    with readable(path, kind):
        return found.read_text(encoding="utf-8-sig")


def parse_json(text: str, name: str) -> Any:
    """Parse JSON text; ``name`` is that of its file in messages.

    Raises:
        DataError: it is not valid, nested too deeply, or holds a number that is not finite or too large.
    """
    # Python's parser takes NaN and Infinity, which JSON does not know, and 1e400, which is infinite.
    with readable(name, "JSON"):
        try:
            return check_values(json.loads(text), name)
        except json.JSONDecodeError as error:
            raise DataError(f"{shown(name)} is not valid JSON ({reason(error)}).") from error


def parse_toml(text: str, name: str) -> dict[str, Any]:
    """Parse TOML text; ``name`` is that of its file in messages. Errors are those of :func:`parse_json`."""
    import tomllib

    with readable(name, "TOML"):
        try:
            return check_values(tomllib.loads(text), name)
        except tomllib.TOMLDecodeError as error:
            raise DataError(f"{shown(name)} is not valid TOML ({reason(error)}).") from error


def read_json(path: str | os.PathLike[str], kind: str = "file") -> Any:
    """Read JSON.

    Raises:
        DataFileNotFoundError: there is no such file.
        DataError: it is no regular file or too large; or see :func:`parse_json`.
    """
    return parse_json(read_text(path, kind), os.fspath(path))


def read_toml(path: str | os.PathLike[str], kind: str = "file") -> dict[str, Any]:
    """Read TOML; errors are those of :func:`read_json`."""
    return parse_toml(read_text(path, kind), os.fspath(path))


def read_mapping(path: str | os.PathLike[str], kind: str = "file") -> dict[str, Any]:
    """Read names and values from a TOML or JSON file, which its ending tells apart.

    Raises:
        DataFileNotFoundError: there is no such file.
        DataError: it cannot be parsed or holds no mapping.
    """
    values = read_json(path, kind) if Path(path).suffix.lower() == ".json" else read_toml(path, kind)
    if not isinstance(values, dict):
        raise DataError(f"{os.fspath(path)!r} holds a {type(values).__name__}, not names and values.")
    return values


def read_numbers(path: str | os.PathLike[str], kind: str = "table of comma-separated numbers") -> NDArray[np.float64]:
    """Return the numbers [line, column] of a comma-separated file; lines may end with a comma.

    NaN and infinity are numbers here: some tables have gaps, and their readers say what these mean.

    Raises:
        DataError: there is no such file, something is no number, or lines differ in length.
    """
    import numpy as np

    lines = [line.rstrip(",\r ") for line in read_text(path, kind, most=MOST_TABLE).split("\n") if line.strip()]
    rows = []
    for number, line in enumerate(lines, 1):
        try:
            rows.append(np.array(line.split(","), dtype=float))
        except ValueError as error:
            raise DataError(f"{os.fspath(path)!r} is not a {kind}: row {number} is {shown(line)}.") from error
        if len(rows[-1]) != len(rows[0]):
            raise DataError(
                f"{os.fspath(path)!r} is not a {kind}: row {number} has {len(rows[-1])} columns, row 1 {len(rows[0])}."
            )
    if not rows:
        raise DataError(f"{os.fspath(path)!r} holds no table of numbers.")
    return np.stack(rows)


def check_values(value: Any, name: str) -> Any:
    """Return nested plain data whose numbers are all finite and not too large.

    Raises:
        DataError: a value is not; the message has its place in the file.
    """
    _check(value, name, ())
    return value


def _check(value: Any, name: str, place: tuple[str | int, ...]) -> None:
    if type(value) is float:
        if not math.isfinite(value):
            raise DataError(f"{_place(name, place)} is {value}; a finite number is needed.")
    elif type(value) is int:
        if abs(value) > LARGEST_WHOLE:
            raise DataError(f"{_place(name, place)} is a number of about 2^{value.bit_length()}; the largest is 2^63.")
    elif isinstance(value, (Mapping, list)):
        if len(place) >= MOST_LEVELS:
            raise DataError(f"{shown(name)} is nested too deeply: more than {MOST_LEVELS} levels.")
        for key, item in value.items() if isinstance(value, Mapping) else enumerate(value):
            if type(item) is not str:
                _check(item, name, (*place, key))


def _place(name: str, place: tuple[str | int, ...]) -> str:
    inside = "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in place).removeprefix(".")
    return f"{shown(inside)} in {shown(name)}" if inside else shown(name)
