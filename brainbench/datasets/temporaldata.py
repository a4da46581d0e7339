"""Recordings in files of ``temporaldata``, which ``torch_brain`` trains on: read as sessions, and written from any.

Every group states its class in the attribute ``object``. Spikes are an ``IrregularTimeSeries`` with ``unit_index``,
whose units are the rows of the ``ArrayDict`` called ``units`` beside it and whose ``domain`` is the recorded time;
tables are ``Interval``, signals are columns [time, cell] of series, and ``Data`` holds others. Copies hold in addition
``obs_intervals``, the spans of single units where they differ, and ``<signal>_cells``, what is known of its columns.
"""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import DataError, brief
from brainbench.core.files import create_hdf5
from brainbench.datasets.hdf5 import as_ascii, columns_of, walk
from brainbench.datasets.nwb import named_by_file
from brainbench.datasets.sessions import OBSERVED, SPIKES, Series, Session, SessionTable, decode, ragged, text
from brainbench.datasets.trials.counting import merged

_LOG = logging.getLogger(__name__)
IRREGULAR, REGULAR = "IrregularTimeSeries", "RegularTimeSeries"
_CLASSES = ("Data", "ArrayDict", "Interval", IRREGULAR, REGULAR)
_TIMES = {"start": "start_time", "end": "stop_time"}  # columns of every interval → their names here
_PARTS = ("brainset", "subject", "session", "spikes", "units", OBSERVED)  # of every file
_LONGEST = 1e7  # seconds of a session, each of which gets an entry; more are other units of time


def is_temporaldata(file: h5py.File) -> bool:
    """Return whether an open HDF5 file was written by temporaldata."""
    return text(file.attrs.get("object", "")) == "Data" and "absolute_start" in file.attrs


def read_temporaldata(file: h5py.File, path: Path) -> Session:
    """Describe the session in an open file; tables and signals are read later, while it stays open."""
    units, tables, groups = dict[str, SessionTable](), dict[str, SessionTable](), dict[str, Any]()
    signals, others = dict[str, Series](), dict[str, Series]()
    for place, group in walk(file, path, lambda _, group: _class(group) == "Data"):
        if isinstance(group, SessionTable) or (kind := _class(group)) in _CLASSES:
            (tables if isinstance(group, SessionTable) else groups)[place] = group
        else:
            reason = f"{place} of {path} is of the class {brief(kind)}, which is none of {', '.join(_CLASSES)}."
            tables[place] = SessionTable(place, {}, str(path), reason)
    dicts = {place: columns_of(group, path) for place, group in groups.items() if _class(group) == "ArrayDict"}
    for place, group in groups.items():
        kind = _class(group)
        if kind == "Interval" and place.rpartition("/")[2] != "domain" and place != OBSERVED:
            columns = {_TIMES.get(name, name): values for name, values in columns_of(group, path).items()}
            for name in [name for name in columns if f"{name}_cells" in dicts]:
                data, times = columns.pop(name), dicts.get(f"{name}_samples", {}).get("time")
                more = {"unit": text(data.attrs.get("unit", "")), "table": place, "columns": dicts[f"{name}_cells"]}
                signals[name] = Series(name, "samples", data, times, **more)
            tables[place] = SessionTable(place, columns, str(path))
        elif kind == IRREGULAR and "unit_index" in group:
            units[place] = _units(group, place, dicts, groups.get(OBSERVED), path)
        elif kind in (IRREGULAR, REGULAR):
            for series in _series(group, place, path):
                # Columns that a table describes are cells; all else is behaviour.
                columns = _cells_of(series, dicts)
                (signals if columns else others)[series.name] = replace(series, columns=columns)
    about = {name: getattr(groups.get(name), "attrs", {}) for name in ("subject", "session", "brainset")}
    subject, session, _ = (text(attributes.get("id", "")).strip() for attributes in about.values())
    name = subject or named_by_file(path, "sub")
    note = f"{path.name}: no id of a subject; the subject {name!r} was taken from the file name"
    return Session(
        subject=name,
        session=session or named_by_file(path, "ses"),
        units=units["spikes"] if "spikes" in units else next(iter(units.values())) if len(units) == 1 else None,
        tables=tables,
        source=str(path),
        start=text(about["session"].get("recording_date", "")),
        format="temporaldata",
        synthetic=bool(about["brainset"].get("synthetic", False)),
        notes=() if subject else (note,),
        series=others,
        stimuli=text(about["brainset"].get("stimuli", "")),
        guessed=not subject and name == path.stem,
        populations={**units, **signals},
    )


