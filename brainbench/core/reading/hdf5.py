"""HDF5 files of users: looked through by another process first, then opened, with every failure in one sentence."""

from __future__ import annotations

import atexit
import contextlib
import json
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from brainbench.core.errors import DataError, brief
from brainbench.core.reading.filters import naming_filters
from brainbench.core.reading.regular import check_file, readable

if TYPE_CHECKING:
    import h5py

SECONDS = 8.0
"""Time for looking through a file, after the worker's own limit; more for large ones, a second per :data:`RATE`."""
RATE = 10 << 20
"""Bytes per second at which even a slow disk is looked through."""


@contextlib.contextmanager
def open_hdf5(path: str | os.PathLike[str], kind: str = "HDF5 file", hint: str = "") -> Iterator[h5py.File]:
    """Open an HDF5 file for reading; failures inside the block name the file too.

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
    if state not in _TRUSTED and (fault := _fault(*state)):
        raise DataError(f"{brief(os.fspath(path))} {fault}.{hint and ' ' + hint}")
    with readable(path, kind, hint), h5py.File(place, "r") as file:
        with contextlib.suppress(ImportError):
            import hdf5plugin  # noqa: F401 # pyright: ignore[reportMissingImports] - brings filters along
        with naming_filters(file, path):
            yield file


def trust_hdf5(path: Path) -> None:
    """Note that the bytes of a file of ours have just been compared with their hash: nothing looks through it first."""
    _TRUSTED.add(_state(path.absolute()))


def _state(path: Path) -> tuple[str, int, int]:
    status = path.stat()
    return str(path), status.st_mtime_ns, status.st_size


_TRUSTED: set[tuple[str, int, int]] = set()


@lru_cache(maxsize=1024)
def _fault(path: str, changed: int, size: int) -> str:
    """Return what the worker says of a file; it is asked once for each state of the file."""
    del changed
    return _Worker.ask(path, SECONDS + size / RATE)


class _Worker:
    """The process that looks through files; it starts with the first file and ends with this process."""

    _process: subprocess.Popen[str] | None = None
    _owner = 0
    _lock = threading.Lock()

    @classmethod
    def ask(cls, path: str, seconds: float) -> str:
        """Return the answer about a file; empty where the process died over it or took longer than so many seconds."""
        with cls._lock:
            process = cls._running()
            watch = threading.Timer(seconds, process.kill)
            watch.start()
            try:
                process.stdin.write(json.dumps(path) + "\n")  # type: ignore[union-attr]
                process.stdin.flush()  # type: ignore[union-attr]
                answer = process.stdout.readline()  # type: ignore[union-attr]
            except OSError:
                answer = ""
            finally:
                watch.cancel()
            if answer:
                return json.loads(answer)
            cls._process = None
            cls._end(process)
            return "is damaged: the HDF5 library crashed or did not come back; copy it again"

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
