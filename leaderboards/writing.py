"""Files that appear whole, together or not at all, and what killed writers left behind."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from brainbench.core.errors import BrainbenchError, DataError
from brainbench.core.files import atomic_path
from brainbench.core.writing.locks import lock_folder

_TEMPORARY = re.compile(r"\.(?P<stem>.+)-[0-9a-f]{16}(?P<suffix>\.[^.]*)?")
"""Names that :func:`brainbench.core.files.atomic_path` gives before a file is whole."""


def write_files(files: Mapping[Path, str | bytes], *, swept: bool = True) -> list[Path]:
    """Write files so that all are whole before the first appears, and return their paths.

    If ``swept``, what a killed process that wrote the same files left is removed. This lists their folders, so records,
    of which a folder may hold thousands, go without; ``leaderboard add`` sweeps once.

    Raises:
        DataError: they cannot be written; what was there is still there.
    """
    with contextlib.ExitStack() as stack:
        stack.enter_context(in_one_sentence(next(iter(files))))
        for folder in sorted({path.parent for path in files}):
            folder.mkdir(parents=True, exist_ok=True)
            if stack.enter_context(lock_folder(folder)) and swept:
                names = {path.name for path in files if path.parent == folder}
                sweep(folder, lambda name, names=names: name in names)
        for path, content in files.items():
            data = content.encode() if isinstance(content, str) else content
            stack.enter_context(atomic_path(path)).write_bytes(data)
    return list(files)


@contextlib.contextmanager
def in_one_sentence(place: Path) -> Iterator[None]:
    """Turn a full disk, a size limit, a missing permission or a file in the way into a DataError."""
    try:
        yield
    except BrainbenchError:
        raise
    except OSError as error:
        why = error.strerror or type(error).__name__
        raise DataError(f"{str(place)!r} could not be written ({why}); nothing is half-written.") from error


def sweep(folder: Path, ours: Callable[[str], bool]) -> None:
    """Remove the temporary files in a folder for whose final names ``ours`` is true; hold its lock meanwhile."""
    for path in folder.iterdir():
        name = final_name(path.name)
        if name is not None and ours(name):
            path.unlink(missing_ok=True)


def final_name(name: str) -> str | None:
    """Return the name that a temporary file was to get; None for any other file.

    >>> final_name(".index-0123456789abcdef.html"), final_name(".gitignore")
    ('index.html', None)
    """
    found = _TEMPORARY.fullmatch(name)
    return found and found["stem"] + (found["suffix"] or "")