def _class(group: Any) -> str:
    return text(group.attrs.get("object", ""))


def _units(group: Any, place: str, dicts: dict[str, dict[str, Any]], observed: Any, path: Path) -> SessionTable:
    """Return units with their spike times; what is wrong with them is said by the table."""
    where = f"{place} of {path}"
    around = place.rpartition("/")[0]
    columns = next((dicts[name] for name in (f"{around}/units".lstrip("/"), "units") if name in dicts), {})
    try:
        times, index = (np.asarray(group[name][...]).ravel() for name in ("timestamps", "unit_index"))
        number = max((len(values) for values in columns.values()), default=int(index.max(initial=-1)) + 1)
        if index.dtype.kind not in "iu" or len(index) != len(times):
            raise DataError(f"{where} has {len(times)} timestamps and {len(index)} unit_index ({index.dtype}).")
        if len(index) and not 0 <= int(index.min()) <= int(index.max()) < number:
            wrong = int(((index < 0) | (index >= number)).sum())
            raise DataError(f"{wrong} of {len(index)} spikes of {where} have the index of none of the {number} units.")
        spikes = [times[rows] for rows in _rows_of(index, number)]
        spans = None
        if observed is not None and "unit_index" in observed:
            begin_end = np.stack([observed["start"][...], observed["end"][...]], axis=1)
            spans = [begin_end[rows] for rows in _rows_of(observed["unit_index"][...], number)]
        elif "domain" in group:
            spans = [np.stack([group[f"domain/{name}"][...] for name in ("start", "end")], axis=1)] * number
        columns = {**columns, **ragged(SPIKES, spikes)} | ({} if spans is None else ragged(OBSERVED, spans))
    except (KeyError, DataError) as error:
        fault = str(error) if isinstance(error, DataError) else f"{where} lacks a part: {error.args[0]}."
        return SessionTable("units", {}, str(path), fault)
    return SessionTable("units", {"id": np.arange(number), **columns}, str(path))


def _rows_of(index: NDArray[Any], number: int) -> list[NDArray[np.intp]]:
    """Return the rows of each unit, in the order of the file."""
    order = np.argsort(index, kind="stable")
    return np.split(order, np.cumsum(np.bincount(index.astype(np.int64), minlength=number))[:-1]) if number else []


def _series(group: Any, place: str, path: Path) -> Iterator[Series]:
    """Yield the columns of a series of samples as signals, called by their group and their own name."""
    columns = columns_of(group, path)
    rate = float(group.attrs.get("sampling_rate", math.nan))
    start = float(group["domain/start"][0]) if "domain/start" in group and len(group["domain/start"]) else 0.0
    stamps = columns.pop("timestamps", None)
    columns.pop("timestamp_indices_1s", None)
    for name, data in (columns or {place: stamps}).items():
        unit, kind = (text(data.attrs.get(key, "")) for key in ("unit", "kind"))
        name = place if name in (place, place.rpartition("/")[2]) else f"{place}/{name}"
        scale = {key: data.attrs.get(key, default) for key, default in (("conversion", 1.0), ("offset", 0.0))}
        yield Series(name, kind or _class(group), data, stamps, start, rate, unit, **scale)


