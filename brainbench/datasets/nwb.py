"""Sessions in Neurodata Without Borders 2.x files, read through h5py: units, interval tables, subject, nothing else.

Needs no NWB schema and touches no raw data. Tables are known by their type, wherever they stand: intervals, events
(whose times become those of intervals) and units.
"""

from __future__ import annotations

import math
import os
import re
import uuid
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from brainbench.core.contracts import as_labels
from brainbench.core.errors import DataError
from brainbench.core.files import create_hdf5
from brainbench.datasets.hdf5 import columns_of, walk, write_array
from brainbench.datasets.sessions import SPIKES, Series, Session, SessionTable, decode, neurodata_type, text
from brainbench.datasets.trials.counting import LICKS, OTHER_NAMES
from brainbench.datasets.trials.selection import CONTACTS

STIMULI = "brainbench stimuli: "
"""Begin of ``/general/stimulus`` (NWB's notes on stimuli) where it names a recipe."""

_INTRACELLULAR = ("CurrentClampSeries", "VoltageClampSeries", "IZeroClampSeries", "PatchClampSeries")


def is_nwb(file: h5py.File) -> bool:
    """Return whether an open HDF5 file is NWB, of any version."""
    return neurodata_type(file) == "NWBFile" or "nwb_version" in file.attrs or "nwb_version" in file


def read_nwb(file: h5py.File, path: Path) -> Session:
    """Describe the session in an open NWB file; columns are read later, while it stays open.

    The subject is ``/general/subject/subject_id``, else the ``sub-`` part of the file name, else the file's stem; the
    session likewise (``/general/session_id``, ``ses-``, stem). What was guessed is said in ``notes``. Raises DataError:
    the file is NWB 1.x, whose layout differs.
    """
    version = text(file.attrs.get("nwb_version", "")) or _string(file, "nwb_version")
    if version.removeprefix("NWB-").startswith("1"):
        raise DataError(f"{path} is NWB {version}; brainbench reads NWB 2.x: convert it first (e.g. with MatNWB).")
    notes: list[str] = []
    subject = _string(file, "general/subject/subject_id")
    if not subject:
        subject = named_by_file(path, "sub")
        notes.append(f"{path.name}: no subject_id; the subject {subject!r} was taken from the file name")
    session = _string(file, "general/session_id") or named_by_file(path, "ses")
    description = _string(file, "session_description")
    keywords = file.get("general/keywords")
    every = dict(walk(file, path, lambda place, group: not _is_table(place, group)))
    tables, units, signals = _tables(every, path)
    groups = {place: group for place, group in every.items() if not isinstance(group, SessionTable)}
    inside = {place: group for place, group in groups.items() if place.count("/") == 1}
    acquired = [neurodata_type(group) for place, group in inside.items() if place.startswith("acquisition/")]
    stimuli = _string(file, "general/stimulus")
    return Session(
        subject=subject,
        session=session,
        units=units["units"] if "units" in units else next(iter(units.values())) if len(units) == 1 else None,
        tables=tables,
        source=str(path),
        identifier=_string(file, "identifier"),
        start=_string(file, "session_start_time"),
        format=f"NWB {version}",
        synthetic=description.lower().startswith("synthetic") or "synthetic" in _words(keywords),
        intracellular={kind: acquired.count(kind) for kind in _INTRACELLULAR if kind in acquired},
        modules={place[11:]: tuple(module) for place, module in inside.items() if place.startswith("processing/")},
        notes=tuple(notes),
        series={place: _one_series(group) for place, group in groups.items() if _is_acquired(place, group)},
        stimuli=stimuli.removeprefix(STIMULI) if stimuli.startswith(STIMULI) else "",
        guessed=bool(notes) and subject == path.stem,
        populations={**units, **signals},
    )


def _is_acquired(place: str, group: Any) -> bool:
    """Return whether a group is an acquired signal, or the licks, which are processed data with their own times."""
    licks = place.startswith("processing/") and place.rpartition("/")[2] == LICKS
    return (licks or place.startswith("acquisition/")) and isinstance(group.get("data"), h5py.Dataset)


