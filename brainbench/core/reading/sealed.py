"""Entries of the cache: a damaged one is noticed and made again, and a full disk stops no work."""

from __future__ import annotations

import contextlib
import functools
import logging
import os
import platform
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import DataError
from brainbench.core.files import atomic_path, content_hash, file_hash, hash_arrays, library_versions, write_text
from brainbench.core.reading.archives import read_npz
from brainbench.core.reading.hdf5 import trust_hdf5

T = TypeVar("T")
_HASH = "sha256"
_LOG = logging.getLogger(__name__)


def read_entry(path: Path, what: str, read: Callable[[Path], T]) -> T | None:
    """Return what ``read`` makes of an entry of the cache; None without one or, with a warning, for a damaged one."""
    if not path.is_file():
        return None
    try:
        return read(path)
    except DataError as error:
        _LOG.warning("The %s in the cache, %s, is damaged and is made again (%s)", what, path, error)
        return None


@contextlib.contextmanager
def keeping(what: str) -> Iterator[None]:
    """Write an entry of the cache; where nothing can be written, a warning says so and work goes on."""
    try:
        yield
    except OSError as error:
        _LOG.warning("The %s could not be kept in the cache (%s)", what, error)


def read_sealed(path: Path, what: str) -> dict[str, NDArray[Any]] | None:
    """Return the arrays of an entry of the cache; None, with a warning, if it is damaged, and None without one.

    Args:
        path: its file, written by :func:`write_sealed`.
        what: what it holds, for the warning.
    """

    def read(path: Path) -> dict[str, NDArray[Any]]:
        arrays: dict[str, NDArray[Any]] = dict(read_npz(path, "entry of the cache"))
        if str(arrays.pop(_HASH, "none")) != hash_arrays(arrays):
            raise DataError("its numbers do not match its hash")
        return arrays

    return read_entry(path, what, read)


def write_sealed(path: Path, what: str, arrays: Mapping[str, Any], *, compress: bool = False) -> None:
    """Keep arrays in the cache, as ``.npz``; where nothing can be written, a warning says so and work goes on."""
    values = {name: np.asarray(value) for name, value in arrays.items()}
    with keeping(what), atomic_path(path) as temporary:
        sealed: dict[str, Any] = {**values, _HASH: hash_arrays(values)}
        (np.savez_compressed if compress else np.savez)(temporary, **sealed)


def seal_file(path: Path) -> None:
    """Write the hash of a file of the cache beside it."""
    write_text(path.with_suffix(".sha256"), file_hash(path, length=64))


def is_sealed(path: Path) -> bool:
    """Return whether a file of the cache is there with the bytes that :func:`seal_file` saw."""
    seal = path.with_suffix(".sha256")
    return path.is_file() and seal.is_file() and seal.read_bytes()[:64] == file_hash(path, length=64).encode()


def trust_sealed(path: Path) -> None:
    """Open an HDF5 file of the cache without looking through it first, if its bytes fit the hash beside it."""
    if is_sealed(path):
        trust_hdf5(path)


@functools.cache
def code_stamp() -> str:
    """Hash the names, sizes and times of the package's files, and the versions of Python and its libraries.

    An entry named by it never outlives an edit. What is slow to make again, such as a simulation, has a version of
    its own instead (:data:`brainbench.stimuli.engines.PHYSICS_VERSION`).
    """
    root = Path(__file__).parents[2]
    parts = []
    for folder, _, names in os.walk(root):
        for name in names:
            if not name.endswith(".pyc"):
                state = os.stat(os.path.join(folder, name))  # noqa: PTH116, PTH118 - twice as fast, on every score
                parts.append((folder, name, state.st_size, state.st_mtime_ns))
    return content_hash(sorted(parts), library_versions(), platform.python_version(), platform.machine())
