"""Files and folders that only their user can read, whatever the umask: keys, salts, held-out recordings."""

from __future__ import annotations

import os
from pathlib import Path

from brainbench.core.writing.temporaries import temporary_path


def private_folder(path: Path) -> Path:
    """Return a folder that only its user can enter, made if it is missing."""
    path.mkdir(parents=True, exist_ok=True, mode=0o700)
    path.chmod(0o700)
    return path


def write_private(path: Path, content: bytes, *, replace: bool = True) -> None:
    """Write a file that only its user can read, as a whole, into a folder that only its user can enter.

    Without ``replace`` a file that is there stays, also one that another process writes at the same time.
    """
    private_folder(path.parent)
    temporary = temporary_path(path)
    try:
        with os.fdopen(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600), "wb") as stream:
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
        if replace:
            temporary.replace(path)
        elif not os.path.lexists(path):
            _link(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _link(temporary: Path, path: Path) -> None:
    try:
        os.link(temporary, path)
    except FileExistsError:
        return
    except OSError:  # a file system without hard links
        temporary.replace(path)