def _tables(
    every: Mapping[str, Any], path: Path
) -> tuple[dict[str, SessionTable], dict[str, SessionTable], dict[str, Series]]:
    """Return the tables of intervals and of units, and the signals of cells, wherever they stand, by what they are.

    A table is called by its own name, or with the group around it where that is taken. ``/units`` goes before others.
    """
    intervals: dict[str, SessionTable] = {}
    units: dict[str, SessionTable] = {}
    signals: dict[str, Series] = {}
    for place, group in sorted(
        every.items(), key=lambda entry: entry[0].partition("/")[0] not in ("units", "intervals")
    ):
        kind, name, root = neurodata_type(group), place.rpartition("/")[2], place.partition("/")[0]
        if isinstance(group, SessionTable):  # a dead link
            if place == "units":
                units[place] = group
            elif root in ("intervals", "events") or CONTACTS.match(name) or name == LICKS:
                intervals.setdefault(name, replace(group, name=name))
            continue
        if not _is_table(place, group):
            continue
        if kind == "Units" or place == "units":
            if group != every.get("units") or place == "units":  # a link to a table is none of its own
                units[place] = _with_areas(_table(group, "units", path), group)
            continue
        if kind in _SIGNALS:
            signals |= {place: replace(_one_series(group), name=place, columns=_cells(group))}
            continue
        if name in intervals:
            name = place.partition("/")[2] if place.count("/") > 1 else place
            name = f"/{place}" if name in intervals else name
        if kind == "TimeIntervals" or "start_time" in group or place.count("/") == place.startswith("intervals/") == 1:
            intervals[name] = _table(group, name, path)
        elif kind == "EventsTable" or "timestamp" in group:
            table = _table(group, name, path)
            begin = table.times("timestamp")
            stop = {"stop_time": begin + table.times("duration")} if "duration" in table else {}
            intervals[name] = table.with_columns(start_time=begin, **stop)
    return intervals, units, signals


def _with_areas(units: SessionTable, group: h5py.Group) -> SessionTable:
    """Return units with the column ``area``, where none states it: the location that all electrodes of a unit share."""
    electrodes, rows = group.file.get("general/extracellular_ephys/electrodes"), units.data.get("electrodes")
    if not isinstance(electrodes, h5py.Group) or not isinstance(electrodes.get("location"), h5py.Dataset):
        return units
    if not isinstance(rows, h5py.Dataset) or any(name in units for name in ("area", *OTHER_NAMES["area"])):
        return units
    location = electrodes["location"]
    assert isinstance(location, h5py.Dataset)
    locations = dict(enumerate(as_labels(decode(location[...])).tolist()))
    try:
        ends = units.ends("electrodes") if "electrodes" in units.index else np.arange(1, len(units) + 1)
        every = [{locations.get(row, "") for row in part.tolist()} for part in np.split(np.ravel(rows[...]), ends[:-1])]
        return units.with_columns(area=np.array([min(names) if len(names) == 1 else "" for names in every]))
    except DataError:  # electrodes are no part of a score
        return units


_SIGNALS = {"RoiResponseSeries": "rois", "ElectricalSeries": "electrodes"}
"""Types of signals of cells or channels → name of the rows of the table that describes these."""


def _cells(group: h5py.Group) -> dict[str, Any]:
    """Return what tables say of the columns of a signal: ``iscell``, and the area of the plane or the electrode."""
    # A file of others may hold anything in these places; whatever it is not is an error that is caught.
    rois: Any = group.get(_SIGNALS[neurodata_type(group)])
    columns: dict[str, Any] = {}
    try:
        plane: Any = group.file[rois.attrs["table"]]
        rows = np.asarray(rois[...], dtype=np.float64).ravel()
        data: Any = group["data"]
        number = data.shape[1] if data.ndim > 1 else 1
        if len(rows) != number:
            rows = np.full(number, np.nan)
        if "location" in plane:
            columns["area"] = _looked_up(decode(plane["location"][...]), rows, "")
        if "iscell" in plane:
            columns["iscell"] = _looked_up(_flags(plane["iscell"]), rows, np.nan)
        if "imaging_plane/location" in plane:
            columns["area"] = np.full(len(rows), _string(plane, "imaging_plane/location"))
    except (AttributeError, KeyError, ValueError, TypeError, IndexError):  # without a plane every column is a cell
        return {}
    return columns


def _looked_up(values: np.ndarray, rows: np.ndarray, missing: Any) -> np.ndarray:
    """Return the values at rows, and what is missing for rows that the table does not have."""
    inside = np.isin(rows, np.arange(len(values)))
    result = np.full(len(rows), missing, dtype=values.dtype)
    result[inside] = values[rows[inside].astype(np.int64)]
    return result


