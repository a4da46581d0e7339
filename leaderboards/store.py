"""Result records on disk: one JSON file per score, named by what it says.

A file is called ``<readable name>--<content hash>.json`` (:attr:`ResultRecord.file_name`). The hash covers
everything but time, machine and package versions, so equal results have equal names, folders of records merge
by copying files, and a record edited by hand no longer fits its name. The hash detects slips and careless
edits; it is no signature against someone who renames the file as well.
"""

from __future__ import annotations

import inspect
import math
import os
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import msgspec

from brainbench.core.errors import DataError, DataFileNotFoundError
from brainbench.core.files import write_text
from brainbench.core.reading.texts import parse_json, read_text
from brainbench.core.records import RECORD_SCHEMA, Interval, ResultRecord, Score, record_identity

SCHEMA_PATH = Path(__file__).with_name("record.schema.json")
"""The published schema, shipped with the package."""


@cache
def record_schema() -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of one record file. The result is shared: do not change it."""
    schema = msgspec.json.schema(ResultRecord)
    for definition in schema["$defs"].values():
        definition["description"] = inspect.cleandoc(definition["description"]).split("\n\n")[0].replace("\n", " ")
        definition["additionalProperties"] = False
        for described in definition["properties"].values():
            described.pop("default", None)  # NaN among them, which JSON does not have
    schema["$defs"]["ResultRecord"]["required"].append("schema")
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "$id": f"urn:brainbench:result-record:{RECORD_SCHEMA}",
        "title": "brainbench result record",
        **schema,
    }


_ROUNDING = 1e-6
_LARGEST = 1e100
"""Largest absolute number of a score: squares and sums of such are still finite."""
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
        raise DataError(f"{path.name!r} is not a result record: {str(error)[:400]}") from error
    for score in (record.score, record.animal_to_animal, *record.baselines.values()):
        contradiction = _contradiction(score) if score else None
        if score and contradiction:
            raise DataError(f"{path.name!r} contradicts itself: in the score {score.name[:80]!r}, {contradiction}.")
    return record, data


def _contradiction(score: Score) -> str | None:
    """Return what cannot be true at once, or None. These rules are beyond what JSON Schema can say."""
    if math.isnan(score.value) != (score.status == "undefined"):
        return f"the status is {score.status!r} but the value is {score.value}"
    count = len(score.stimuli)
    pairs = count * (count - 1) // 2
    for name, wanted in (("model_rdm", pairs), ("brain_rdm", pairs), ("without_stimulus", count)):
        length = len(getattr(score, name))
        if length not in (0, wanted):
            what = "values" if name == "without_stimulus" else "pairs"
            return f"{name} has {length} {what} but {count} stimuli make {wanted}"
    for name in ("interval", "reliability_interval"):
        interval: Interval | None = getattr(score, name)
        if interval and interval.low > interval.high:
            return f"{name} runs from {interval.low} down to {interval.high}"
    return _out_of_range(score)


def _out_of_range(score: Score) -> str | None:
    """Return the first number that no score can have, in words, or None; NaN is a number without value."""
    if score.p < score.p_smallest * (1 - 1e-9):
        return f"p is {score.p} but the smallest possible is {score.p_smallest}"
    if score.reliability > 1 + _ROUNDING or any(one.reliability > 1 + _ROUNDING for one in score.subjects):
        return "a reliability is above 1"
    if str(score.provenance.settings.get("metric")).startswith("rsa"):  # correlations
        ends = (score.ceiling.lower, score.ceiling.upper) if score.ceiling else ()
        compared = (score.r, *ends, *(one.r for one in (*score.subjects, *score.layers)))
        if any(abs(r) > 1 + _ROUNDING for r in compared):
            return "a raw comparison (r, or its ceiling) is outside -1 to 1"
    intervals = [score.interval, score.reliability_interval, *(layer.interval for layer in score.layers)]
    numbers = [score.value, score.r, score.chance, score.attainable, score.best_layer_value, *score.without_stimulus]
    numbers += [*score.model_rdm, *score.brain_rdm, *(one.value for one in (*score.subjects, *score.layers))]
    numbers += [end for one in intervals if one for end in (one.low, one.high)]
    largest = max((abs(number) for number in numbers if math.isfinite(number)), default=0.0)
    return f"a number is as large as {largest}" if largest > _LARGEST else None
