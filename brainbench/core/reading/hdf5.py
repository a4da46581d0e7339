"""HDF5 files of users: looked through by another process first, then opened, with every failure in one sentence."""

from __future__ import annotations

import atexit
import contextlib
import json
import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from brainbench.core.errors import DataError, brief
from brainbench.core.reading.filters import naming_filters
from brainbench.core.reading.regular import check_file, readable

if TYPE_CHECKING:
    import h5py

SECONDS = 8.0
"""Time for looking through a file, after the worker's own limit; more for large ones, a second per :data:`RATE`."""
RATE = 10 << 20
"""Bytes per second at which even a slow disk is looked through."""
LINKED_VARIABLE = "BRAINBENCH_ALLOW_LINKED"
"""Environment variable with folders, as in PATH, that HDF5 files may link into; ``--allow-linked`` sets it."""


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

    Raises:
        DataFileNotFoundError: there is no such file.
    """
    import h5py

    place = check_file(path, kind).absolute()
    state = _state(place)
    with contextlib.ExitStack() as stack:
        if state not in _TRUSTED:
            folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="brainbench-"))
            allowed = [name for name in os.environ.get(LINKED_VARIABLE, "").split(os.pathsep) if name]
            request, seconds = [str(place), allowed, f"{folder}/{place.name}"], SECONDS + state[2] / RATE
            fault, linked = _Worker.ask(request, seconds + (600 if allowed else 0))
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
        stack.enter_context(naming_filters(file, path))
        yield file


def trust_hdf5(path: Path) -> None:
    """Note that the bytes of a file of ours have just been compared with their hash: nothing looks through it first."""
    _TRUSTED.add(_state(path.absolute()))


def _state(path: Path, handle: int | None = None) -> tuple[str, int, int, int, int, int]:
    """Return what tells a file, or the one that is open, from others and from what it was."""
    status = path.stat() if handle is None else os.fstat(handle)
    return str(path), status.st_mtime_ns, status.st_size, status.st_ctime_ns, status.st_ino, status.st_dev


_TRUSTED: set[tuple[str, int, int, int, int, int]] = set()


class _Worker:
    """The process that looks through files; it starts with the first file and ends with this process."""

    _process: subprocess.Popen[str] | None = None
    _owner = 0
    _lock = threading.Lock()

    @classmethod
    def ask(cls, request: list[Any], seconds: float) -> tuple[str, bool]:
        """Return the fault of a file, also where the process died or took longer, and whether there is a copy of it."""
        with cls._lock:
            process = cls._running()
            watch = threading.Timer(seconds, process.kill)
            watch.start()
            try:
                process.stdin.write(json.dumps(request) + "\n")  # type: ignore[union-attr]
                process.stdin.flush()  # type: ignore[union-attr]
                answer = process.stdout.readline()  # type: ignore[union-attr]
            except OSError:
                answer = ""
            finally:
                watch.cancel()
            if answer:
                fault, linked = json.loads(answer)
                return fault, linked
            cls._process = None
            cls._end(process)
            return "is damaged: the HDF5 library crashed or did not come back; copy it again", False

    @classmethod
    def _running(cls) -> subprocess.Popen[str]:
        # A forked process must not share the pipe of its parent.
        if cls._process is None or cls._owner != os.getpid() or cls._process.poll() is not None:
            words = [sys.executable, "-P", os.fspath(Path(__file__).with_name("hdf5_worker.py"))]
            pipe = subprocess.PIPE
            cls._process = subprocess.Popen(words, stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL, text=True)
            # Its start on a busy machine is no fault of the file.
            cls._process.stdout.readline()  # type: ignore[union-attr]
            cls._owner = os.getpid()
            atexit.register(cls._end, cls._process)
        return cls._process

    @staticmethod
    def _end(process: subprocess.Popen[str]) -> None:
        process.kill()
        for stream in (process.stdin, process.stdout):
            with contextlib.suppress(OSError):
                stream.close()  # type: ignore[union-attr]
        process.wait()
