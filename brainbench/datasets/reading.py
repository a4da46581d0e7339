"""Find recording files and read their sessions: from what a user names to what is counted.

A source names files, and perhaps the layout to read them by. Each file is opened, described as sessions, and every
session is adapted by its layout.
"""

from __future__ import annotations

import glob
import os
import re
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING

import h5py

from brainbench.core.errors import (
    DataError,
    DataFileNotFoundError,
    UsageError,
    brief,
    check_kind,
    nearest,
    unknown_name,
)
from brainbench.core.plugins import load_optional
from brainbench.core.reading.hdf5 import open_hdf5
from brainbench.core.reading.regular import check_file, user_path
from brainbench.core.reading.texts import read_text
from brainbench.datasets import hdf5, nwb, rdm_files, temporaldata
from brainbench.datasets.layouts.registry import (
    ENTRY_POINTS,
    detect_layout,
    get_layout,
    is_name,
    list_layouts,
    load_layout,
)
from brainbench.datasets.ledger import Ledger
from brainbench.datasets.trials.selection import DEFAULT, EVERYTHING, Selection

if TYPE_CHECKING:
    from brainbench.datasets.layouts.registry import RecordingLayout
    from brainbench.datasets.sessions import Session

Source = str | os.PathLike[str] | Sequence[str | os.PathLike[str]]
"""A file, a folder, a glob, a list of these, or ``LAYOUT:PATH``."""

ENDINGS = (".nwb", ".h5", ".hdf5")  # endings searched for in a folder; other tools also leave `.h5` files beside NWB

_DEMOS = ("demo", "demo-rodgers")  # names of recordings that are made on first use, above this package
_SELECTIONS = {"none": EVERYTHING, "default": DEFAULT}


def find_recordings(source: Source, ledger: Ledger | None = None) -> tuple[RecordingLayout | None, list[Path]]:
    """Return the layout that a source names, if any, and its files; the ledger takes what looks like one and is not.

    ``LAYOUT:PATH`` names one, or ``FILE.py:PATH`` for a Python file that defines one. A prefix counts as a layout when
    it is a bare word of at least two letters (so drive letters stay paths) and no file of the whole name exists. Raises
    DataFileNotFoundError: the source names nothing; UsageError: it names an unknown layout, or a layout and no file.
    """
    check_kind("source of recordings", source, (str, os.PathLike, Sequence), "a file, folder, glob or list of these")
    prefix, colon, rest = source.partition(":") if isinstance(source, str) else ("", "", "")
    in_file = prefix.endswith(".py")
    if not (in_file or is_name(prefix)) or rest.startswith("//") or not colon or Path(str(source)).exists():
        return None, find_files(source, ledger)
    layout = load_layout(prefix) if in_file else None
    if not rest:
        raise UsageError(f"The source {source!r} names a layout but no file; write {prefix}:PATH.")
    return layout or get_layout(prefix), find_files(rest, ledger)


def find_files(source: Source, ledger: Ledger | None = None) -> list[Path]:
    """Return the recording files a source names, sorted and without repetition.

    A folder is searched at every depth for ``.nwb``, ``.h5`` and ``.hdf5``; hidden files are skipped.
    """
    items = [source] if isinstance(source, (str, os.PathLike)) else source
    ledger = Ledger() if ledger is None else ledger
    paths = sorted({path for item in items for path in _expand(os.fspath(item), ledger)}, key=str)
    ledger.find("files", len(paths))
    return paths


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
    return open_hdf5(path, "recording", "brainbench reads NWB 2.x, temporaldata and its own HDF5 layout.")


def suitable_files(paths: Sequence[Path], ledger: Ledger) -> list[Path]:
    """Return the files that hold sessions of spike times; the ledger takes each other one with a sentence.

    One file alone was meant, so it is kept whatever it holds: reading it says what is wrong.
    """
    if len(paths) < 2:
        return list(paths)
    suitable, reasons = [], []
    for path in paths:
        try:
            with open_file(path) as file:
                _check_kind(file, path)
            suitable.append(path)
        except DataError as error:
            # Other tools leave .h5 files beside NWB, which were no recordings to begin with.
            beside = path.suffix.lower() != ".nwb" and any(neighbour.suffix.lower() == ".nwb" for neighbour in paths)
            ledger.leave("files", str(error), lost=not (beside and path in ledger.incidental))
            reasons.append(str(error))
    if not suitable:
        raise DataError(f"None of {len(paths)} files holds recordings; the first: {reasons[0]}")
    return suitable


def each_session(
    file: h5py.File, path: Path, layout: RecordingLayout | None = None
) -> Iterator[tuple[Session, RecordingLayout | None]]:
    """Yield the sessions of an open file with the layout of each: the given one, else the one it is recognised by.

    A session comes as its layout adapts it. Read it while the file is open, inside the block of
    :func:`open_file`, which names the file if reading fails.
    """
    _check_kind(file, path)
    read = temporaldata.read_temporaldata if temporaldata.is_temporaldata(file) else nwb.read_nwb
    for session in hdf5.read_sessions(file, path) if hdf5.is_ours(file) else [read(file, path)]:
        session_layout = layout or detect_layout(session)
        yield (session if session_layout is None else session_layout.adapted(session)), session_layout


