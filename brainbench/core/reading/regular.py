"""Guards of opening: a regular file of bounded size; and how the failure of a library is told in one sentence."""

from __future__ import annotations

import contextlib
import os
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path

from brainbench.core.errors import BrainbenchError, DataError, DataFileNotFoundError, UsageError, brief, nearest

MOST_TEXT = 64 << 20  # bytes of a text file that is parsed; nested lists take about twenty times as much memory
MOST_TABLE = 256 << 20  # bytes of a table of comma-separated numbers
MOST_PART = 512 << 20  # bytes of a file that another names: a mesh, a buffer, a picture


def user_path(path: str | os.PathLike[str]) -> Path:
    """Return the path that a user wrote; ``~`` is a home folder."""
    try:
        return Path(path).expanduser()
    except RuntimeError as error:
        name = brief(os.fspath(path))
        raise UsageError(f"{name} begins with the ~ of a user that there is not; write the folder out.") from error


def temporary_folder() -> tempfile.TemporaryDirectory[str]:
    """Make a folder for temporary files, which goes with its context or its :meth:`cleanup`."""
    try:
        return tempfile.TemporaryDirectory(prefix="brainbench-", ignore_cleanup_errors=True)
    except FileNotFoundError as error:
        # No fault of a file that is read.
        raise BrainbenchError("No folder for temporary files has room; name one with TMPDIR.") from error


def check_file(path: str | os.PathLike[str], kind: str = "file", *, most: int | None = None) -> Path:
    """Return the path of a regular file that can be opened without waiting.

    Args:
        path: what the user named.
        kind: what it shall be, in words.
        most: largest size in bytes.
    """
    name, file = brief(os.fspath(path)), user_path(path)
    try:
        status = file.stat()
    except (FileNotFoundError, NotADirectoryError) as error:
        guess = None
        with contextlib.suppress(OSError):
            guess = nearest(file.name, (item.name for item in file.parent.iterdir() if item.suffix == file.suffix))
        hint = f"; did you mean {brief(str(Path(path).with_name(guess)))}?" if guess else "."
        raise DataFileNotFoundError(f"There is no {kind} {name}{hint}") from error
    except (OSError, ValueError) as error:
        raise DataError(f"The {kind} {name} cannot be opened ({reason(error)}).") from error
    if stat.S_ISDIR(status.st_mode):
        raise DataError(f"{name} is a folder; a {kind} is needed: name a file in it.")
    # To open a FIFO waits for a writer, and some devices never end.
    if not stat.S_ISREG(status.st_mode):
        raise DataError(f"{name} is a pipe or a device; a {kind} is needed: copy its content into a file.")
    if most is not None and status.st_size > most:
        raise DataError(f"{name} has {status.st_size:,} bytes; a {kind} of at most {most:,} bytes is read.")
    if not os.access(file, os.R_OK):
        raise DataError(f"{name} may not be read by this user; change its permissions.")
    return file


def part_of(folder: Path, name: str, kind: str = "file") -> Path:
    """Return where a file is that one in ``folder`` names: a regular one of bounded size, in that folder.

    The folder above counts too where the name begins with ``../``: packages of robots keep meshes beside descriptions.
    """
    place, above = folder / name, Path(name).parts[:1] == ("..",)
    root = folder.resolve().parent if above else folder.resolve()
    if not place.resolve().is_relative_to(root):
        raise DataError(f"{brief(name)} lies outside the folder {brief(str(folder))} of what names it; copy it there.")
    return check_file(place, kind, most=MOST_PART)


def reason(error: BaseException) -> str:
    """Return why something failed: the first line of an error, short, with its type unless it is about the file."""
    if isinstance(error, OSError) and error.strerror and error.errno:
        return error.strerror
    text = ""
    with contextlib.suppress(Exception):  # an error of foreign code may fail to describe itself
        text = next(iter(str(error).strip().splitlines()), "")
    plain = isinstance(error, (OSError, UnicodeDecodeError)) or type(error).__name__.endswith("DecodeError")
    words = text if plain else f"{type(error).__name__}: {text}"
    return brief(words.removesuffix(": "), quoted=False, most=160)


@contextlib.contextmanager
def readable(path: str | os.PathLike[str], kind: str, hint: str = "") -> Iterator[None]:
    """Turn every failure inside the block into one :class:`DataError` that names the file.

    Libraries raise anything at all on damaged input; our own errors pass as they are, and the cause is kept.
    """
    name = brief(os.fspath(path))
    try:
        yield
    except BrainbenchError:
        raise
    except MemoryError as error:
        raise DataError(f"{name} declares more data than there is memory; it is damaged or no {kind}.") from error
    except RecursionError as error:
        raise DataError(f"{name} is nested too deeply for a {kind}.") from error
    except Exception as error:
        raise DataError(f"{name} is not a readable {kind} ({reason(error)}).{hint and ' ' + hint}") from error
