"""Archives of arrays (``.npz``); what is encrypted, declares more than it stores or holds objects is refused."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from brainbench.core.errors import DataError, brief, listing
from brainbench.core.reading.hdf5_worker import MOST_EXPANSION, MOST_MEMORY
from brainbench.core.reading.regular import check_file, readable

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


def read_npz(path: str | os.PathLike[str], kind: str = ".npz file") -> dict[str, NDArray[np.generic]]:
    """Read all arrays of a NumPy archive."""
    import numpy as np

    file = check_file(path, kind)
    with readable(path, kind):
        with file.open("rb") as stream:
            head = stream.read(2)
        if not zipfile.is_zipfile(file):
            why = "empty" if not head else "truncated; copy it again" if head == b"PK" else "no zip archive"
            raise DataError(f"{brief(os.fspath(path))} is not an .npz file, which a {kind} is: it is {why}.")
        with zipfile.ZipFile(file) as archive:
            check_archive(archive, path, kind)
        with np.load(file, allow_pickle=False) as stored:
            return {key: _array(stored, key, f"{os.fspath(path)}:{key}") for key in stored.files}


def _array(stored: Mapping[str, Any], key: str, name: str) -> NDArray[np.generic]:
    """Return an array of an archive; NumPy itself refuses objects, and more than is stored."""
    with readable(name, "array"):
        try:
            array = stored[key]
        except ValueError as error:
            if "allow_pickle" not in str(error):
                raise
            raise DataError(
                f"{brief(name)} holds Python objects, which are never loaded: they could run code."
            ) from error
    if not hasattr(array, "dtype"):
        raise DataError(f"{brief(name)} is no array, or it is damaged.")
    return array


def check_archive(archive: zipfile.ZipFile, path: str | os.PathLike[str], kind: str) -> None:
    """Refuse what is encrypted, and what unpacks to far more than is stored."""
    members, name = archive.infolist(), brief(os.fspath(path))
    if locked := [item.filename for item in members if item.flag_bits & 1]:
        raise DataError(f"{name} is encrypted ({listing(locked, limit=3)}); save it without a password.")
    unpacked = sum(item.file_size for item in members)
    if unpacked > MOST_MEMORY + MOST_EXPANSION * Path(path).stat().st_size:
        raise DataError(f"{name} unpacks to {unpacked:,} bytes; it is damaged or no {kind}.")