def _check_kind(file: h5py.File, path: Path) -> None:
    """Raise DataError unless an open file holds sessions of spike times, by its kind."""
    if hdf5.holds_counts(file, path):
        raise DataError(f"{path} holds counted responses, not sessions of spike times; open it alone.")
    if hdf5.is_ours(file) or nwb.is_nwb(file) or temporaldata.is_temporaldata(file):
        return
    if rdm_files.is_rdms(file):
        error = rdm_files.HoldsRDMsError(
            f"{path} holds RDMs without trials, whose noise nobody can estimate, so no score on it would be honest; "
            f"compare them with a model as they are: brainbench recordings compare {path} MODEL."
        )
        error.rdms = rdm_files.rdms_of(file, path)
        raise error
    inside = ", ".join(list(file)[:8]) or "nothing"
    raise DataError(
        f"{path} is HDF5 but neither NWB nor temporaldata nor the {hdf5.FORMAT} layout: it holds {inside}. "
        f"`brainbench.datasets.write_recordings` writes the layout."
    )


_ADDRESS = re.compile(r"([a-z][a-z0-9+.-]+):/", re.IGNORECASE)
_ARRAYS = (
    "arrays of a sorter (.npy); make sessions of them with brainbench.datasets.sessions.make_session and write these "
    "with brainbench.datasets.write_recordings (docs/recordings.md)"
)


def unread(path: Path) -> str:
    """Return one sentence on what looks like a recording and is none that can be read; empty for all else."""
    suffixes = {suffix.lower() for suffix in path.suffixes}
    if path.is_symlink() and not path.exists():
        if suffixes & {*ENDINGS, ".zarr"} or not suffixes or "annex" in os.fspath(path.readlink()):
            target = brief(os.fspath(path.readlink()))
            get = f"as git-annex and DataLad leave it: get the content first (datalad get {path.name})"
            return f"{path} is a link to {target}, which is not there, {get}."
    elif path.is_dir():
        if ".zarr" in suffixes or any((path / name).exists() for name in (".zgroup", ".zattrs", "zarr.json")):
            return f"{path} is a Zarr store; brainbench reads NWB in HDF5: convert it (pynwb: NWBHDF5IO.export)."
        if path.suffix.lower() == ".nwb":
            return f"{path} is a folder called .nwb, and no HDF5 file."
        if path.is_symlink() and any(item.suffix.lower() in ENDINGS for item in path.rglob("*")):
            return f"{path} is a link to a folder, which is not searched; name that folder too."
        if not any(path.iterdir()) and _is_subdataset(path.absolute()):
            return f"{path} is a data set of DataLad that is not there yet: get it first (datalad get {path.name})."
    elif suffixes & _LIKE and path.suffix.lower() not in ENDINGS:
        return f"{path} ends in {path.suffix}, which is not read; brainbench reads .nwb, .h5 and .hdf5."
    elif path.is_file() and not path.suffix and os.access(path, os.R_OK):
        with path.open("rb") as file:
            if file.read(8) == b"\x89HDF\r\n\x1a\n":
                return f"{path} is HDF5 and its name has no ending, so it is not read; call it {path.name}.nwb or .h5."
    return ""


def _is_subdataset(folder: Path) -> bool:
    """Return whether a folder is the place of a data set inside another one, as git keeps it."""
    for parent in folder.parents:
        if (modules := parent / ".gitmodules").is_file():
            return f"path = {folder.relative_to(parent).as_posix()}\n" in read_text(modules) + "\n"
    return False


_LIKE = {".nwb", ".hdf", ".he5", ".h5", ".hdf5", ".nix", ".plx", ".pl2", ".nev", ".abf", ".smr", ".smrx", ".mat"}
"""Endings, also inside a name such as ``a.nwb.gz``, of files that may hold recordings."""


def _search(folder: Path, ledger: Ledger) -> list[Path]:
    """Return the files of a folder that may be recordings, at every depth; the ledger takes what cannot be read."""
    files: list[Path] = []
    for entry in sorted(folder.iterdir()):
        if entry.name.startswith("."):
            continue
        if reason := unread(entry):
            ledger.find("files")
            ledger.leave("files", reason, lost=entry.suffix.lower() != ".mat")
        elif entry.is_dir():
            files += [] if entry.is_symlink() else _search(entry, ledger)
        elif entry.is_file() and entry.suffix.lower() in ENDINGS:
            files.append(entry)
    return files


def _refuse(source: str, path: Path) -> None:
    """Raise the error for a source that is no recording of this machine, or one of its arrays alone."""
    if (match := _ADDRESS.match(source)) and not path.exists():
        raise UsageError(
            f"{brief(source)} is an address of {match[1]}://, and recordings are read from files of this machine only: "
            "`brainbench recordings fetch` takes data sets of the DANDI archive; else download it first."
        )
    if path.suffix == ".npy":
        raise DataError(f"{path} is one of the {_ARRAYS}.")


def _expand(source: str, ledger: Ledger) -> list[Path]:
    path = user_path(source)
    _refuse(source, path)
    if path.is_file():
        return [path]
    if reason := unread(path):
        raise DataError(reason)
    if path.is_dir():
        files = _search(path, ledger)
        ledger.incidental.update(files)
        if not files:
            why = f" {ledger.skipped[0]}" if ledger.skipped else ""
            why = f" It holds {_ARRAYS}." if any(path.rglob("*.npy")) else why
            raise DataFileNotFoundError(f"The folder {source!r} holds no recordings (*.nwb, *.h5, *.hdf5).{why}")
        return files
    if glob.has_magic(source):
        matches = [Path(name) for name in sorted(glob.glob(str(path), recursive=True))]  # noqa: PTH207
        files = [match for match in matches if match.is_file()]
        for match in matches:
            reason = "" if match in files else unread(match)
            if not reason and match.is_dir() and "**" not in source and _search(match, Ledger()):
                reason = f"{match} is a folder with recordings, which the pattern does not reach; write {source!r}/**."
            if reason:
                ledger.find("files")
                ledger.leave("files", reason, lost=True)
        if not files:
            why = f" {ledger.skipped[0]}" if ledger.skipped else ""
            raise DataFileNotFoundError(f"The pattern {source!r} matches no file.{why}")
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
