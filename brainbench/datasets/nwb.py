"""Sessions in Neurodata Without Borders 2.x files, read through h5py: units, interval tables, subject, nothing else.

Needs no NWB schema and touches no raw data. Interval tables are every ``TimeIntervals`` under
``/intervals`` and in the processing modules.
"""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from brainbench.core.errors import DataError
from brainbench.datasets.sessions import Series, Session, SessionTable, decode, text
from brainbench.datasets.trials.covariates import LICKS

if TYPE_CHECKING:
    import h5py

STIMULI = "brainbench stimuli: "
"""Begin of ``/general/stimulus`` (NWB's notes on stimuli) where it names a recipe."""

_INTRACELLULAR = ("CurrentClampSeries", "VoltageClampSeries", "IZeroClampSeries", "PatchClampSeries")


def is_nwb(file: h5py.File) -> bool:
    """Return whether an open HDF5 file is NWB, of any version."""
    return _type(file) == "NWBFile" or "nwb_version" in file.attrs or "nwb_version" in file


def read_nwb(file: h5py.File, path: Path) -> Session:
    """Describe the session in an open NWB file; columns are read later, while it stays open.

    The subject is ``/general/subject/subject_id``, else the ``sub-`` part of the file name, else the file's stem; the
    session likewise (``/general/session_id``, ``ses-``, stem). What was guessed is said in ``notes``. Raises DataError:
    the file is NWB 1.x, whose layout differs.
    """
    import h5py

    version = text(file.attrs.get("nwb_version", "")) or _string(file, "nwb_version")
    if version.removeprefix("NWB-").startswith("1"):
        raise DataError(f"{path} is NWB {version}; brainbench reads NWB 2.x: convert it first (e.g. with MatNWB).")
    notes: list[str] = []
    subject = _string(file, "general/subject/subject_id")
    if not subject:
        subject = _entity(path, "sub")
        notes.append(f"{path.name}: no subject_id; the subject {subject!r} was taken from the file name")
    session = _string(file, "general/session_id") or _entity(path, "ses")
    description = _string(file, "session_description")
    keywords, units = file.get("general/keywords"), file.get("units")
    # Licks are processed data with their own times.
    processed = (item for _, module in _groups(file.get("processing")) for item in _series(module))
    licks = [item for item in processed if item[0].rpartition("/")[2] == LICKS]
    acquired = [_type(group) for _, group in _groups(file.get("acquisition"))]
    stimuli = _string(file, "general/stimulus")
    return Session(
        subject=subject,
        session=session,
        units=_table(units, "units", path) if isinstance(units, h5py.Group) else None,
        tables=_interval_tables(file, path),
        source=str(path),
        identifier=_string(file, "identifier"),
        start=_string(file, "session_start_time"),
        format=f"NWB {version}",
        synthetic=description.lower().startswith("synthetic") or "synthetic" in _words(keywords),
        intracellular={kind: acquired.count(kind) for kind in _INTRACELLULAR if kind in acquired},
        modules={name: tuple(module) for name, module in _groups(file.get("processing"))},
        notes=tuple(notes),
        series=dict([*_series(file.get("acquisition")), *licks]),
        stimuli=stimuli.removeprefix(STIMULI) if stimuli.startswith(STIMULI) else "",
        guessed=bool(notes) and subject == path.stem,
    )


def _interval_tables(file: h5py.File, path: Path) -> dict[str, SessionTable]:
    tables = {name: _table(group, name, path) for name, group in _groups(file.get("intervals"))}
    for module_name, module in _groups(file.get("processing")):
        for name, group in _groups(module):
            if _type(group) == "TimeIntervals":
                key = f"{module_name}/{name}" if name in tables else name
                tables[key] = _table(group, key, path)
    return tables


def _table(group: h5py.Group, name: str, path: Path) -> SessionTable:
    import h5py

    columns: dict[str, Any] = {key: item for key, item in group.items() if isinstance(item, h5py.Dataset)}
    for key in [key for key, item in columns.items() if _type(item) == "EnumData" and f"{key}_elements" in columns]:
        # Numbers follow the first appearance in each file, so only the names mean the same in all files.
        names, numbers = decode(columns.pop(f"{key}_elements")[...]), columns[key][...]
        if len(numbers) and not int(numbers.max()) < len(names):
            raise DataError(f"Column {key!r} of table {name!r} of {path} has the number {numbers.max()} of no element.")
        columns[key] = names[numbers]
    declared = [text(key) for key in group.attrs.get("colnames", ())]
    order = [key for key in declared if key in columns] + [key for key in columns if key not in declared]
    return SessionTable(name, {key: columns[key] for key in order}, str(path))


def _series(parent: Any) -> Iterator[tuple[str, Series]]:
    """Yield acquired signals by path, also those inside containers such as BehavioralTimeSeries."""
    import h5py

    for _, group in _groups(parent):
        data, stamps = group.get("data"), group.get("timestamps")
        if not isinstance(data, h5py.Dataset):
            yield from _series(group)
            continue
        path = (group.name or "").strip("/")
        start, rate, begin = 0.0, math.nan, group.get("starting_time")
        if isinstance(begin, h5py.Dataset) and begin.shape == ():
            start, rate = float(begin[()]), float(begin.attrs.get("rate", math.nan))
        yield path, Series(path, _type(group), data, stamps, start, rate)


def _groups(parent: Any) -> list[tuple[str, h5py.Group]]:
    import h5py

    groups: list[tuple[str, h5py.Group]] = []
    if parent is None:
        return groups
    for name in parent:
        # A link into a file that is not there (raw data kept apart) must not hide the rest.
        with contextlib.suppress(KeyError, OSError):
            item = parent[name]
            if isinstance(item, h5py.Group):
                groups.append((name, item))
    return groups


def _type(group: h5py.Group | h5py.Dataset) -> str:
    return text(group.attrs.get("neurodata_type", ""))


def _string(file: h5py.File, name: str) -> str:
    values = _words(file.get(name), lower=False)
    return values[0].strip() if values else ""


def _words(dataset: Any, *, lower: bool = True) -> list[str]:
    values = [] if dataset is None else decode(dataset[()]).ravel().tolist()
    return [str(item).lower() if lower else str(item) for item in values]


def _entity(path: Path, entity: str) -> str:
    match = re.search(rf"(?:^|_){entity}-([^_.]+)", path.name)
    return match.group(1) if match else path.stem
