"""One recording session as every file format presents it: a units table and interval tables.

Columns are anything that can be sliced (an HDF5 dataset, an array) and are read when asked for, so
a file with gigabytes of raw voltage costs only what is used. Times are seconds on one session clock.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import cached_property
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import DataError, UsageError, brief, check_name, unknown_name

SPIKES = "spike_times"
OBSERVED = "obs_intervals"


class LostColumn:
    """A part of a file that is named but not there, such as a dead link: whatever is done with it says so."""

    def __init__(self, reason: str) -> None:
        self.reason = reason

    def __getattr__(self, name: str) -> NoReturn:
        if name.startswith("__"):
            raise AttributeError(name)
        raise DataError(self.reason)

    def __getitem__(self, key: Any) -> NoReturn:
        raise DataError(self.reason)

    def __len__(self) -> NoReturn:
        raise DataError(self.reason)


@dataclass(frozen=True)
class SessionTable:
    """Columns of equal length, in the manner of NWB's DynamicTable.

    A ragged column has its values in one array and the end of each row in another, its index: what the file types as
    one (``VectorIndex``), whatever its name. Single values in a row or a column of two axes, as MATLAB writes them,
    are read as well.
    """

    name: str
    data: Mapping[str, Any]
    """Column name → array-like; index columns included."""
    where: str = ""
    """File and path, for messages."""
    fault: str = ""
    """Why the table is not there, though the file names it: whatever asks for its content is refused with it."""

    @cached_property
    def index(self) -> dict[str, str]:
        """Ragged column → the column of its row ends."""
        index = {}
        for name, values in self.data.items():
            base, kind = name.removesuffix("_index"), neurodata_type(values)
            if kind == "VectorIndex":
                base = _target(values) or base
            elif base == name or not (base in (SPIKES, OBSERVED) or isinstance(values, LostColumn) or not kind):
                continue
            elif base in self.data and not (base in (SPIKES, OBSERVED) or isinstance(values, LostColumn)):
                # Without a type, what has a value for each row is a column of its own.
                rows = next((self.data[key] for key in ("id", "start_time") if key in self.data), values)
                whole = getattr(values, "dtype", np.dtype("f8")).kind in "iu"
                if _length(self.data[base]) == _length(rows) or not whole:
                    continue
            if base in self.data:
                index[base] = name
        return index

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns, without ``id`` and the index columns of ragged ones."""
        self._check()
        return tuple(name for name in self.data if name != "id" and name not in self.index.values())

    def __len__(self) -> int:
        self._check()
        if "id" in self.data:
            return _length(self.data["id"])
        flat = [name for name in self.columns if name not in self.index]
        first = flat[0] if flat else next(iter(self.index.values()), None)
        return _length(self.data[first]) if first else 0

    def __contains__(self, column: object) -> bool:
        self._check()
        return column in self.data

    def column(self, name: str) -> NDArray[Any]:
        """Read one column [rows]; text comes as ``str``."""
        self.require(name)
        if name in self.index:
            raise DataError(f"Column {name!r} of {self.label} holds a list per row; choose one with a single value.")
        if neurodata_type(self.data[name]) == "DynamicTableRegion":
            raise DataError(f"Column {name!r} of {self.label} holds rows of another table; choose a column of values.")
        values = self.data[name][...]
        if (names := (values.dtype.metadata or {}).get("enum")) is not None:
            # The numbers of an HDF5 enumeration may differ between files; its names are what was meant.
            word_of = {number: word for word, number in names.items()}
            words = [word_of.get(number, str(number)) for number in values.ravel().tolist()]
            values = np.array(words, dtype=str).reshape(values.shape)
        values = decode(values)
        if values.ndim > 1 and values.size == max(values.shape) == len(self):
            values = values.ravel()
        if values.ndim != 1 or values.dtype.kind not in "biufU":
            raise DataError(
                f"Column {name!r} of {self.label} has shape {values.shape} and type {values.dtype}; expected one "
                f"number or text per row."
            )
        if len(values) != len(self):
            raise DataError(f"Column {name!r} of {self.label} has {len(values)} values for {len(self)} rows.")
        return values

    def times(self, name: str) -> NDArray[np.float64]:
        """Read one numeric column [rows] in seconds."""
        values = self.column(name)
        if values.dtype.kind == "U":
            raise DataError(
                f"Column {name!r} of {self.label} holds text ({brief(str(values[0]))}); expected times in seconds."
            )
        return self._exact(name, values)

    def _exact(self, name: str, values: NDArray[Any]) -> NDArray[np.float64]:
        """Return times as float64, if their type tells them apart to some milliseconds."""
        sizes = np.abs(values[np.isfinite(values)])
        if values.dtype.kind == "f" and len(sizes) and (step := float(np.spacing(sizes.max()))) > 5e-3:
            raise DataError(f"{name} of {self.label} are {values.dtype}, in steps of {step:.2g} s; write float64.")
        return values.astype(np.float64)

    def ids(self) -> NDArray[Any]:
        """Return the identifiers [rows], or the row numbers when the table has none."""
        return decode(self.data["id"][...]).ravel() if "id" in self.data else np.arange(len(self))

    def ends(self, name: str) -> NDArray[np.int64]:
        """Return the checked row ends [rows] of a ragged column."""
        if name not in self.data:
            raise DataError(f"{self.label} has {name}_index without {name}; the values of its rows are missing.")
        if name not in self.index:
            what = name.replace("_", " ")
            raise DataError(f"{self.label} has {name} without {name}_index; the {what} belong to no row.")
        index = self.index[name]
        total = _length(self.data[name], 2 if name == OBSERVED else 1)
        ends = np.asarray(self.data[index][...]).ravel().astype(np.int64)
        steps = np.diff(ends, prepend=0)
        if len(ends) != len(self) or np.any(steps < 0) or (len(ends) > 0 and ends[-1] != total):
            last = int(ends[-1]) if len(ends) else 0
            order = ", decreasing" if np.any(steps < 0) else ""
            raise DataError(
                f"The ragged index {index} of {self.label} is inconsistent: {len(ends)} ends for {len(self)} "
                f"rows, the last at {last} of {total} values{order}; the file is damaged or was written wrongly."
            )
        return ends

    def rows(self, name: str) -> list[NDArray[np.float64]]:
        """Read a ragged column of numbers: an array [values] for each row, of spans [values, 2]."""
        ends = self.ends(name)
        flat = np.asarray(self.data[name][...])
        flat = self._exact(name, flat) if name == SPIKES else flat.astype(np.float64)
        flat = flat.ravel() if flat.size == max(flat.shape) else flat
        bad = ~np.isfinite(flat)
        if bad.any():
            row = int(np.searchsorted(ends, np.flatnonzero(bad)[0], side="right"))
            raise DataError(
                f"{int(bad.sum())} {name.replace('_', ' ')} of {self.label} are not finite (first with id "
                f"{self.ids()[row]}); the data are damaged or were exported wrongly."
            )
        # NWB stores a ragged column as all values in one array and the end of each row, so all ends but the last cut
        # it.
        return np.split(flat, ends[:-1]) if len(ends) else []

    def spans(self) -> list[NDArray[np.float64]]:
        """Read the recorded spans [n, 2] (s) of every unit."""
        ends, values = self.ends(OBSERVED), np.asarray(self.data[OBSERVED][...], dtype=np.float64)
        turned = values.ndim == 2 and values.shape[0] == 2 and values.shape != (2, 2)
        if values.shape == (2, 2):
            turned = bool((values[:, 0] > values[:, 1]).any() and (values[0] <= values[1]).all())
        spans = (values.T if turned else values).reshape(-1, 2)
        return np.split(spans, ends[:-1]) if len(ends) else []

    def with_columns(self, **columns: NDArray[Any]) -> SessionTable:
        """Return the table with further columns [rows]."""
        return replace(self, data={**self.data, **columns})

    @property
    def lost(self) -> list[str]:
        """Why columns are not there, though the file names them."""
        return [column.reason for column in self.data.values() if isinstance(column, LostColumn)]

    def require(self, column: str) -> None:
        """Raise the error for an unknown column, naming the nearest one."""
        self._check()
        if column not in self.data:
            raise unknown_name("column", column, self.columns, hint=f"(in {self.label})")

    @property
    def label(self) -> str:
        """Name and place of the table, for messages."""
        return f"table {self.name!r}{f' of {self.where}' if self.where else ''}"

    def _check(self) -> None:
        if self.fault:
            raise DataError(self.fault)


