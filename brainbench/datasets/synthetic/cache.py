"""Synthetic recordings that are made once per machine and then found in the cache."""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from brainbench.core.errors import DataError
from brainbench.core.files import cache_dir, check_folder, content_hash, file_hash, read_json
from brainbench.core.reading.hdf5 import trust_hdf5
from brainbench.datasets.synthetic.truth import TRUTH

_ABANDONED = 24 * 3600.0
"""Age from which an unfinished file belongs to no running process, s."""

_log = logging.getLogger(__name__)


def ensure_recordings(name: str, *key: object, make: Callable[[Path], object]) -> Path:
    """Return the folder of synthetic recordings, making them if this machine has none.

    Two processes may ask at once and either may be killed: every file is written whole, the truth comes last, and a
    folder without it, or with files missing or of another size or hash, is made again. The folder's name begins with
    ``name``; ``key`` is everything on which the recordings depend, and ``make`` writes them into a folder, last their
    truth.
    """
    target = cache_dir("recordings") / f"{name}-{content_hash(*key)}"
    if not _complete(target):
        if (target / TRUTH).exists():
            _log.warning("The %s recordings in %s are damaged and are replaced.", name, target)
        # Before the stimuli are simulated, which is slow.
        check_folder(target, "The cache")
        make(target)
        # What a killed process left; a younger file may be one that is being written.
        for item in target.glob(".*"):
            with contextlib.suppress(OSError):
                if time.time() - item.stat().st_mtime > _ABANDONED:
                    item.unlink()
    return target


def _is_whole(path: Path, stated: Mapping[str, Any]) -> bool:
    whole = path.stat().st_size == stated["bytes"] and file_hash(path) == stated["hash"]
    if whole:
        trust_hdf5(path)
    return whole


def _complete(folder: Path) -> bool:
    try:
        files = read_json(folder / TRUTH)["files"]
        return all(_is_whole(folder / name, item) for name, item in files.items())
    except (DataError, OSError, KeyError, TypeError, AttributeError):
        return False
