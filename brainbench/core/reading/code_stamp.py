"""Stamp of the installed code, for entries of the cache that any change of it makes worthless."""

from __future__ import annotations

import functools
import os
import platform
from pathlib import Path

from brainbench.core.files import content_hash, library_versions


@functools.cache
def code_stamp() -> str:
    """Hash the names, sizes and times of the package's files, and the versions of Python and its libraries.

    An entry named by it never outlives an edit. What is slow to make again, such as a simulation, has a version of
    its own instead (:data:`brainbench.stimuli.engines.PHYSICS_VERSION`).
    """
    root = Path(__file__).parents[2]
    found = []
    for folder, _, names in os.walk(root):
        for name in names:
            if not name.endswith(".pyc"):
                state = os.stat(os.path.join(folder, name))  # noqa: PTH116, PTH118 - twice as fast, on every score
                found.append((folder, name, state.st_size, state.st_mtime_ns))
    return content_hash(sorted(found), library_versions(), platform.python_version(), platform.machine())
