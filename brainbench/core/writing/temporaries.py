"""Names of temporary files and folders, which say who writes them, so that those of killed processes are swept.

``.STEM-TOKEN.SUFFIX``: the token's 16 hexadecimal digits are 4 of the machine, 6 of the process and 6 at random.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import platform
import re
import secrets
import shutil
from functools import lru_cache
from pathlib import Path

_TEMPORARY = re.compile(r"\..+-(?P<machine>[0-9a-f]{4})(?P<process>[0-9a-f]{6})[0-9a-f]{6}(\.[^.]*)?")


def temporary_path(target: Path) -> Path:
    """Return a new name beside ``target``, with its suffix; what dead processes left in the folder is removed."""
    _sweep_once(target.parent, os.getpid())
    token = f"{_machine()}{os.getpid() % 0x1000000:06x}{secrets.token_hex(3)}"
    return target.with_name(f".{target.stem[:200]}-{token}{target.suffix}")


def is_temporary(name: str) -> bool:
    """Return whether a file of this name is one that is being written, or was when its process was killed."""
    return _TEMPORARY.fullmatch(name) is not None


@lru_cache(maxsize=1024)
def _sweep_once(folder: Path, process: int) -> None:
    # To list a folder of thousands of records for each of them would take minutes.
    del process
    sweep(folder)


def sweep(folder: Path) -> None:
    """Remove from a folder what processes of this machine left that run no more."""
    if os.name != "posix":
        return
    with contextlib.suppress(OSError):
        for entry in os.scandir(folder):
            match = _TEMPORARY.fullmatch(entry.name)
            if match is None or match["machine"] != _machine() or _runs(int(match["process"], 16)):
                continue
            if entry.is_dir(follow_symlinks=False):
                shutil.rmtree(entry.path, ignore_errors=True)
            else:
                with contextlib.suppress(OSError):
                    Path(entry.path).unlink()


@lru_cache(maxsize=1)
def _machine() -> str:
    """Return four digits of this machine; a container has process numbers of its own and counts as another one."""
    space = ""
    with contextlib.suppress(OSError):
        space = str(Path("/proc/self/ns/pid").readlink())
    return hashlib.sha256(f"{platform.node()} {space}".encode()).hexdigest()[:4]


def _runs(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True