def neurodata_type(node: Any) -> str:
    """Return the NWB type of an HDF5 group or data set; empty for what has none, such as an array."""
    return "" if isinstance(node, LostColumn) else text(getattr(node, "attrs", {}).get("neurodata_type", ""))


def _target(index: Any) -> str:
    """Return the name of the column that an NWB index refers to; empty where it refers to none."""
    reference = index.attrs.get("target")
    try:
        return (index.file[reference].name or "").rpartition("/")[2] if reference else ""
    except (KeyError, ValueError, TypeError):
        return ""


def _length(values: Any, width: int = 1) -> int:
    """Return the number of rows, each of so many values; a single axis may lie in two, as MATLAB writes it."""
    shape = tuple(values.shape)
    if (len(shape) == 2 and width in shape) if width > 1 else math.prod(shape) == max(shape, default=0):
        return math.prod(shape) // width
    return shape[0] if shape else 1


@dataclass(frozen=True)
class Series:
    """A sampled signal of a file; samples are read only when asked for."""

    name: str
    """Path in the file, such as ``acquisition/behavior/touch_onset``."""
    kind: str
    """NWB type."""
    data: Any
    """[samples, …] array-like."""
    timestamps: Any = None
    """[samples] s, or None for regular sampling from ``start`` at ``rate``."""
    start: float = 0.0
    rate: float = math.nan
    unit: str = ""
    """Unit of the samples, where the file states one; ``spikes`` for counts."""
    conversion: Any = 1.0
    """Factor from samples to their unit, such as volts, or [units] of each column."""
    offset: Any = 0.0
    """What is added to samples × conversion."""
    table: str = ""
    """Table of the rows of ``data`` [trial, time, unit]; times then count from the start of each."""
    columns: Mapping[str, Any] = field(default_factory=dict)
    """What is known of each column of the samples, such as whether it is a cell: name → [units]."""

    @property
    def cells(self) -> SessionTable:
        """What is known of each column of the samples, their numbers at least."""
        number = self.data.shape[-1] if len(self.data.shape) > 1 else 1
        return SessionTable("units", {"id": np.arange(number), **self.columns}, self.name)

    @property
    def gigabytes(self) -> float:
        """Size of the samples, uncompressed."""
        return float(np.prod(self.data.shape, dtype=np.float64) * self.data.dtype.itemsize / 1e9)

    def times(self, *, ordered: bool = True) -> NDArray[np.float64]:
        """Return the times (s) of the samples, checked; those of samples by trial count from its start."""
        number = self.data.shape[1 if self.table else 0]
        if self.timestamps is None:
            if not self.rate > 0:
                raise DataError(f"The series {self.name} has neither timestamps nor a rate; its samples have no time.")
            return self.start + np.arange(number) / self.rate
        times = np.asarray(self.timestamps[...], dtype=np.float64).ravel()
        if len(times) != number:
            raise DataError(f"The series {self.name} has {len(times)} timestamps for {number} samples.")
        if ordered and not (np.isfinite(times).all() and (np.diff(times) > 0).all()):
            raise DataError(f"The timestamps of {self.name} are not finite and increasing; its samples have no order.")
        return times

    def active_times(self) -> NDArray[np.float64]:
        """Return the times (s, ascending) of the samples of a 0/1 signal that are 1."""
        values = np.asarray(self.data[...]).ravel()
        present = values[np.isfinite(values)]
        if len(present) and not np.isin(present, (0, 1)).all():
            raise DataError(f"The series {self.name} should hold zeros and ones; it reaches {present.max():g}.")
        return np.sort(self.times(ordered=False)[values > 0.5])


