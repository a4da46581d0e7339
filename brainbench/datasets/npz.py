"""Archives of arrays (``.npz``) from elsewhere: read without pickle, whatever is in them."""

from __future__ import annotations

import os
import tokenize
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import DataError, DataFileNotFoundError

_UNREADABLE = (
    OSError, ValueError, TypeError, AttributeError, EOFError, MemoryError, RuntimeError, SyntaxError, SystemError,
    tokenize.TokenError, zipfile.BadZipFile, zlib.error,
)  # fmt: skip
"""Errors that numpy and zipfile raise on damaged archives and on what is none (found by changing bytes at random)."""


def read_npz(path: str | os.PathLike[str], expected: str) -> dict[str, NDArray[Any]]:
    """Return the arrays of an archive by name; ``expected`` says in an error what should have been there.

    Raises:
        DataError: the file is missing, damaged or no archive, or holds Python objects, which could run code.
    """
    name, entry = os.fspath(path), ""
    found: dict[str, NDArray[Any]] = {}
    try:
        # Opened here, because numpy leaves damaged archives open.
        with Path(path).open("rb") as stream:
            if not zipfile.is_zipfile(stream):
                stream.seek(0)
                head = stream.read(2)
                why = "empty" if not head else "truncated; copy it again" if head == b"PK" else "no zip archive"
                raise DataError(f"{name} is not an .npz file, which {expected} needs: it is {why}.")
            stream.seek(0)
            with np.load(stream, allow_pickle=False) as stored:
                for entry in stored.files:
                    found[entry] = np.asarray(stored[entry])
    except FileNotFoundError as error:
        raise DataFileNotFoundError(f"There is no file {name!r}; expected {expected}.") from error
    except DataError:
        raise
    except _UNREADABLE as error:
        objects = "Python objects, which are never loaded (they could run code)"
        why = objects if "allow_pickle" in str(error) else f"damaged ({error})"
        raise DataError(f"The entry {entry!r} of {name} is {why}; expected {expected}.") from error
    return found
