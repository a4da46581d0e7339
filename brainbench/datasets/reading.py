"""Find recording files and read their sessions: from what a user names to what is counted.

A source names files, and perhaps the layout to read them by. Each file is opened, described as sessions, and every
session is adapted by its layout.
"""

from __future__ import annotations

import glob
import os
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING

from brainbench.core.errors import DataError, DataFileNotFoundError, UsageError, brief, nearest, unknown_name
from brainbench.core.plugins import load_optional
from brainbench.core.reading.hdf5 import open_hdf5
from brainbench.core.reading.regular import check_file
from brainbench.datasets import hdf5, nwb
from brainbench.datasets.layouts.registry import (
    ENTRY_POINTS,
    detect_layout,
    get_layout,
    is_name,
    list_layouts,
    load_layout,
)
from brainbench.datasets.trials.selection import DEFAULT, EVERYTHING, Selection

if TYPE_CHECKING:
    import h5py

    from brainbench.datasets.layouts.registry import RecordingLayout
    from brainbench.datasets.sessions import Session

Source = str | os.PathLike[str] | Sequence[str | os.PathLike[str]]
"""A file, a folder, a glob, a list of these, or ``LAYOUT:PATH``."""

SUFFIXES = ((".nwb",), (".h5", ".hdf5"))
"""Endings searched for in a folder, in this order; other tools also leave ``.h5`` files beside NWB."""

_DEMOS = ("demo", "demo-rodgers")
"""Names of recordings that are made on first use, above this package."""
_SELECTIONS = {"none": EVERYTHING, "default": DEFAULT}


def find_recordings(source: Source) -> tuple[RecordingLayout | None, list[Path]]:
    """Return the layout that a source names, if any, and its files.

    ``LAYOUT:PATH`` names one, or ``FILE.py:PATH`` for a Python file that defines one. A prefix counts as a layout when
    it is a bare word of at least two letters (so drive letters stay paths) and no file of the whole name exists. Raises
    DataFileNotFoundError: the source names nothing; UsageError: it names an unknown layout, or a layout and no file.
    """
    if not isinstance(source, (str, os.PathLike, Sequence)):
        raise UsageError(f"Recordings are a file, a folder, a glob or a list of these; received {brief(source)}.")
    prefix, colon, rest = source.partition(":") if isinstance(source, str) else ("", "", "")
    in_file = prefix.endswith(".py")
    if not colon or not (in_file or is_name(prefix)) or Path(str(source)).exists():
        return None, find_files(source)
    layout = load_layout(prefix) if in_file else None
    if not rest:
        raise UsageError(f"The source {source!r} names a layout but no file; write {prefix}:PATH.")
    if rest in _DEMOS:
        raise UsageError(f"The demo recordings have a layout of their own; write {rest!r} without {prefix}:.")
    return layout or get_layout(prefix), find_files(rest)


def find_files(source: Source) -> list[Path]:
    """Return the recording files a source names, sorted and without repetition.

    A folder is searched at every depth for ``.nwb`` and, if it has none, for ``.h5`` and ``.hdf5``; hidden files are
    skipped.

    Raises:
        DataFileNotFoundError: a path does not exist, or a folder or glob holds no recording file.
    """
    items = [source] if isinstance(source, (str, os.PathLike)) else source
    return sorted({path for item in items for path in _expand(os.fspath(item))}, key=str)


def resolve_selection(select: Selection | str) -> Selection:
    """Return a selection from itself, a name ("none", "default" or a layout's) or rules in text."""
    if isinstance(select, Selection):
        return select
    if select in _SELECTIONS:
        return _SELECTIONS[select]
    if select in list_layouts():
        return get_layout(select).selection
    if "=" not in select:
        names = [*_SELECTIONS, *list_layouts()]
        raise unknown_name("selection", select, names, hint="Or write rules: 'outcome=correct; units.layer=4'.")
    return Selection.parse(select)


