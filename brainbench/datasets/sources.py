"""Find recording files and open them: a file, a folder, a glob or a list of these."""

from __future__ import annotations

import contextlib
import glob
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from brainbench.core.errors import DataError, DataFileNotFoundError, UsageError, nearest
from brainbench.datasets import hdf5, nwb
from brainbench.datasets.sessions import Session

if TYPE_CHECKING:
    import h5py

SUFFIXES = ((".nwb",), (".h5", ".hdf5"))
"""Endings searched for in a folder, in this order; other tools also leave ``.h5`` files beside NWB."""


def find_files(source: str | os.PathLike[str] | Iterable[str | os.PathLike[str]]) -> list[Path]:
    """Return the recording files a source names, sorted and without repetition.

    A folder is searched at every depth for ``.nwb`` and, if it has none, for ``.h5`` and ``.hdf5``;
    hidden files are skipped.

    Raises:
        DataFileNotFoundError: a path does not exist, or a folder or glob holds no recording file.
    """
    if isinstance(source, (str, os.PathLike)):
        return sorted(set(_expand(os.fspath(source))), key=str)
    return sorted({path for item in source for path in _expand(os.fspath(item))}, key=str)


def _expand(source: str) -> list[Path]:
    path = Path(source).expanduser()
    if path.is_file():
        return [path]
    if path.is_dir():
        visible = [item for item in path.rglob("*") if _visible(item, path)]
        for endings in SUFFIXES:
            if found := [item for item in visible if item.suffix.lower() in endings]:
                return found
        raise DataFileNotFoundError(f"The folder {source!r} holds no recordings (*.nwb, *.h5, *.hdf5).")
    if glob.has_magic(source):
        found = [
            Path(item)
            for item in glob.glob(str(path), recursive=True)  # noqa: PTH207 (absolute patterns)
            if Path(item).is_file()
        ]
        if not found:
            raise DataFileNotFoundError(f"The pattern {source!r} matches no file.")
        return found
    if source == "demo":
        raise UsageError(
            "The demo recordings are made from simulated stimuli on first use: ask for recordings='demo' in "
            "brainbench.score, or pass the folder that brainbench.datasets.synthetic.demo.ensure_demo returns."
        )
    siblings = [item.name for item in path.parent.iterdir()] if path.parent.is_dir() else []
    guess = nearest(path.name, siblings)
    raise DataFileNotFoundError(f"There is no file {source!r}{f'; did you mean {guess!r}?' if guess else '.'}")


def _visible(path: Path, root: Path) -> bool:
    return path.is_file() and not any(part.startswith(".") for part in path.relative_to(root).parts)


@contextlib.contextmanager
def open_file(path: Path) -> Iterator[h5py.File]:
    """Open an HDF5 file for reading; failures inside the block name the file too.

    Raises:
        DataError: the file is not HDF5, is truncated or is damaged.
    """
    import h5py

    if not os.access(path, os.R_OK):
        raise DataError(f"{path} may not be read by this user; change its permissions.")
    if not h5py.is_hdf5(path):
        raise DataError(
            f"{path} is not an HDF5 file{_why_not(path)}; brainbench reads NWB 2.x and its own HDF5 layout."
        )
    try:
        with h5py.File(path, "r") as file:
            yield file
    except (OSError, RuntimeError) as error:
        if isinstance(error, DataError):
            raise
        reason = str(error).strip().splitlines()[0]
        if "unable to lock" in reason:
            raise DataError(f"{path} is open for writing in another program ({reason}); close it there.") from error
        if "truncated" in reason:
            raise DataError(
                f"{path} is truncated: the file is shorter than its HDF5 header says; copy it again."
            ) from error
        raise DataError(f"{path} cannot be read, it seems damaged ({reason}); copy it again.") from error


def read_file(file: h5py.File, path: Path) -> list[Session]:
    """Describe the sessions of an open file of spike times.

    Raises:
        DataError: it is neither NWB 2.x nor our layout, or holds responses that are already counted.
    """
    if hdf5.is_ours(file):
        if hdf5.read_kind(file, path) == "counts":
            raise DataError(f"{path} holds counted responses, not sessions of spike times; open it alone.")
        return hdf5.read_sessions(file, path)
    if nwb.is_nwb(file):
        return [nwb.read_nwb(file, path)]
    inside = ", ".join(list(file)[:8]) or "nothing"
    raise DataError(
        f"{path} is HDF5 but neither NWB nor the {hdf5.FORMAT} layout: it holds {inside}. "
        f"`brainbench.datasets.write_recordings` writes the layout."
    )


def _why_not(path: Path) -> str:
    size = path.stat().st_size
    if size == 0:
        return " (it is empty)"
    with path.open("rb") as stream:
        head = stream.read(64)
    if head.startswith((b"version https://git-lfs", b"/annex/", b"../../.git/annex")):
        return " but a pointer that git-lfs or git-annex left in its place; fetch the content first"
    return ""