@dataclass(frozen=True)
class Session:
    """One session of one subject. Valid while its file is open."""

    subject: str
    session: str
    units: SessionTable | None
    """``id``, ``spike_times`` (+ ``spike_times_index``), optionally ``obs_intervals``, ``depth`` …"""
    tables: Mapping[str, SessionTable]
    """Interval tables by name; each has ``start_time`` and usually ``stop_time``."""
    source: str = ""
    identifier: str = ""
    """The file's own unique name for this session; equal names mean the same data."""
    start: str = ""
    """Session start, ISO 8601."""
    format: str = ""
    synthetic: bool = False
    intracellular: Mapping[str, int] = field(default_factory=dict)
    """Number of intracellular series by type, for the message when there are no units."""
    modules: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Contents of the processing modules, by name."""
    notes: tuple[str, ...] = ()
    series: Mapping[str, Series] = field(default_factory=dict)
    """Acquired signals by path; their samples stay in the file."""
    stimuli: str = ""
    """Recipe of the stimuli that this session's animal felt, where the file names one."""
    guessed: bool = False
    """True when the file does not name its subject, and another name stands for it."""
    populations: Mapping[str, Any] = field(default_factory=dict)
    """All tables of units by place, and other responses; ``units`` is the one that is read."""

    @property
    def unread(self) -> list[str]:
        """Why each table of units beside the one that is read, which has the usual name, is not read."""
        places = [place for place, item in self.populations.items() if isinstance(item, SessionTable)]
        main = next((place for place in places if place in ("units", "spikes")), "")
        return [f"{place} has units that are not read, since {main} is" for place in places if main and place != main]

    @property
    def has_spikes(self) -> bool:
        """True with at least one unit that has spike times."""
        return self.units is not None and SPIKES in self.units and len(self.units) > 0

    def table(self, name: str) -> SessionTable:
        """Return one interval table."""
        check_name("table", name, self.tables, hint=f"(interval tables of {self.source})")
        return self.tables[name]

    def with_table(self, table: SessionTable, *notes: str) -> Session:
        """Return the session with one more table, or another of this name, and further notes."""
        return replace(self, tables={**self.tables, table.name: table}, notes=(*self.notes, *notes))


