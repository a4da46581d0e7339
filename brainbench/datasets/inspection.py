"""Say what a recordings file holds, what is missing for scoring, and which conditions to try."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from brainbench.core.errors import DataError
from brainbench.core.files import to_json
from brainbench.datasets import hdf5
from brainbench.datasets.reading import each_session
from brainbench.datasets.sessions import SPIKES, Session, SessionTable, natural_order
from brainbench.datasets.sources import find_files, open_file
from brainbench.datasets.trials.counting import has_units, no_units, read_spikes, recorded_span
from brainbench.datasets.trials.proposals import EXAMPLES, ColumnSummary, Proposal, propose, summarise_columns


@dataclass(frozen=True)
class TableSummary:
    """One interval table."""

    name: str
    rows: int
    columns: tuple[ColumnSummary, ...]
    problem: str = ""
    """Why part of the table cannot be used, if so."""


@dataclass(frozen=True)
class UnitsSummary:
    """The units table."""

    units: int
    spikes: int
    first: float
    """First spike, s."""
    last: float
    """Last spike, s."""
    silent: int
    """Units without a spike."""
    columns: tuple[str, ...]
    problem: str = ""


@dataclass(frozen=True)
class AcquiredSummary:
    """One acquired signal."""

    name: str
    kind: str
    shape: tuple[int, ...]
    gigabytes: float


@dataclass(frozen=True)
class SessionSummary:
    """One session."""

    subject: str
    session: str
    start: str
    synthetic: bool
    units: UnitsSummary | None
    tables: tuple[TableSummary, ...]
    modules: tuple[tuple[str, tuple[str, ...]], ...]
    """Processing modules with what they hold."""
    acquired: tuple[AcquiredSummary, ...]
    """Signals in the file; their samples are never read here."""
    missing: tuple[str, ...]
    """What scoring needs and this session lacks."""
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Inspection:
    """What is in the files of one source."""

    path: str
    format: str
    recipe: str | None
    """Recipe that will be used, because the layout is known."""
    sessions: tuple[SessionSummary, ...]
    proposals: tuple[Proposal, ...]
    """Best first."""

    def to_json(self) -> str:
        """Serialise deterministically."""
        return to_json(self)

    def __str__(self) -> str:
        return "\n".join(self._lines())

    def _lines(self) -> Iterator[str]:
        yield f"{self.path} ({self.format})"
        if self.recipe:
            yield f"recipe: {self.recipe} (detected from the layout)"
        for session in self.sessions:
            yield from _session_lines(session)
        if self.proposals:
            yield "conditions to try:"
            for item in self.proposals:
                shown = ", ".join(item.labels[:EXAMPLES]) + (" …" if len(item.labels) > EXAMPLES else "")
                yield f"  --conditions {item.conditions}   {len(item.labels)} labels, ≥ {item.fewest} trials: {shown}"


def inspect(path: str | os.PathLike[str]) -> Inspection:
    """Describe the recordings of a file, a folder or a glob. Reads tables and spike times, no raw data.

    Problems inside a table or in the units are reported, not raised, so that a damaged or unsuitable
    file can still be looked into.

    Raises:
        DataFileNotFoundError: there is no such file.
        DataError: a file is not HDF5, is truncated, or has none of the known layouts.
    """
    summaries: list[SessionSummary] = []
    proposals: list[Proposal] = []
    formats: dict[str, None] = {}
    recipes: dict[str | None, None] = {}
    for file_path in find_files(path):
        with open_file(file_path) as file:
            if hdf5.is_ours(file) and hdf5.read_kind(file, file_path) == "counts":
                return _counted(hdf5.read_counts(file, file_path), file_path)
            for session, found in each_session(file, file_path):
                recipes[found.name if found else None] = None
                formats[session.format] = None
                own = propose([session])
                summaries.append(_summary(session, bool(own)))
                proposals += own
    return Inspection(
        path=os.fspath(path),
        format=", ".join(formats),
        recipe=next(iter(recipes)) if len(recipes) == 1 else None,
        sessions=tuple(summaries),
        proposals=_merged(proposals),
    )


def _merged(proposals: list[Proposal]) -> tuple[Proposal, ...]:
    """Join equal proposals of several files: all labels, the fewest trials."""
    merged: dict[str, Proposal] = {}
    for item in proposals:
        known = merged.get(item.conditions)
        if known is None:
            merged[item.conditions] = item
        else:
            labels = list(dict.fromkeys((*known.labels, *item.labels)))
            if len(labels) > len(known.labels):
                labels = [labels[index] for index in natural_order(labels)]
            merged[item.conditions] = Proposal(item.conditions, tuple(labels), min(known.fewest, item.fewest))
    return tuple(merged.values())


def _summary(session: Session, usable: bool) -> SessionSummary:
    units = _units(session)
    tables = tuple(_table(table) for table in session.tables.values())
    missing = [no_units(session)] if units is None else []
    missing += [units.problem] if units is not None and units.problem else []
    missing += [f"table {table.name}: {table.problem}" for table in tables if table.problem]
    if not session.tables:
        missing.append("no interval tables: nothing says when which stimulus was presented")
    elif not usable:
        missing.append("no column of the interval tables has 2 to 60 values with at least two trials each")
    return SessionSummary(
        subject=session.subject,
        session=session.session,
        start=session.start,
        synthetic=session.synthetic,
        units=units,
        tables=tables,
        modules=tuple(session.modules.items()),
        acquired=tuple(
            AcquiredSummary(item.name, item.kind, tuple(item.data.shape), item.gigabytes)
            for item in session.series.values()
        ),
        missing=tuple(missing),
        notes=session.notes,
    )


def _units(session: Session) -> UnitsSummary | None:
    table = session.units
    if table is None or not has_units(session):
        return None
    try:
        spikes = read_spikes(table, [])
    except DataError as error:
        return UnitsSummary(len(table), len(table.data[SPIKES]), np.nan, np.nan, 0, table.columns, str(error))
    span = recorded_span(spikes)
    first, last = span or (np.nan, np.nan)
    return UnitsSummary(
        units=len(spikes),
        spikes=sum(map(len, spikes)),
        first=first,
        last=last,
        silent=sum(not len(times) for times in spikes),
        columns=table.columns,
        problem="" if span else "none of the units has a spike",
    )


def _table(table: SessionTable) -> TableSummary:
    problem = "" if "start_time" in table else "it has no start_time"
    try:
        return TableSummary(table.name, len(table), tuple(summarise_columns(table)), problem)
    except DataError as error:
        return TableSummary(table.name, len(table), (), str(error))


def _counted(dataset: object, path: Path) -> Inspection:
    import xarray as xr

    if not isinstance(dataset, xr.Dataset):
        raise DataError(f"{path} does not hold a recordings data set.")
    labels = Counter(dataset["stimulus"].values.astype(str).tolist())
    pairs = dict.fromkeys(zip(dataset["subject"].values.tolist(), dataset["session"].values.tolist(), strict=True))
    sessions = tuple(
        SessionSummary(str(subject), str(session), "", bool(dataset.attrs["synthetic"]), None, (), (), (), ())
        for subject, session in pairs
    )
    vocabulary = tuple(dataset.attrs["vocabulary"])
    proposal = Proposal("(already counted)", vocabulary, min(labels[label] for label in vocabulary))
    return Inspection(str(path), f"{hdf5.FORMAT} {hdf5.VERSION}, counted responses", None, sessions, (proposal,))


def _session_lines(session: SessionSummary) -> Iterator[str]:
    made = "  SYNTHETIC" if session.synthetic else ""
    yield f"subject {session.subject}, session {session.session}, started {session.start or 'unknown'}{made}"
    if session.units is not None:
        units = session.units
        span = f"{units.first:.3f}–{units.last:.3f} s" if np.isfinite(units.first) else "no span"
        silent = f", {units.silent} silent" if units.silent else ""
        yield f"  units: {units.units} ({units.spikes:,} spikes, {span}{silent}); columns {', '.join(units.columns)}"
    for table in session.tables:
        yield f"  table {table.name}: {table.rows} rows"
        for column in table.columns:
            values = f"{column.distinct} values: {', '.join(column.examples)}" if column.distinct else column.kind
            yield f"    {column.name} ({column.kind}) {values}{' …' if column.distinct > EXAMPLES else ''}"
    for name, contents in session.modules:
        yield f"  processing/{name}: {', '.join(contents)}"
    for item in session.acquired:
        shape = " × ".join(map(str, item.shape))
        size = f"{item.gigabytes:.3g} GB" if item.gigabytes >= 0.1 else f"{item.gigabytes * 1e3:.3g} MB"
        yield f"  {item.name} ({item.kind}): {shape} samples, {size}, not read"
    for item in (*session.missing, *session.notes):
        yield f"  ! {item}"