def _flags(column: Any) -> np.ndarray:
    """Return which rows of a plane are cells; of no rows, where these are no numbers."""
    try:
        flags = np.asarray(column[...], dtype=np.float64)
    except (AttributeError, TypeError, ValueError):
        return np.zeros(0)
    # Suite2p keeps the probability beside it.
    return flags[:, 0] if flags.ndim > 1 else flags


def _is_table(place: str, group: Any) -> bool:
    """Return whether a group is a table or a signal, whose inner groups are none."""
    kinds = neurodata_type(group) in _SIGNALS, "colnames" in group.attrs, "id" in group
    return place == "units" or place.rpartition("/")[0] == "intervals" or any(kinds)


def _table(group: h5py.Group, name: str, path: Path) -> SessionTable:
    columns = columns_of(group, path)
    for key in [key for key, item in columns.items() if neurodata_type(item) == "EnumData"]:
        if f"{key}_elements" not in columns:
            continue
        # Numbers follow the first appearance in each file, so only the names mean the same in all files.
        names, numbers = decode(columns.pop(f"{key}_elements")[...]), columns[key][...]
        if wrong := sorted({*np.ravel(numbers).tolist()} - {*range(len(names))}):
            raise DataError(f"Column {key!r} of table {name!r} of {path} has the number {wrong[0]} of no element.")
        columns[key] = names[numbers]
    declared = [text(key) for key in group.attrs.get("colnames", ())]
    order = [key for key in declared if key in columns] + [key for key in columns if key not in declared]
    return SessionTable(name, {key: columns[key] for key in order}, str(path))


def _one_series(group: h5py.Group) -> Series:
    path, start, rate, begin = (group.name or "").strip("/"), 0.0, math.nan, group.get("starting_time")
    if isinstance(begin, h5py.Dataset) and begin.shape == ():
        start, rate = float(begin[()]), float(begin.attrs.get("rate", math.nan))
    data: Any = group["data"]
    conversion: Any = data.attrs.get("conversion", 1.0)
    if isinstance(channels := group.get("channel_conversion"), h5py.Dataset):
        conversion = conversion * channels[...]
    scale = {"conversion": conversion, "offset": data.attrs.get("offset", 0.0)}
    return Series(path, neurodata_type(group), data, group.get("timestamps"), start, rate, **scale)


def _string(file: h5py.Group, name: str) -> str:
    values = _words(file.get(name), lower=False)
    return values[0].strip() if values else ""


def _words(dataset: Any, *, lower: bool = True) -> list[str]:
    values = [] if dataset is None else decode(dataset[()]).ravel().tolist()
    return [str(item).lower() if lower else str(item) for item in values]


def named_by_file(path: Path, entity: str) -> str:
    """Return the part of a file's name that stands for an animal (``sub``) or a session (``ses``), else the stem."""
    match = re.search(rf"(?:^|_){entity}-([^_.]+)", path.name)
    return match.group(1) if match else path.stem


NWB_VERSION = "2.7.0"
_NO_START = "1970-01-01T00:00:00+00:00"
_SPACE = uuid.UUID("7d8f2c5e-0b58-5c0e-9b0a-3a8d1f0f6c11")


_DESCRIPTIONS = {
    "start_time": "Begin, s.",
    "stop_time": "End, s.",
    "spike_times": "Spike times, s.",
    "obs_intervals": "Recorded spans of each unit, s.",
    "depth": "Depth below the pia, µm.",
    "layer": "Cortical layer.",
    "inhibitory": "Narrow-spiking, putatively inhibitory.",
}
"""Columns that mean the same in every session."""