def make_session(
    subject: str,
    session: str,
    spikes: Sequence[NDArray[Any]] | None,
    tables: Mapping[str, Mapping[str, Sequence[Any] | NDArray[Any]]],
    *,
    unit_columns: Mapping[str, Sequence[Any] | NDArray[Any]] | None = None,
    observed: Sequence[NDArray[Any]] | None = None,
    start: str = "",
    synthetic: bool = False,
    stimuli: str = "",
    response: NDArray[Any] | None = None,
    time: NDArray[Any] | None = None,
    unit: str = "",
) -> Session:
    """Build a session from arrays, to be written with :func:`~brainbench.datasets.write_recordings`.

    In place of ``spikes`` (None) it may have a ``response`` [trial, time, unit] to the rows of ``trials`` in some
    ``unit`` ("dF/F", "spikes" for counts), at each ``time`` [time] (s) from the start of the trial.

    ``spikes`` are the times (s) of each unit, below 0 before the clock began; ``tables`` mappings of columns with at
    least ``start_time``, ``unit_columns`` such as ``id``, ``depth`` (µm) and ``layer``, ``observed`` the recorded spans
    [n, 2] (s) of each unit. The session's name is unique within the animal.
    """
    if start:
        try:
            datetime.fromisoformat(start)
        except ValueError:
            raise UsageError(
                f"A session starts at a time of ISO 8601, such as 2025-01-31T12:00:00+00:00; received {brief(start)}."
            ) from None
    if (spikes is None) == (response is None) or (response is not None and (response.ndim != 3 or not unit)):
        raise UsageError("A session has spikes, or else a response [trial, time, unit] with its unit, such as 'dF/F'.")
    number = len(spikes) if spikes is not None else response.shape[2] if response is not None else 0
    data: dict[str, Any] = {"id": np.arange(number)}
    data |= {name: np.asarray(values) for name, values in (unit_columns or {}).items()}
    data |= ragged(SPIKES, spikes) if spikes is not None else {}
    if observed is not None:
        data |= ragged(OBSERVED, [np.reshape(item, (-1, 2)) for item in observed])
    arrays = {name: {key: np.asarray(item) for key, item in table.items()} for name, table in tables.items()}
    named_tables = {name: SessionTable(name, columns, session) for name, columns in arrays.items()}
    units = SessionTable("units", data, session)
    for table in (units, *named_tables.values()):
        for name in table.columns:
            if name not in table.index and len(table.data[name]) != len(table):
                raise DataError(f"Column {name!r} of {table.label} has {len(table.data[name])} of {len(table)} rows.")
    if spikes is not None:
        units.rows(SPIKES)
    if observed:
        units.ends(OBSERVED)
        if not (data[OBSERVED][:, 0] <= data[OBSERVED][:, 1]).all():
            raise DataError(f"Recorded spans of {units.label} must be [begin, end] in seconds, the earlier time first.")
    for table in named_tables.values():
        table.require("start_time")
    stated: dict[str, Any] = {"source": session, "start": start, "synthetic": synthetic, "stimuli": stimuli}
    samples = {} if response is None else {"response": Series("response", "samples", response, time)}
    samples = {name: replace(item, unit=unit, table="trials", columns=data) for name, item in samples.items()}
    stated |= {"units": units if response is None else None, "populations": samples}
    return Session(subject, session, tables=named_tables, format="arrays", **stated)


def ragged(name: str, rows: Sequence[NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Return rows of values as a ragged column, by name: all values [total], and the end of each row [rows]."""
    values = np.concatenate([np.asarray(row, dtype=np.float64) for row in rows]) if rows else np.zeros(0)
    return {name: values, f"{name}_index": np.cumsum([len(row) for row in rows], dtype=np.int64)}


def decode(values: Any) -> NDArray[Any]:
    """Turn HDF5 text (bytes or objects) into ``str`` arrays; leave the rest."""
    array = np.asarray(values)
    if array.dtype.kind == "S":
        return np.array([text(item) for item in array.ravel().tolist()], dtype=str).reshape(array.shape)
    if array.dtype.kind == "O":
        flat = [text(item) if isinstance(item, (bytes, str)) else None for item in array.ravel()]
        if all(item is not None for item in flat):
            return np.array(flat, dtype=str).reshape(array.shape)
    return array


def text(value: Any) -> str:
    """Return bytes or text as ``str``."""
    if not isinstance(value, bytes):
        return str(value)
    try:
        return value.decode("utf-8")
    except UnicodeDecodeError:
        # Latin-1 has a letter for every byte; one sign for all that is not UTF-8 would make two labels one.
        return value.decode("latin-1")