def _cells_of(series: Series, dicts: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Return what the file tells of each column of a signal; nothing where no table has so many rows."""
    tables = (dicts.get(name, {}) for name in (f"{series.name}_cells", *dicts))
    fits = (table for table in tables if {len(values) for values in table.values()} == {*series.data.shape[1:]})
    return next(fits, {}) if len(series.data.shape) == 2 else {}


def write_temporaldata(path: str | os.PathLike[str], session: Session) -> Path:
    """Write one session: its spikes, else its signals, with its tables, as ``temporaldata.Data.load`` reads them."""
    with create_hdf5(path) as file:
        _object(file, "Data")
        about = {"brainset": "brainbench", "subject": session.subject, "session": session.session}
        for name, identity in about.items():
            _group(file, name, "Data").attrs["id"] = identity
        # Not of the file: temporaldata shows one of an attribute and a table of the same name.
        file["brainset"].attrs.update({"synthetic": session.synthetic, "stimuli": session.stimuli})
        if session.start:
            file["session"].attrs["recording_date"] = session.start
        spans = [_write_spikes(file, session)] if session.units is not None else []
        tables = {_place(name, session): table for name, table in session.tables.items()}
        for name, table in tables.items():
            spans.append(_write_table(_group(file, name, "Interval"), table, session))
        if session.units is None:
            signals = (item for item in session.populations.values() if isinstance(item, Series) and not item.table)
            spans += [_write_signal(file, series) for series in signals]
        edges = np.concatenate([span for span in spans if len(span)] or [np.zeros((1, 2))])
        places = (PurePosixPath(name) for name in {**tables, **session.populations})
        # Whatever holds others needs the time over which these are known.
        for parent in {parent.as_posix() for place in places for parent in place.parents} | {"."}:
            if parent in file:
                holder: Any = file[parent]
                _interval(holder, "domain", np.array([[edges[:, 0].min(), edges[:, 1].max()]]))
    return Path(path)


def _place(name: str, session: Session) -> str:
    """Return where a table stands: below ``intervals`` where it would be in a table, or a part of every file."""
    inside = any(name.startswith(f"{table}/") for table in session.tables)
    if name.partition("/")[0] not in _PARTS and name.rpartition("/")[2] != "domain" and not inside:
        return name
    place = f"intervals/{name}_table"
    _LOG.warning("The table %r of %s is called %r in the copy.", name, session.source, place)
    return place


def _write_spikes(file: h5py.File, session: Session) -> NDArray[np.float64]:
    """Write spikes in the order of time, their units, and the recorded time; returns the spans [n, 2] of it (s)."""
    assert session.units is not None
    units, group = session.units, _group(file, "spikes", IRREGULAR)
    rows, spans = units.rows(SPIKES), units.spans() if OBSERVED in units else []
    index = np.repeat(np.arange(len(rows)), [len(times) for times in rows])
    times = np.concatenate([*rows, np.zeros(0)])
    order = np.argsort(times, kind="stable")
    _columns(group, {"timestamps": times[order], "unit_index": index[order]}, ["timestamps"])
    if not spans:
        spans = [np.array([[times.min(), times.max()]] if len(times) else [[0.0, 0.0]])]
    every = np.concatenate(spans)
    edges = np.array(merged(every) or [[0.0, 0.0]])
    if not all(np.array_equal(span, spans[0]) for span in spans):
        numbers = np.repeat(np.arange(len(spans)), [len(span) for span in spans])
        by_start = np.argsort(every[:, 0], kind="stable")
        _interval(file, OBSERVED, every[by_start], unit_index=numbers[by_start])
    _grid(group, times[order], edges)
    plain = {name: units.column(name) for name in units.columns if name not in units.index}
    _columns(_group(file, "units", "ArrayDict"), {"id": units.ids(), **plain})
    return edges


def _write_table(group: h5py.Group, table: SessionTable, session: Session) -> NDArray[np.float64]:
    """Write an interval table in the order of time, with the responses to its rows; returns its spans [n, 2] (s)."""
    edges = [table.times(name) if name in table else np.full(len(table), np.nan) for name in _TIMES.values()]
    edges = np.stack(edges, axis=1)
    if not np.isfinite(edges).all():
        raise DataError(f"{table.label} has rows without start_time or stop_time, which temporaldata cannot hold.")
    order = np.lexsort(edges.T[::-1])
    names = {ours: theirs for theirs, ours in _TIMES.items()}
    columns = {names.get(name, name): table.column(name) for name in table.columns if name not in table.index}
    times = [name for name in columns if name in _TIMES or (name.endswith("_time") and columns[name].dtype.kind == "f")]
    _columns(group, {name: values[order] for name, values in {"id": table.ids(), **columns}.items()}, times)
    for series in session.populations.values() if session.units is None else ():
        if isinstance(series, Series) and series.table == table.name:
            group.create_dataset(series.name, data=np.asarray(series.data[...])[order]).attrs["unit"] = series.unit
            _columns(_group(group.file, f"{series.name}_cells", "ArrayDict"), _cells(series))
            if series.timestamps is not None:
                _columns(_group(group.file, f"{series.name}_samples", "ArrayDict"), {"time": series.timestamps[...]})
    return edges


def _write_signal(file: h5py.File, series: Series) -> NDArray[np.float64]:
    """Write a signal of cells with what is known of these; returns the span [1, 2] (s) of its frames."""
    group, values, times = _group(file, series.name, IRREGULAR), np.asarray(series.data[...]), series.times()
    name = series.name.rpartition("/")[2]
    data = group.create_dataset(name, data=values if values.ndim > 1 else values[:, None])
    scale = {"conversion": series.conversion, "offset": series.offset}
    data.attrs.update({"unit": series.unit, "kind": series.kind, **scale})
    _columns(group, {"timestamps": times}, ["timestamps"])
    _grid(group, times, edges := times[[[0, -1]]])
    _columns(_group(file, f"{series.name}_cells", "ArrayDict"), _cells(series))
    return edges


def _cells(series: Series) -> dict[str, NDArray[Any]]:
    return {name: decode(values[...]) for name, values in series.cells.data.items()}


def _grid(group: h5py.Group, times: NDArray[np.float64], edges: NDArray[np.float64]) -> None:
    """Write the recorded time of a series, and the place of each of its seconds, by which parts of it are read."""
    _interval(group, "domain", edges)
    if (length := edges[-1, 1] - edges[0, 0]) > _LONGEST:
        raise DataError(f"The times of {(group.name or '').strip('/')} span {length:g}, so they are no seconds.")
    seconds = np.arange(edges[0, 0], edges[-1, 1] + 1.0, 1.0)
    group.create_dataset("timestamp_indices_1s", data=np.searchsorted(times, seconds))


def _interval(file: h5py.Group, name: str, edges: NDArray[np.float64], **columns: NDArray[Any]) -> None:
    columns = {"start": edges[:, 0], "end": edges[:, 1], **columns}
    _columns(_group(file, name, "Interval"), columns, ["start", "end"])


def _group(file: h5py.Group, place: str, kind: str) -> h5py.Group:
    """Make the group of an object, and those around it."""
    parent, _, name = place.rpartition("/")
    around: Any = file if not parent else file[parent] if parent in file else _group(file, parent, "Data")
    return _object(around.create_group(name), kind)


def _object(group: Any, kind: str) -> Any:
    group.attrs.update({"object": kind} | ({"absolute_start": 0.0} if kind == "Data" else {}))
    return group


def _columns(group: h5py.Group, columns: dict[str, Any], timekeys: list[str] | None = None) -> None:
    """Write columns, and which of them are texts or times."""
    for name, values in columns.items():
        group.create_dataset(name, data=as_ascii(values, name, "temporaldata"))
    texts = [name for name, values in columns.items() if np.asarray(values).dtype.kind == "U"]
    group.attrs["_unicode_keys"] = np.array(texts, dtype="S")
    if timekeys is not None:
        group.attrs["timekeys"] = np.array(timekeys, dtype="S")