def write_nwb(
    path: str | os.PathLike[str],
    session: Session,
    *,
    description: str = "Session copied by brainbench: spike times and tables without raw data.",
    general: Mapping[str, str | Sequence[str]] | None = None,
    subject: Mapping[str, str] | None = None,
    columns: Mapping[str, str] | None = None,
) -> Path:
    """Write one session as NWB 2.x, atomically: units, interval tables, and signals that have timestamps.

    That it is synthetic is said in the descriptions and keywords. ``general`` and ``subject`` are further texts under
    ``/general`` and ``/general/subject``; ``columns`` says what columns mean, by name.
    """
    if session.units is None:
        raise DataError(f"{session.source} has no units table; there are no spikes to write.")
    session.units.rows(SPIKES)  # what no reader takes is not written
    origin = "SYNTHETIC: " if session.synthetic else ""
    identifier, start = session.identifier or f"{session.subject}-{session.session}", session.start or _NO_START
    stated = {"session_id": session.session, "keywords": ["synthetic"] * session.synthetic + ["brainbench"]}
    stated |= {"stimulus": STIMULI + session.stimuli} if session.stimuli else {}
    texts: dict[str, Any] = {"file_create_date": [start], "identifier": identifier}
    texts |= {"session_description": f"{origin}{description}"}
    texts |= dict.fromkeys(("session_start_time", "timestamps_reference_time"), start)
    texts |= {f"general/{name}": value for name, value in {**stated, **(general or {})}.items()}
    about = {"subject_id": session.subject, **(subject or {})}
    texts |= {f"general/subject/{name}": value for name, value in about.items()}
    meanings = _DESCRIPTIONS | dict(columns or {})
    with create_hdf5(path) as file:
        _describe(file, "core", "NWBFile")
        file.attrs["nwb_version"] = NWB_VERSION
        for name in ("acquisition", "analysis", "processing", "stimulus/presentation", "stimulus/templates"):
            file.create_group(name)
        _describe(file.create_group("general/subject"), "core", "Subject")
        for name, value in texts.items():
            file.create_dataset(name, data=value, dtype=h5py.string_dtype())
        _write_table(_group(file, "units", "Units", f"{origin}Units with their spike times."), session.units, meanings)
        for name, table in session.tables.items():
            for column in ("start_time", "stop_time"):
                if column not in table:
                    raise DataError(f"{table.label} has no {column}, which NWB needs; export to .h5 instead.")
            place = f"processing/{name}" if "/" in name else f"intervals/{name}"
            _write_table(_group(file, place, "TimeIntervals", f"{origin}Table {name}."), table, meanings)
        for name, series in session.series.items():
            if series.timestamps is not None:
                _write_events(_group(file, name, "TimeSeries", f"{origin}Events {name}."), series)
        # Every object has an identifier; the file itself is visited by no walk through it.
        file.visititems(lambda _, node: _identify(node, identifier))
        _identify(file, identifier)
    return Path(path)


def _write_table(group: h5py.Group, table: SessionTable, meanings: Mapping[str, str]) -> None:
    """Write the columns of a table; ragged ones of a table without rows are left out."""
    names = [name for name in table.columns if name not in table.index or len(table)]
    group.attrs.create("colnames", names, dtype=h5py.string_dtype())
    try:
        ids = as_labels(table.ids()).astype(np.int64)
    except ValueError as error:
        raise DataError(f"{table.label} has ids that are no integers, which NWB needs; export to .h5.") from error
    _describe(group.create_dataset("id", data=ids), "hdmf-common", "ElementIdentifiers")
    for name in names:
        values = write_array(group, name, np.asarray(table.data[name]))
        _describe(values, "hdmf-common", "VectorData", meanings.get(name, name))
        if name in table.index:
            # The schema asks for unsigned row ends.
            index = group.create_dataset(f"{name}_index", data=table.ends(name).astype(np.uint32))
            _describe(index, "hdmf-common", "VectorIndex", f"Index for VectorData '{name}'")
            index.attrs["target"] = values.ref


def _write_events(group: h5py.Group, series: Series) -> None:
    """Write a series of coded events at its timestamps (s)."""
    group.attrs["comments"] = "no comments"
    data = group.create_dataset("data", data=series.data)
    data.attrs.update({"conversion": np.float32(1), "resolution": np.float32(-1), "unit": "code"})
    stamps = write_array(group, "timestamps", series.timestamps)
    stamps.attrs.update({"interval": np.int32(1), "unit": "seconds"})


def _group(file: h5py.File, path: str, kind: str, description: str) -> h5py.Group:
    """Make a group, and the processing module around it if it is the first there."""
    root, _, rest = path.partition("/")
    module = rest.partition("/")[0]
    if root == "processing" and f"{root}/{module}" not in file:
        _describe(file.create_group(f"{root}/{module}"), "core", "ProcessingModule", f"Module {module}.")
    group = file.create_group(path)
    _describe(group, "core", kind, description)
    return group


def _describe(node: h5py.Group | h5py.Dataset, namespace: str, kind: str, description: str = "") -> None:
    node.attrs.update({"namespace": namespace, "neurodata_type": kind})
    if description:
        node.attrs["description"] = description


def _identify(node: h5py.Group | h5py.Dataset, identifier: str) -> None:
    """Derive the identifier of an NWB object from that of the file and the object's path."""
    if "neurodata_type" in node.attrs:
        node.attrs["object_id"] = str(uuid.uuid5(_SPACE, f"{identifier}{node.name}"))
