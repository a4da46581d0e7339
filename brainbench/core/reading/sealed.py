"""Entries of the cache, sealed: only what this user's brainbench wrote under a name is read again under that name.

A seal is a keyed hash (HMAC-SHA256) of an entry's place and content; the place holds the version of the code that made
it. It stands beside the entry, one line for each content that was written there. The key is one user's, in a file that
nobody else can read. An entry without a seal that fits was damaged, edited, moved or made by somebody else: it is made
again, with a warning. Entries that come with the package are checked without a secret, since they are part of it.
"""

from __future__ import annotations

import contextlib
import functools
import hmac
import logging
import os
import platform
import secrets
import stat
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import DataError
from brainbench.core.files import (
    KEY,
    KEY_BYTES,
    KEY_VARIABLE,
    atomic_path,
    content_hash,
    library_versions,
    settings_dir,
    state_hash,
    write_private,
)
from brainbench.core.reading.hdf5 import trust_hdf5
from brainbench.core.reading.tensors import read_npz

T = TypeVar("T")
_PACKAGE = Path(__file__).parents[2]
_LOG = logging.getLogger(__name__)


def read_entry(path: Path, what: str, read: Callable[[Path], T]) -> T | None:
    """Return what ``read`` makes of an entry of the cache; None without one.

    One that is not sealed, or cannot be read, is None too, with a warning.
    """
    if not path.is_file():
        return None
    fault: object = "its seal does not fit: it was edited, or somebody else wrote it"
    if is_sealed(path):
        if path.suffix == ".h5":
            trust_hdf5(path)  # its bytes were compared: nothing looks through it first
        try:
            return read(path)
        except DataError as error:
            fault = error
    _LOG.warning("The %s in the cache, %s, is damaged and is made again (%s)", what, path, fault)
    return None


@contextlib.contextmanager
def keeping(what: str) -> Iterator[None]:
    """Write an entry of the cache; where nothing can be written, a warning says so and work goes on."""
    try:
        yield
    except OSError as error:
        _LOG.warning("The %s could not be kept in the cache (%s)", what, error)


def keep_entry(path: Path, what: str, write: Callable[[Path], object]) -> None:
    """Keep in the cache what ``write`` puts into a file, sealed and as a whole.

    Where nothing can be written, a warning says so and work goes on.
    """
    with keeping(what), atomic_path(path) as temporary:
        write(temporary)
        seal_file(temporary, path)


def read_sealed(path: Path, what: str) -> dict[str, NDArray[Any]] | None:
    """Return the arrays that :func:`write_sealed` kept at ``path``; ``what`` they are, for the warning."""
    return read_entry(path, what, lambda file: dict(read_npz(file, "entry of the cache")))


def write_sealed(path: Path, what: str, arrays: Mapping[str, Any], *, compress: bool = False) -> None:
    """Keep arrays in the cache, as ``.npz``."""
    values: dict[str, Any] = {name: np.asarray(value) for name, value in arrays.items()}
    keep_entry(path, what, lambda file: (np.savez_compressed if compress else np.savez)(file, **values))


def seal_file(file: Path, place: Path | None = None) -> None:
    """Note that a file is what belongs at a place, by default where it is."""
    place = place or file
    line = _seal(place, state_hash(file))
    if line not in _lines(place):
        # Appended, so that of two processes that write an entry at once neither takes away the other's seal.
        handle = os.open(_beside(place), os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o600)
        with os.fdopen(handle, "ab") as stream:
            stream.write(line + b"\n")


def is_sealed(path: Path) -> bool:
    """Return whether a file is there with bytes that :func:`seal_file` saw, under this user's key."""
    try:
        digest = state_hash(path)
        return any(hmac.compare_digest(line, _seal(path, digest)) for line in _lines(path))
    except OSError:
        return False


def _beside(place: Path) -> Path:
    return place.with_name(f"{place.name}.seal")


def _lines(place: Path) -> list[bytes]:
    path = _beside(place)
    return path.read_bytes().split() if path.is_file() else []


def _seal(place: Path, digest: str) -> bytes:
    key = b"" if place.is_relative_to(_PACKAGE) else _key(settings_dir())
    return hmac.digest(key, f"{place.parent.name}/{place.name} {digest}".encode(), "sha256").hex().encode()


@functools.cache
def _key(settings: Path) -> bytes:
    """Return this user's key, made when it is first needed."""
    if stated := os.environ.get(KEY_VARIABLE):
        return stated.encode()
    path = settings / KEY
    try:
        if (key := _private_bytes(path)) is None:
            write_private(path, secrets.token_bytes(KEY_BYTES), replace=False)
            key = _private_bytes(path)
        if key is not None:
            return key
        fault = f"others may read {path}; remove it"
    except OSError as error:
        fault = str(error)
    _LOG.warning(
        "No key for the cache can be kept (%s): what this run keeps there is made again by the next one. "
        "Name a folder of settings with BRAINBENCH_CONFIG, or a key with %s.", fault, KEY_VARIABLE,
    )  # fmt: skip
    # Processes that this one starts share it.
    os.environ[KEY_VARIABLE] = secrets.token_hex(KEY_BYTES)
    return os.environ[KEY_VARIABLE].encode()


def _private_bytes(path: Path) -> bytes | None:
    """Return a key if it is a file of this user that nobody else can read or write; None without such a file."""
    with contextlib.suppress(FileNotFoundError):
        state, content = path.lstat(), path.read_bytes()
        user = os.geteuid() if hasattr(os, "geteuid") else state.st_uid
        private = os.name != "posix" or not state.st_mode & 0o077
        if stat.S_ISREG(state.st_mode) and state.st_uid == user and private and len(content) == KEY_BYTES:
            return content
    return None


@functools.cache
def code_stamp() -> str:
    """Hash the names, sizes and times of the package's files, and the versions of Python and its libraries.

    An entry named by it never outlives an edit. What is slow to make again, such as a simulation, has a version of
    its own instead (:data:`brainbench.stimuli.engines.PHYSICS_VERSION`).
    """
    parts = []
    for folder, _, names in os.walk(_PACKAGE):
        for name in names:
            if not name.endswith(".pyc"):
                state = os.stat(os.path.join(folder, name))  # noqa: PTH116, PTH118 - twice as fast, on every score
                parts.append((folder, name, state.st_size, state.st_mtime_ns))
    return content_hash(sorted(parts), library_versions(), platform.python_version(), platform.machine())
