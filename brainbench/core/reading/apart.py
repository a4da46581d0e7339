"""Files that a library parses in compiled code: a process with limits reads them first, and hands back plain arrays."""

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
    """Return the arrays that ``module:function`` reads of a file, called with its path alone in another process.

    ``kind`` is what the file shall be, in words.
    """
    file, name = check_file(path, kind).absolute(), brief(os.fspath(path))
    with tempfile.TemporaryDirectory(prefix="brainbench-") as folder:
        arrays = Path(folder) / "arrays.npz"
        words = [sys.executable, "-P", "-m", __name__, function, os.fspath(file), os.fspath(arrays)]
        try:
            done = subprocess.run(words, stdin=subprocess.DEVNULL, capture_output=True, timeout=SECONDS, check=False)
        except subprocess.TimeoutExpired:
            raise DataError(f"{name} is damaged: to read it took over {SECONDS:g} s.") from None
        if done.returncode == _REFUSED:
            raise DataError(done.stdout.decode(errors="replace"))
        if done.returncode:
            raise DataError(f"{name} is no {kind}, or damaged: the library that reads it crashed; copy it again.")
        return dict(read_npz(arrays, kind))


if __name__ == "__main__":
    target, source, result = sys.argv[1:]
    module, _, attribute = target.partition(":")
    read = getattr(importlib.import_module(module), attribute)
    if sys.platform != "win32":
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    try:
        with readable(source, "file of its kind"):
            np.savez(result, **read(source))
    except BrainbenchError as error:
        sys.stdout.write(str(error))
        sys.exit(_REFUSED)
