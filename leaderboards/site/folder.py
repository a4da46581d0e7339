"""The folder of a built site: a build replaces and removes only what a build wrote.

``build-manifest.json`` lists each file with its SHA-256 hash. While a build is under way it lists the hashes before and
after, so that the next build also knows the files of one that was killed.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import msgspec

from brainbench.core.errors import DataError, UsageError
from brainbench.core.files import atomic_path, file_hash, read_json, writable, write_json
from brainbench.core.writing.locks import lock_folder
from brainbench.core.writing.temporaries import is_temporary, sweep

MANIFEST = "build-manifest.json"
_Hashes = dict[str, list[str]]
"""Path in the site → the hashes that a build may have given it."""


@contextmanager
def rebuilt(root: Path) -> Iterator[Callable[[str, str | bytes], Path]]:
    """Yield a function that takes a file of the new site: its path there and its content.

    The new files appear together when the block ends, the one given first last; after an error the old site is
    unchanged. Another build of the same folder waits until this one has ended.
    """
    check_site(root)
    with writable(root), lock_folder(root):
        known, present = check_site(root)
        for folder, _, _ in os.walk(root):
            sweep(Path(folder))
        _write(root, known)
        new: _Hashes = {}
        with ExitStack() as stack:

            def stage(name: str, content: str | bytes) -> Path:
                data = content.encode() if isinstance(content, str) else content
                stack.enter_context(atomic_path(root / name)).write_bytes(data)
                new[name] = [hashlib.sha256(data).hexdigest()]
                return root / name

            yield stage
            both = {name: known.get(name, []) + new.get(name, []) for name in known.keys() | new.keys()}
            _write(root, both)
        for name in present - new.keys():
            (root / name).unlink(missing_ok=True)
        _write(root, new)


def check_site(root: Path) -> tuple[_Hashes, set[str]]:
    """Return what the manifest of a folder lists and which of it is there."""
    if root.is_file() or root.suffix.lower() in (".html", ".htm"):
        raise UsageError(
            f"A leaderboard is a folder; received {str(root)!r}. For a single page use: brainbench leaderboard report"
        )
    known, present = _read(root), set()
    for name in sorted(_files(root)):
        path = root / name
        temporary = is_temporary(path.name) and (known is not None or name.startswith(f".{Path(MANIFEST).stem}-"))
        if name == MANIFEST or (temporary and not path.is_symlink()):
            continue
        listed = (known or {}).get(name, [])
        if path.is_symlink() or not path.is_file() or file_hash(path, length=64) not in listed:
            what = "was changed since the last build" if listed else "no build of a leaderboard wrote"
            raise UsageError(f"The folder {str(root)!r} holds {name[-80:]!r}, which {what}; name a new folder.")
        present.add(name)
    return known or {}, present


def _files(root: Path) -> Iterator[str]:
    """Yield the paths of all files and links below a folder; links are not followed."""
    for folder, folders, files in os.walk(root):
        links = [name for name in folders if (Path(folder) / name).is_symlink()]
        yield from ((Path(folder) / name).relative_to(root).as_posix() for name in (*files, *links))


def _read(root: Path) -> _Hashes | None:
    """Return what the manifest lists; None without one, so that nothing counts as ours."""
    path = root / MANIFEST
    if not os.path.lexists(path):
        return None
    try:
        return msgspec.convert(read_json(path, "manifest of a build"), _Hashes)
    except msgspec.ValidationError as error:
        raise DataError(f"{str(path)!r} is no manifest of a build ({error}); give a new folder.") from error


def _write(root: Path, hashes: _Hashes) -> None:
    write_json(root / MANIFEST, {name: sorted(set(hashes[name])) for name in hashes})
