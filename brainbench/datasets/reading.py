"""From what a user names to sessions: files, the recipe of each, and what that recipe makes of it."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from brainbench.datasets.layouts.registry import RecordingLayout, detect_recipe, get_recipe, split_source
from brainbench.datasets.sessions import Session
from brainbench.datasets.sources import find_files, read_file

if TYPE_CHECKING:
    import h5py

Source = str | os.PathLike[str] | Sequence[str | os.PathLike[str]]
"""A file, a folder, a glob, a list of these, or ``RECIPE:PATH``."""


def find_recordings(source: Source) -> tuple[RecordingLayout | None, list[Path]]:
    """Return the recipe that a source names, if any, and its files.

    Raises:
        DataFileNotFoundError: the source names nothing.
        UsageError: it names an unknown recipe.
    """
    if not isinstance(source, str):
        return None, find_files(source)
    name, rest = split_source(source)
    return (get_recipe(name) if name else None), find_files(rest)


def each_session(
    file: h5py.File, path: Path, recipe: RecordingLayout | None = None
) -> Iterator[tuple[Session, RecordingLayout | None]]:
    """Yield the sessions of an open file with the recipe that fits each: the given one, else by its layout.

    A session comes as its recipe adapts it. Read it while the file is open, inside the block of
    :func:`~brainbench.datasets.sources.open_file`, which names the file if reading fails.

    Raises:
        DataError: the file cannot be read; see :func:`~brainbench.datasets.sources.read_file`.
    """
    for session in read_file(file, path):
        found = recipe or detect_recipe(session)
        yield (session if found is None else found.adapted(session)), found