def open_file(path: Path) -> AbstractContextManager[h5py.File]:
    """Open an HDF5 file for reading; failures inside the block name the file too."""
    if path.suffix.lower() == ".npz":
        load_optional(ENTRY_POINTS, "published-npz", "layout of .npz recordings")
        raise DataError(
            f"{path} is an .npz file: published recordings are opened one at a time and without a layout, to be "
            "inspected, checked and scored; they hold no spike times to join or copy."
        )
    return open_hdf5(path, "recording", "brainbench reads NWB 2.x and its own HDF5 layout.")


def suitable_files(paths: Sequence[Path], *, strict: bool = False) -> tuple[list[Path], list[str]]:
    """Return the files that hold sessions of spike times, and for each other file a sentence that says why not.

    One file alone was meant, so it is kept whatever it holds: reading it says what is wrong.
    """
    if len(paths) < 2:
        return list(paths), []
    readable, skipped = [], []
    for path in paths:
        try:
            with open_file(path) as file:
                _check_kind(file, path)
            readable.append(path)
        except DataError as error:
            if strict:
                raise
            skipped.append(str(error))
    if not readable:
        raise DataError(f"None of {len(paths)} files holds recordings; the first: {skipped[0]}")
    return readable, skipped


def each_session(
    file: h5py.File, path: Path, layout: RecordingLayout | None = None
) -> Iterator[tuple[Session, RecordingLayout | None]]:
    """Yield the sessions of an open file with the layout of each: the given one, else the one it is recognised by.

    A session comes as its layout adapts it. Read it while the file is open, inside the block of
    :func:`open_file`, which names the file if reading fails.
    """
    _check_kind(file, path)
    for session in hdf5.read_sessions(file, path) if hdf5.is_ours(file) else [nwb.read_nwb(file, path)]:
        session_layout = layout or detect_layout(session)
        yield (session if session_layout is None else session_layout.adapted(session)), session_layout


def _check_kind(file: h5py.File, path: Path) -> None:
    """Raise DataError unless an open file holds sessions of spike times, by its kind."""
    if hdf5.holds_counts(file, path):
        raise DataError(f"{path} holds counted responses, not sessions of spike times; open it alone.")
    if hdf5.is_ours(file) or nwb.is_nwb(file):
        return
    inside = ", ".join(list(file)[:8]) or "nothing"
    raise DataError(
        f"{path} is HDF5 but neither NWB nor the {hdf5.FORMAT} layout: it holds {inside}. "
        f"`brainbench.datasets.write_recordings` writes the layout."
    )


def _expand(source: str) -> list[Path]:
    path = Path(source).expanduser()
    if path.is_file():
        return [path]
    if path.is_dir():
        inside = [item for item in path.rglob("*") if item.is_file()]
        visible = [item for item in inside if not any(part.startswith(".") for part in item.relative_to(path).parts)]
        for endings in SUFFIXES:
            if files := [item for item in visible if item.suffix.lower() in endings]:
                return files
        raise DataFileNotFoundError(f"The folder {source!r} holds no recordings (*.nwb, *.h5, *.hdf5).")
    if glob.has_magic(source):
        matches = map(Path, glob.glob(str(path), recursive=True))  # noqa: PTH207 (absolute patterns)
        if not (files := [item for item in matches if item.is_file()]):
            raise DataFileNotFoundError(f"The pattern {source!r} matches no file.")
        return files
    if source in _DEMOS:
        raise UsageError(
            f"The demo recordings are made from simulated stimuli on first use: ask for recordings={source!r} in "
            "brainbench.score, or pass the folder that brainbench.scoring.demo.demo_recordings returns."
        )
    if path.exists():
        check_file(path, "file of recordings")
    siblings = [item.name for item in path.parent.iterdir()] if path.parent.is_dir() else []
    guess = nearest(path.name, siblings)
    raise DataFileNotFoundError(f"There is no file {source!r}{f'; did you mean {guess!r}?' if guess else '.'}")
