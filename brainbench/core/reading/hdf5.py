"""HDF5 files of users: looked through by another process first, then opened, with every failure in one sentence."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from brainbench.core.errors import DataError, brief
from brainbench.core.reading.apart import CRASHED, call_apart
from brainbench.core.reading.hdf5_worker import lacking_filters
from brainbench.core.reading.regular import check_file, readable, temporary_folder

if TYPE_CHECKING:
    import h5py

SECONDS = 8.0
"""Processor time for looking through a file; more for large ones, a second per :data:`RATE` bytes."""
RATE = 10 << 20
LINKED_VARIABLE = "BRAINBENCH_ALLOW_LINKED"
"""Environment variable with folders, as in PATH, that HDF5 files may link into; ``--allow-linked`` sets it."""
WALK = "brainbench.core.reading.hdf5_worker:fault_of"
FILTERS = {32001: "Blosc", 32004: "LZ4", 32008: "bitshuffle", 32013: "ZFP", 32015: "Zstandard", 32026: "Blosc2"}
"""Registered filters of HDF5 that laboratories use."""


class MissingFilterError(DataError):
    """An array is compressed by a filter that this installation lacks."""


@contextlib.contextmanager
def open_hdf5(path: str | os.PathLike[str], kind: str = "HDF5 file", hint: str = "") -> Iterator[h5py.File]:
    """Open an HDF5 file for reading; failures inside the block name the file too.

    Another process walks it first. One whose bytes are all its own, contiguous or in chunks, is then read here: to send
    gigabytes through a pipe would cost more than to read them. It is the very file that was walked, by device, number,
    size and times. Of one with links, virtual arrays or bytes in other files, a copy with plain arrays is read
    (``file.filename``), which is removed after the block.

    Args:
        path: the file.
        kind: what it shall be, in words.
        hint: what to do when it is damaged; the end of the message.
    """
    import h5py

    place = check_file(path, kind).absolute()
    state = _state(place)
    with contextlib.ExitStack() as stack:
        if state not in _TRUSTED:
            folder = stack.enter_context(temporary_folder())
            allowed = [name for name in os.environ.get(LINKED_VARIABLE, "").split(os.pathsep) if name]
            request, seconds = [str(place), allowed, f"{folder}/{place.name}"], SECONDS + state[2] / RATE
            answer = call_apart(WALK, request, seconds + (600 if allowed else 0))
            fault, linked = answer or (CRASHED, False)
            if fault:
                raise DataError(f"{brief(os.fspath(path))} {fault}.{hint and ' ' + hint}")
            if linked:
                place = Path(request[2])
                state = _state(place)
            else:
                _TRUSTED.add(state)
        stack.enter_context(readable(path, kind, hint))
        file = stack.enter_context(h5py.File(place, "r"))
        if _state(place, file.id.get_vfd_handle()) != state:
            raise DataError(f"{brief(os.fspath(path))} changed while it was read; wait until it is complete.")
        with contextlib.suppress(ImportError):
            import hdf5plugin  # noqa: F401 # pyright: ignore[reportMissingImports] - brings filters along
        try:
            yield file
        except OSError as error:
            if (need := file.visititems(_need)) is None:
                raise
            raise MissingFilterError(f"{brief(os.fspath(path))} {need}: pip install hdf5plugin.") from error


def _need(name: str, node: Any) -> str | None:
    if not hasattr(node, "dtype") or not (codes := lacking_filters(node)):
        return None
    title = f" ({FILTERS[codes[0]]})" if codes[0] in FILTERS else ""
    return f"needs the HDF5 filter {codes[0]}{title} to read {brief(name)}"


def trust_hdf5(path: Path) -> None:
    """Note that the bytes of a file of ours have just been compared with their hash: nothing looks through it first."""
    _TRUSTED.add(_state(path.absolute()))


def _state(path: Path, handle: int | None = None) -> tuple[str, int, int, int, int, int]:
    """Return what tells a file, or the one that is open, from others and from what it was."""
    status = path.stat() if handle is None else os.fstat(handle)
    return str(path), status.st_mtime_ns, status.st_size, status.st_ctime_ns, status.st_ino, status.st_dev


_TRUSTED: set[tuple[str, int, int, int, int, int]] = set()
