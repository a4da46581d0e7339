"""Archives of arrays (``.npz``); what is encrypted, declares more than it stores or holds objects is refused."""

from __future__ import annotations

import math
import os
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING

from brainbench.core.errors import DataError, brief, listing
from brainbench.core.reading.hdf5_worker import MOST_EXPANSION, MOST_MEMORY
from brainbench.core.reading.regular import check_file, readable, reason

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


def read_npz(path: str | os.PathLike[str], kind: str = ".npz file") -> dict[str, NDArray[np.generic]]:
    """Read all arrays of a NumPy archive.

    Raises:
        DataFileNotFoundError: there is no such file.
    """
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
            for member in archive.infolist():
                _check_header(archive, member, brief(os.fspath(path)))
        with np.load(file, allow_pickle=False) as stored:
            return {key: np.asarray(stored[key]) for key in stored.files}


def check_archive(archive: zipfile.ZipFile, path: str | os.PathLike[str], kind: str) -> None:
    """Refuse what is encrypted, and what unpacks to far more than is stored."""
    members, name = archive.infolist(), brief(os.fspath(path))
    if locked := [item.filename for item in members if item.flag_bits & 1]:
        raise DataError(f"{name} is encrypted ({listing(locked, limit=3)}); save it without a password.")
    unpacked = sum(item.file_size for item in members)
    if unpacked > MOST_MEMORY + MOST_EXPANSION * Path(path).stat().st_size:
        raise DataError(f"{name} unpacks to {unpacked:,} bytes; it is damaged or no {kind}.")


def _check_header(archive: zipfile.ZipFile, member: zipfile.ZipInfo, name: str) -> None:
    """Compare the shape that an array declares with the bytes behind it, before memory is taken for it."""
    from numpy.lib import format as npy

    place = f"{brief(member.filename)} in {name}"
    with readable(name, "archive"), archive.open(member) as stream:
        try:
            version = npy.read_magic(stream)
            shape, _, dtype = (npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0)(stream)
        except ValueError as error:
            raise DataError(f"{place} is no array, or it is damaged ({reason(error)}).") from error
    if dtype.hasobject:
        raise DataError(f"{place} holds Python objects, which are never loaded: they could run code.")
    if math.prod(shape) * dtype.itemsize > member.file_size:
        raise DataError(f"{place} declares {list(shape)} of {dtype} and has {member.file_size:,} bytes; it is damaged.")
