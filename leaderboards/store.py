"""Result records on disk: one JSON file per score, named by what it says.

A file is called ``<readable name>--<content hash>.json`` (:attr:`ResultRecord.file_name`). The hash covers
everything but time, machine and package versions, so equal results have equal names, folders of records merge
by copying files, and a record edited by hand no longer fits its name. The hash detects slips and careless
edits; it is no signature against someone who renames the file as well.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from brainbench.core.errors import DataError, DataFileNotFoundError
from brainbench.core.files import write_text
from brainbench.core.reading.texts import parse_json, read_text
from brainbench.core.records import ResultRecord, record_identity

SCHEMA_PATH = Path(__file__).with_name("record.schema.json")
"""The published JSON Schema (draft 2020-12) of one record file, shipped with the package."""
MAKE_ONE = "make one with: brainbench score MODEL --out FOLDER"


@dataclass(frozen=True)
class StoredRecord:
    """A record file: either a usable record, or what is wrong with the file."""

    path: Path
    record: ResultRecord | None
    problem: str | None = None
    """One sentence; None exactly when ``record`` can be used."""


def write_record(record: ResultRecord, folder: str | os.PathLike[str]) -> Path:
    """Write a record into ``folder`` and return its path.

    Atomic, so that concurrent writers lose nothing. Idempotent: an equal result that is already
    there is left as it is (with its first time and machine); a damaged file of that name is replaced.
    """
    path, text = Path(folder) / record.file_name, record_text(record)
    try:
        read_record(path)
    except DataError:  # absent, damaged or edited
        write_text(path, text)
    return path


def record_text(record: ResultRecord) -> str:
    """Return the content of a record's file; raise DataError if the record contradicts itself."""
    text = record.to_json() + "\n"
    _parse(text, Path(record.file_name))
    return text


def read_record(path: str | os.PathLike[str]) -> ResultRecord:
    """Read one record.

    Raises:
        DataFileNotFoundError: there is no such file.
    """
    path = Path(path)
    record, data = _parse(read_text(path, "result record"), path)
    # The hash is that of what the file says: a field that an earlier writer did not know is not in it.
    identity = record_identity(data)
    digest = path.stem.rpartition("--")[2]
    if digest != identity:
        raise DataError(
            f"{path.name!r} was edited or renamed: its content has the hash {identity}, its name says "
            f"{digest!r}; restore the original file or score the model again."
        )
    return record


def record_files(folder: Path) -> list[Path]:
    """Return the record files of a folder and its sub-folders, sorted."""
    # A hidden name is another process's unfinished write.
    return sorted(path for path in folder.rglob("*.json") if not path.name.startswith("."))


def read_records(source: str | os.PathLike[str] | Iterable[str | os.PathLike[str]]) -> list[StoredRecord]:
    """Read every record of a folder (with its sub-folders), a file, or a list of either.

    A file that cannot be used comes back with its problem in words instead of ending the whole
    reading. Files in two places with the same content count once. Sorted by path.

    Raises:
        DataFileNotFoundError: a path does not exist, or nothing was found at all.
    """
    sources = [Path(source)] if isinstance(source, (str, os.PathLike)) else [Path(item) for item in source]
    paths: list[Path] = []
    for place in sources:
        if not place.exists():
            raise DataFileNotFoundError(f"There is no file or folder {os.fspath(place)!r} of records; {MAKE_ONE}")
        paths += record_files(place) if place.is_dir() else [place]
    if not paths:
        places = ", ".join(repr(os.fspath(item)) for item in sources) or "the empty list of files"
        raise DataFileNotFoundError(f"No result records (*.json) in {places}; {MAKE_ONE}")
    stored: dict[str, StoredRecord] = {}
    for path in sorted(set(paths)):
        try:
            record = read_record(path)
        except DataError as error:
            stored[os.fspath(path)] = StoredRecord(path, None, str(error))
        else:
            stored.setdefault(record.identity, StoredRecord(path, record))
    return list(stored.values())


def _parse(text: str, path: Path) -> tuple[ResultRecord, dict[str, Any]]:
    data = parse_json(text, path.name)
    try:
        record = ResultRecord.from_json(data)
    except DataError as error:
        raise DataError(f"{path.name!r} is no result record that can be used: {str(error)[:400]}") from error
    return record, data
