"""Simulated recipes of the package, found in the cache without building their scenes again.

Building the meshes of a recipe only to name its entry in the cache takes longer than reading the entry. A small file
beside the entries leads from what was asked for, and the stamp of the code, to the entry and its description.
"""

from __future__ import annotations

import contextlib
from pathlib import Path

from brainbench.core.errors import DataError
from brainbench.core.files import cache_dir, content_hash, read_json, write_json
from brainbench.core.reading.code_stamp import code_stamp


def index_path(*asked: object) -> Path:
    """Return the file that leads to the entry for a recipe with these options."""
    return cache_dir("stimuli", "recipes") / f"{content_hash(asked, code_stamp())}.json"


def read_index(path: Path) -> tuple[Path, str] | None:
    """Return the entry that an index names, and its description; None without one."""
    try:
        held = read_json(path)
        entry = cache_dir("stimuli") / held["entry"]
        return (entry, held["description"]) if entry.is_file() else None
    except (DataError, KeyError, TypeError):
        return None


def write_index(path: Path, entry: Path, description: str) -> None:
    """Lead from ``path`` to an entry of the cache; nothing is lost where that cannot be written."""
    with contextlib.suppress(OSError):
        write_json(path, {"entry": entry.name, "description": description})
