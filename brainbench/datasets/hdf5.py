"""Our own HDF5 layout for recordings, version 1: spike times, samples by trial, or responses already counted.

The root carries the attributes ``format`` = "brainbench-recordings", ``version`` = 1 and ``kind``. Kinds "spikes" and
"responses" hold any number of sessions with their tables (docs/recordings.md, "Our own HDF5 layout").

``kind`` = "counts": one recordings data set (:func:`brainbench.core.contracts.check_recordings`)::

    /counts, /duration, /time   [trial, time, unit], [trial, time] and [time]
    /trial/<coordinate>         [trial]: stimulus, subject, session, trial_id, …
    /unit/<coordinate>          [unit]: unit_subject, unit_session, unit_id, …
    /attributes                 JSON text with the data set's attributes

Any HDF5 library can write it. Readers refuse versions they do not know.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np
from numpy.typing import NDArray

from brainbench.core.contracts import check_counts
from brainbench.core.errors import DataError, UsageError, brief, check_kind, listing
from brainbench.core.files import create_hdf5, to_json
from brainbench.core.reading.texts import parse_json
from brainbench.datasets.sessions import SPIKES, LostColumn, Series, Session, SessionTable, decode, text

if TYPE_CHECKING:
    import xarray as xr

FORMAT = "brainbench-recordings"
VERSION = 1
KINDS = ("spikes", "responses", "counts")
RESPONSE = "response"  # data set with the samples of a session by trial


def write_recordings(path: str | os.PathLike[str], recordings: xr.Dataset | Session | Iterable[Session]) -> Path:
    """Write recordings in this layout: the old file or the new one stands, never a part.

    Args:
        path: file to write, usually ``*.h5``.
        recordings: a recordings data set (kind "counts") or sessions (kind "spikes"; build them with
            :func:`~brainbench.datasets.sessions.make_session`).
    """
    import xarray as xr

    with create_hdf5(path) as file:
        file.attrs.update({"format": FORMAT, "version": VERSION})
        if isinstance(recordings, xr.Dataset):
            _write_counts(file, check_counts(recordings, "The data set"))
        else:
            _write_sessions(file, [recordings] if isinstance(recordings, Session) else list(recordings))
    return Path(path)


def is_ours(file: h5py.File) -> bool:
    """Return whether an open HDF5 file has this layout, of any version."""
    return text(file.attrs.get("format", "")) == FORMAT


def holds_counts(file: h5py.File, path: Path) -> bool:
    """Return whether an open file has this layout and kind "counts"."""
    if not is_ours(file):
        return False
    version, kind = file.attrs.get("version"), text(file.attrs.get("kind", ""))
    if version != VERSION or kind not in KINDS:
        later = isinstance(version, (int, np.integer)) and version > VERSION
        newer = " A newer brainbench wrote it: update this one." if later else ""
        raise DataError(
            f"{path} is {FORMAT} version {brief(version)}, kind {brief(kind)}; this brainbench reads "
            f"version {VERSION}, kinds {listing(KINDS)}.{newer}"
        )
    return kind == "counts"


def read_sessions(file: h5py.File, path: Path) -> list[Session]:
    """Describe the sessions of an open file of kind "spikes"; columns are read later."""
    sessions = []
    for name, group in _need(file, "sessions", path).items():
        source, tables = f"{path}:{name}", _need(group, "tables", path).items()
        units = SessionTable("units", columns_of(_need(group, "units", path), path), source)
        # A blank more or less makes no other animal.
        stated = {key: text(group.attrs.get(key, "")).strip() for key in ("subject", "session", "start")}
        sessions.append(
            Session(
                subject=stated["subject"] or name,
                session=stated["session"] or name,
                units=units if SPIKES in units else None,
                tables={key: SessionTable(key, columns_of(table, path), source) for key, table in tables},
                source=source,
                start=stated["start"],
                format=f"{FORMAT} {VERSION}",
                synthetic=bool(group.attrs.get("synthetic", False)),
                stimuli=text(group.attrs.get("stimuli", "")),
                guessed=not stated["subject"],
                populations={RESPONSE: _samples(group, units, source)} if RESPONSE in group else {},
            )
        )
    return sessions


def _samples(group: h5py.Group, units: SessionTable, source: str) -> Series:
    data: Any = group[RESPONSE]
    if not (unit := text(data.attrs.get("unit", "")).strip()):
        raise DataError(f"{RESPONSE} of {source} has no attribute 'unit', such as 'dF/F', or 'spikes' for counts.")
    table = text(data.attrs.get("table", "trials"))
    return Series(RESPONSE, "samples", data, group.get("time"), unit=unit, table=table, columns=units.data)


def read_counts(file: h5py.File, path: Path) -> xr.Dataset:
    """Load the data set in an open file of kind "counts"."""
    import xarray as xr

    coordinates: dict[str, Any] = {"time": ("time", _need(file, "time", path)[...])}
    for dimension in ("trial", "unit"):
        for name, values in _need(file, dimension, path).items():
            coordinates[name] = (dimension, decode(values[...]))
    try:
        attributes = parse_json(text(_need(file, "attributes", path)[()]), f"{path}/attributes")
        dims = {"counts": ("trial", "time", "unit"), "duration": ("trial", "time")}
        arrays = {name: _need(file, name, path)[...] for name in dims}
        # In the byte order of this machine: hashes are of bytes.
        native = {name: array.astype(array.dtype.newbyteorder("="), copy=False) for name, array in arrays.items()}
        variables = {name: (own, native[name]) for name, own in dims.items()}
        dataset = xr.Dataset(variables, coordinates, attributes)
    except ValueError as error:
        raise DataError(f"{path} does not hold a consistent recordings data set ({error}).") from error
    return check_counts(dataset, str(path))


def _write_counts(file: h5py.File, dataset: xr.Dataset) -> None:
    file.attrs["kind"] = "counts"
    for name in ("counts", "duration", "time"):
        write_array(file, name, dataset[name].values)
    for name, coordinate in dataset.coords.items():
        if coordinate.dims in (("trial",), ("unit",)):
            write_array(file.require_group(str(coordinate.dims[0])), str(name), coordinate.values)
    file.create_dataset("attributes", data=to_json(dataset.attrs))


def _write_sessions(file: h5py.File, sessions: list[Session]) -> None:
    if not sessions:
        raise UsageError("There is no session to write; pass at least one.")
    for session in sessions:
        check_kind("recordings to write", session, Session, "a data set or sessions of make_session")
    file.attrs["kind"] = "responses" if any(RESPONSE in session.populations for session in sessions) else "spikes"
    root = file.create_group("sessions")
    for session in sessions:
        name = f"{session.subject}-{session.session}".replace("/", "_")
        if name in root:  # such as the probes of one session; their trials tell whether they are
            name += f" {sum(str(key).partition(' ')[0] == name for key in root) + 1}"
        samples, units = session.populations.get(RESPONSE), session.units
        if samples is not None:
            units = SessionTable("units", samples.columns)
        elif units is None:
            raise DataError(f"Session {name!r} has no units table; there are no spikes to write.")
        else:
            units.rows(SPIKES)  # what no reader takes is not written
        group = root.create_group(name)
        if samples is not None:
            data = write_array(group, RESPONSE, samples.data)
            data.attrs.update({"unit": samples.unit, "table": samples.table})
            if samples.timestamps is not None:
                write_array(group, "time", samples.timestamps)
        for key in ("subject", "session", "start", "synthetic", "stimuli"):
            group.attrs[key] = getattr(session, key)
        _write_table(group.create_group("units"), units)
        group.create_group("tables")
        for key, table in session.tables.items():
            _write_table(group.create_group(f"tables/{key.replace('/', '_')}"), table)


def _write_table(group: h5py.Group, table: SessionTable) -> None:
    for name, values in table.data.items():
        array = decode(values[...])
        # References and compound types point into the source file and mean nothing outside it.
        if array.dtype.kind in "biufU":
            written = write_array(group, name, array)
            if name in table.index.values():
                written.attrs["neurodata_type"] = "VectorIndex"
    for name, index in table.index.items():
        if name in group and index in group:
            group[index].attrs["target"] = group[name].ref


def columns_of(group: h5py.Group, path: Path) -> dict[str, Any]:
    """Return the data sets of a group by name; of a dead link, a column that says so when it is asked for."""
    columns: dict[str, Any] = {}
    for name in map(str, group):
        reason = dead_link(group, name, path)
        node = group[name] if reason is None else LostColumn(reason)
        if isinstance(node, (h5py.Dataset, LostColumn)):
            columns[name] = node
    return columns


def dead_link(group: h5py.Group, name: str, path: Path) -> str | None:
    """Return one sentence about a link to what is not there; None for what is."""
    with contextlib.suppress(KeyError, OSError):
        group[name]
        return None
    link: Any = group.get(name, getlink=True)
    place = f"{(group.name or '').rstrip('/')}/{name}"
    target = f"{link.path!r} of {link.filename!r}" if isinstance(link, h5py.ExternalLink) else repr(link.path)
    return f"{place} of {path} is a link to {target}, which is not there; put that in its place or remove the link."


DEEPEST = 5  # levels of groups that are searched: links may run in circles


def walk(
    parent: h5py.Group, path: Path, into: Callable[[str, h5py.Group], bool], place: str = ""
) -> Iterator[tuple[str, Any]]:
    """Yield each group by its place, down to those that ``into`` does not open, and each dead link as a lost table."""
    for name in map(str, parent):
        here = f"{place}/{name}" if place else name
        if (reason := dead_link(parent, name, path)) is not None:
            yield here, SessionTable(here, {}, str(path), reason)
        elif isinstance(group := parent[name], h5py.Group):
            yield here, group
            if here.count("/") < DEEPEST and into(here, group):
                yield from walk(group, path, into, here)


def write_array(group: h5py.Group, name: str, values: Any) -> h5py.Dataset:
    """Write numbers, compressed if they are many, or text."""
    array = np.asarray(values)
    if array.dtype.kind in "UO":
        return group.create_dataset(name, data=array.astype(object), dtype=h5py.string_dtype())
    packed = {"compression": "gzip", "shuffle": True} if array.size > 1000 else {}
    return group.create_dataset(name, data=array, **packed)


def as_ascii(values: Any, name: str, holder: str) -> NDArray[Any]:
    """Return texts as ASCII bytes, and all else as it is; other texts are refused, since ``holder`` has no place."""
    array = np.asarray(values)
    try:
        return array.astype("S") if array.dtype.kind == "U" else array
    except UnicodeEncodeError as error:
        raise DataError(
            f"{brief(error.object)} of {name!r} is no ASCII text, which is all that {holder} holds; rename it, or "
            "choose another format."
        ) from error


def _need(group: h5py.Group, name: str, path: Path) -> Any:
    if name not in group:
        raise DataError(f"{path} lacks {(group.name or '').rstrip('/')}/{name}, which the {FORMAT} layout needs.")
    return group[name]
