"""Result records on disk: one JSON file per score, named by what it says.

A file is called ``<readable name>--<content hash>.json`` (:attr:`ResultRecord.file_name`). The hash covers
everything but time, machine and package versions, so equal results have equal names, folders of records merge
by copying files, and a record edited by hand no longer fits its name. The hash detects slips and careless
edits; it is no signature against someone who renames the file as well.
"""

from __future__ import annotations

import hashlib
import os
from array import array
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import msgspec

from brainbench.core.errors import DataError, DataFileNotFoundError
from brainbench.core.files import write_text
from brainbench.core.reading.texts import parse_json, read_text
from brainbench.core.records import ResultRecord, Score, record_identity
from brainbench.core.runs.jobs import run_jobs

SCHEMA_PATH = Path(__file__).with_name("record.schema.json")
"""The published JSON Schema (draft 2020-12) of one record file, shipped with the package."""
BATCH = 250  # records that one process reads at a time
MAKE_ONE = "make one with: brainbench score MODEL --out FOLDER"


@dataclass(frozen=True)
class StoredRecord:
    """A record file: either a usable record, or what is wrong with the file."""

    path: Path
    record: ResultRecord | None
    problem: str | None = None
    """One sentence; None exactly when ``record`` can be used."""
    digest: str = ""
    """SHA-256 of the file's text where ``record`` is :func:`lightened`; empty where it is whole."""

    @property
    def text(self) -> str:
        """Content of the file, the same as when the record was read."""
        if not self.digest:
            return f"{self.record.to_json()}\n" if self.record else ""
        text = read_text(self.path, "result record")
        if _digest(text) != self.digest:
            raise DataError(f"{self.path.name!r} changed while it was read; wait until it is complete.")
        return text

    @property
    def whole(self) -> ResultRecord | None:
        """The record with all that it holds, read from the file again where it is lightened."""
        if not self.digest or self.record is None:
            return self.record
        record = msgspec.json.decode(self.text, type=ResultRecord)
        record.__dict__["identity"] = self.record.identity
        return record


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
    """Read one record."""
    return _read(Path(path))[0]


def _read(path: Path) -> tuple[ResultRecord, str]:
    """Return the record of a file and the hash of its text."""
    text = read_text(path, "result record")
    record, data = _parse(text, path)
    # The hash is that of what the file says: a field that an earlier writer did not know is not in it.
    identity = record_identity(data)
    digest = path.stem.rpartition("--")[2]
    if digest != identity:
        raise DataError(
            f"{path.name!r} was edited or renamed: its content has the hash {identity}, its name says "
            f"{digest!r}; restore the original file or score the model again."
        )
    record.__dict__["identity"] = identity  # cached, since to find it again takes as long as all else
    return record, _digest(text)


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def lightened(record: ResultRecord, shared: dict[object, Any]) -> ResultRecord:
    """Return a record without what boards do not show: diagrams, and the RDMs of baselines but the raw input.

    The RDMs that stay are compact: those of thousands of records are gigabytes. ``shared`` holds what is equal in
    several of them.
    """

    def packed(numbers: Sequence[float]) -> array[float]:
        """Return numbers as a compact array of doubles, the same one for equal numbers."""
        values = array("d", numbers)
        return shared.setdefault(values.tobytes(), values)

    def light(score: Score, **rdms: Sequence[float]) -> Score:
        """Return a score without its RDMs but for those given."""
        small = replace(
            score, model_rdm=(), brain_rdm=(), stimuli=shared.setdefault(score.stimuli, score.stimuli),
            **({} if score is record.score else {"layers": (), "provenance": {}}),
        )  # fmt: skip
        key = None if score is record.score else (msgspec.msgpack.encode(small), *map(tuple, rdms.values()))
        for name, rdm in rdms.items():
            object.__setattr__(small, name, packed(rdm))
        return small if key is None else shared.setdefault(key, small)

    small = replace(
        record,
        score=light(record.score, model_rdm=record.score.model_rdm, brain_rdm=record.score.brain_rdm),
        animal_to_animal=record.animal_to_animal and light(record.animal_to_animal),
        baselines={
            name: light(part, **({"model_rdm": part.model_rdm} if name == "raw input" else {}))
            for name, part in record.baselines.items()
        },
        card=record.card and replace(record.card, graph=None),
    )
    small.__dict__["identity"] = record.identity
    return small


def record_files(folder: Path) -> list[Path]:
    """Return the record files of a folder and its sub-folders, sorted."""
    # A hidden name is another process's unfinished write.
    return sorted(path for path in folder.rglob("*.json") if not path.name.startswith("."))


def read_records(
    source: str | os.PathLike[str] | Iterable[str | os.PathLike[str]], *, light: bool = False
) -> list[StoredRecord]:
    """Read every record of a folder (with its sub-folders), a file, or a list of either.

    A file that cannot be used comes back with its problem in words instead of ending the whole
    reading. Files in two places with the same content count once. Sorted by path. ``light`` records
    are :func:`lightened`, for boards of thousands.
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
    ordered = sorted(set(paths))
    batches = [ordered[start : start + BATCH] for start in range(0, len(ordered), BATCH)]
    workers = None if light and len(batches) > 3 else 1  # other processes take some seconds to start
    parts = dict(run_jobs(partial(_read_all, light=light), batches, workers=workers))
    stored: dict[str, StoredRecord] = {}
    for place in reversed(range(len(batches))):  # of equal ones the first counts
        stored |= parts[place]
    return sorted(stored.values(), key=lambda record_file: record_file.path)


def _read_all(paths: Sequence[Path], *, light: bool) -> dict[str, StoredRecord]:
    stored, shared = {}, {}
    for path in paths:
        try:
            record, digest = _read(path)
        except DataError as error:
            stored[os.fspath(path)] = StoredRecord(path, None, str(error))
            continue
        if record.identity not in stored:
            small = StoredRecord(path, lightened(record, shared), digest=digest) if light else None
            stored[record.identity] = small or StoredRecord(path, record)
    return stored


def _parse(text: str, path: Path) -> tuple[ResultRecord, dict[str, Any]]:
    data = parse_json(text, path.name)
    try:
        record = ResultRecord.from_json(data)
    except DataError as error:
        raise DataError(f"{path.name!r} is no result record that can be used: {str(error)[:400]}") from error
    return record, data
