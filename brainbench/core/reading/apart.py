"""Foreign bytes that compiled code parses: a process with limits does it, and hands back words or plain arrays.

The process starts with the first file and forks one for each: what loops, crashes or takes all memory ends that alone.
"""

from __future__ import annotations

import atexit
import contextlib
import importlib
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import BrainbenchError, DataError, brief
from brainbench.core.reading.regular import check_file, readable, temporary_folder
from brainbench.core.reading.tensors import read_npz

SECONDS = 60.0
"""Processor time for a file, by default."""
PATIENCE = 120.0
"""Time by the clock beyond it: a busy disk, or a machine that stood still, is no fault of the file."""
MEMORY = 8 << 30  # address space [bytes]; compiled libraries reserve much more than they use
MOST_WRITTEN = 16 << 30  # bytes that a file which is written may have
CRASHED = "is damaged: the library that reads it crashed or did not come back; copy it again"
"""What is said after the name of a file with which the process ended."""


def read_apart(function: str, path: str | os.PathLike[str], kind: str) -> dict[str, NDArray[Any]]:
    """Return the arrays that ``module:function`` reads of a file, called with its path alone in another process.

    ``kind`` is what the file shall be, in words.
    """
    file = check_file(path, kind).absolute()
    with temporary_folder() as folder:
        arrays = Path(folder) / "arrays.npz"
        fault = call_apart(f"{__name__}:save_arrays", [function, os.fspath(file), os.fspath(arrays)], SECONDS)
        if fault != "":
            raise DataError(fault or f"{brief(os.fspath(path))} {CRASHED}.")
        return dict(read_npz(arrays, kind))


def save_arrays(function: str, source: str, arrays: str) -> str:
    """Write the arrays that a function reads of a file into another one; return what is wrong, in words."""
    try:
        with readable(source, "file of its kind"):
            np.savez(arrays, **_load(function)(source))
    except BrainbenchError as error:
        return str(error)
    return ""


def call_apart(function: str, arguments: Sequence[Any], seconds: float) -> Any:
    """Return what ``module:function`` returns in another process, as JSON.

    None where that ended, or took more processor time than ``seconds``.
    """
    with _Worker.lock:
        process = _Worker.running()
        watch = threading.Timer(seconds + PATIENCE + 3, process.kill)
        answer = ""
        try:
            watch.start()
            with contextlib.suppress(OSError):
                process.stdin.write(json.dumps([function, *arguments, [seconds, seconds + PATIENCE]]) + "\n")  # type: ignore[union-attr]
                process.stdin.flush()  # type: ignore[union-attr]
                answer = process.stdout.readline()  # type: ignore[union-attr]
        finally:
            watch.cancel()
            # Also of a caller who was interrupted: the next one would take this answer for that to its own file.
            if not answer:
                _Worker.end(process)
        return json.loads(answer or "null")


class _Worker:
    """The process that forks; it ends with this one."""

    process: subprocess.Popen[str] | None = None
    lock = threading.Lock()
    _owner = 0

    @classmethod
    def running(cls) -> subprocess.Popen[str]:
        """Return the process, started where this process has none that runs."""
        # A forked process must not share the pipe of its parent.
        if cls.process is None or cls._owner != os.getpid() or cls.process.poll() is not None:
            paths = os.pathsep.join(filter(None, sys.path))
            pipe = subprocess.PIPE
            process = subprocess.Popen(
                [sys.executable, "-P", "-m", __name__], stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL, text=True,
                env={**os.environ, "PYTHONPATH": paths},
            )  # fmt: skip
            # Its start on a busy machine is no fault of the file.
            try:
                process.stdout.readline()  # type: ignore[union-attr]
            except BaseException:
                cls.end(process)
                raise
            cls.process, cls._owner = process, os.getpid()
            atexit.register(cls.end, process)
        return cls.process

    @staticmethod
    def end(process: subprocess.Popen[str]) -> None:
        """End a process and close its pipes."""
        process.kill()
        for stream in (process.stdin, process.stdout):
            with contextlib.suppress(OSError):
                stream.close()  # type: ignore[union-attr]
        process.wait()


def _load(function: str) -> Any:
    module, _, attribute = function.partition(":")
    return getattr(importlib.import_module(module), attribute)


def _answer(request: str) -> str:
    function, *arguments, _ = json.loads(request)
    return json.dumps(_load(function)(*arguments)) + "\n"


def _bound(processor: float, clock: float) -> None:
    """Set limits to what this process takes: the signals end it even within a loop of a library."""
    import resource

    signal.setitimer(signal.ITIMER_PROF, max(processor, 1e-3))
    signal.setitimer(signal.ITIMER_REAL, max(clock, 1e-3))
    resource.setrlimit(resource.RLIMIT_FSIZE, (MOST_WRITTEN, MOST_WRITTEN))
    files = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (files, files))
    with contextlib.suppress(ValueError, OSError):  # systems without
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))


def _serve() -> None:
    """Answer requests, each a line of JSON, with lines of JSON; libraries that print write nowhere."""
    import h5py  # noqa: F401 - once, for all processes that are forked below

    with contextlib.suppress(ImportError):
        import hdf5plugin  # noqa: F401 # pyright: ignore[reportMissingImports] - brings filters along

    with os.fdopen(os.dup(1), "w") as answers:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        answers.write("ready\n")
        answers.flush()
        for line in sys.stdin:
            # Ours alone, and no byte of the file: what it needs is imported once for all processes that are forked.
            with contextlib.suppress(Exception):
                for function in json.loads(line)[: 2 if ":save_arrays" in line else 1]:
                    _load(function)
            if not hasattr(os, "fork"):
                answers.write(_answer(line))
            elif (child := os.fork()) == 0:
                # Damage can spoil a library's memory: a file has a process to itself, which tells of it when it ends.
                _bound(*json.loads(line)[-1])
                answers.write(_answer(line))
                answers.flush()
                os._exit(0)
            elif os.waitpid(child, 0)[1]:
                answers.write("null\n")
            answers.flush()


if __name__ == "__main__":
    _serve()
