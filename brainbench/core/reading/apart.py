"""Files that a library parses in compiled code: a process with limits reads them first, and hands back plain arrays.

Run as ``python -m brainbench.core.reading.apart MODULE:FUNCTION FILE ARRAYS``. The function takes the path and returns
arrays by name. Damage that crashes the library, or keeps it busy for ever, ends that process and not this one.
"""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import BrainbenchError, DataError, brief
from brainbench.core.reading.archives import read_npz
from brainbench.core.reading.regular import check_file, readable

SECONDS = 60.0
"""Time for a file."""
MEMORY = 8 << 30
"""Address space [bytes]; compiled libraries reserve much more than they use."""
_REFUSED = 3


def read_apart(function: str, path: str | os.PathLike[str], kind: str) -> dict[str, NDArray[Any]]:
    """Return the arrays that ``module:function`` reads of a file, called by the path alone, in a process of its own.

    ``kind`` is what the file shall be, in words.

    Raises:
        DataFileNotFoundError: there is no such file.
    """
    file = check_file(path, kind).absolute()
    with tempfile.TemporaryDirectory(prefix="brainbench-") as folder:
        arrays = Path(folder) / "arrays.npz"
        words = [sys.executable, "-P", "-m", __name__, function, os.fspath(file), os.fspath(arrays)]
        try:
            done = subprocess.run(
                words,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                timeout=SECONDS,
                check=False,
            )
        except subprocess.TimeoutExpired:
            raise DataError(f"{brief(os.fspath(path))} is damaged: to read it took over {SECONDS:g} s.") from None
        if done.returncode == _REFUSED:
            raise DataError(done.stdout.decode(errors="replace"))
        if done.returncode or not arrays.is_file():
            raise DataError(
                f"{brief(os.fspath(path))} is no {kind}, or damaged: the library that reads it crashed; copy it again."
            )
        return dict(read_npz(arrays, kind))


def _main(function: str, path: str, arrays: str) -> int:
    module, _, name = function.partition(":")
    read = getattr(importlib.import_module(module), name)
    if sys.platform != "win32":
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
        resource.setrlimit(resource.RLIMIT_CPU, (int(SECONDS), int(SECONDS)))
    try:
        with readable(path, "file of its kind"):
            np.savez(arrays, **read(path))
    except BrainbenchError as error:
        sys.stdout.write(str(error))
        return _REFUSED
    return 0


if __name__ == "__main__":
    sys.exit(_main(*sys.argv[1:]))
