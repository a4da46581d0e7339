"""Contents of recordings files: tables and units, what scoring lacks, and the columns that could label trials."""

from __future__ import annotations

import contextlib
import os
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.contracts import as_labels, natural_key
from brainbench.core.errors import BrainbenchError, DataError
from brainbench.core.progress import Progress, track
from brainbench.core.reading.hdf5 import MissingFilterError
from brainbench.datasets import hdf5
from brainbench.datasets.layouts.registry import RecordingLayout, counted_layout
from brainbench.datasets.ledger import Ledger, balance_line
from brainbench.datasets.reading import each_session, find_recordings, open_file, suitable_files
from brainbench.datasets.sessions import SPIKES, Series, Session, SessionTable
from brainbench.datasets.trials.counting import no_units, read_spikes, recorded_span, time_fault
from brainbench.datasets.trials.selection import natural_vocabulary, select_rows
from brainbench.datasets.trials.signals import response_series

if TYPE_CHECKING:
    import xarray as xr

FEWEST_LABELS = 3  # fewest conditions whose RDM can be compared
ENOUGH_TRIALS = 4
"""Fewest trials of each label for the default metric, whose cross-validated distances need two in each half."""
EXAMPLES = 6  # number of values shown of a column
_MOST_VALUES = 60
_STIMULUS = re.compile(r"stim|cond|object|image|texture|shape|categ|orient|freq|odou?r|position", re.IGNORECASE)
_BEHAVIOUR = re.compile(r"resp|choice|accuracy|correct|outcome|confid|reward|react|lick|key|tags", re.IGNORECASE)


@dataclass(frozen=True)
class ColumnSummary:
    """One column of an interval table."""

    name: str
    kind: str
    """``text``, ``integer``, ``number``, ``boolean``, ``list`` (ragged) or ``other``."""
    distinct: int
    """Number of distinct values; 0 where they are not single values."""
    examples: tuple[str, ...] = ()
    fewest: int = 0
    """Trials of the rarest value."""


@dataclass(frozen=True)
class Proposal:
    """A ``--conditions`` value worth trying."""

    conditions: str
    labels: tuple[str, ...]
    fewest: int
    """Trials of the rarest label."""


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
    units: UnitsSummary | None = None
    tables: tuple[TableSummary, ...] = ()
    modules: tuple[tuple[str, tuple[str, ...]], ...] = ()
    """Processing modules with what they hold."""
    acquired: tuple[AcquiredSummary, ...] = ()
    """Signals in the file; their samples are never read here."""
    missing: tuple[str, ...] = ()
    """Parts that scoring needs and this session lacks."""
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Inspection:
    """Contents of the files of one source."""

    path: str
    format: str
    layout: str | None
    """Layout that will be used, because the layout is known."""
    sessions: tuple[SessionSummary, ...]
    proposals: tuple[Proposal, ...]
    """Conditions that can be scored, the likeliest first."""
    skipped: tuple[str, ...] = ()
    """Reason for each file that holds no recordings and is not described."""
    ledger: Mapping[str, Any] = field(default_factory=dict)
    """Balance: kind → found, read, and what was left out."""

    def __str__(self) -> str:
        return "\n".join(self._lines())

    def _lines(self) -> Iterator[str]:
        yield f"{self.path} ({self.format})"
        if self.layout:
            yield f"layout: {self.layout} (detected from its columns)"
        for session in self.sessions:
            yield from _session_lines(session)
        if line := balance_line(self.ledger):
            yield f"! left out: {line}"
        if self.proposals:
            yield "conditions that can be scored, the likeliest marked with →:"
            for place, proposal in enumerate(self.proposals):
                examples = ", ".join(proposal.labels[:EXAMPLES]) + (" …" if len(proposal.labels) > EXAMPLES else "")
                few = (
                    f" (fewer than {ENOUGH_TRIALS}: --metric rsa-correlation)"
                    if proposal.fewest < ENOUGH_TRIALS
                    else ""
                )
                counted = f"{len(proposal.labels)} labels, ≥ {proposal.fewest} trials{few}: {examples}"
                yield f"{' ' if place else '→'} --conditions {proposal.conditions}   {counted}"


def inspect(path: str | os.PathLike[str], *, strict: bool = False, progress: Progress | None = None) -> Inspection:
    """Describe the recordings of a file, a folder or a glob. Reads tables and spike times, no raw data.

    Problems inside a table or in the units are reported, not raised, so that a damaged or unsuitable
    file can still be looked into.

    Args:
        path: What is described; ``LAYOUT:PATH`` names a layout, which is detected otherwise.
        strict: Refuse files among several that hold no recordings; they are skipped and named by default.
        progress: Called with (files read, files, what).
    """
    summaries: list[SessionSummary] = []
    proposals: list[Proposal] = []
    formats: dict[str, None] = {}
    layouts: set[str | None] = set()
    ledger = Ledger(strict=strict)
    layout_named, files = find_recordings(path, ledger)
    paths = suitable_files(files, ledger)
    for file_path in track(paths, "reading recordings", progress):
        if (counted := counted_layout(file_path, layout_named)) is not None and counted.open_counted is not None:
            kind = f"{file_path.suffix.lower()}, counted responses, layout {counted.name}"
            return _counted(counted.open_counted(file_path), file_path, kind)
        try:
            with open_file(file_path) as file:
                if hdf5.holds_counts(file, file_path):
                    return _counted(hdf5.read_counts(file, file_path), file_path)
                for session, session_layout in each_session(file, file_path, layout_named):
                    session_proposals = propose(session, session_layout)
                    summaries.append(_summary(session, bool(session_proposals), ledger))
                    layouts.add(session_layout.name if session_layout else None)
                    formats[session.format] = None
                    proposals += session_proposals
        except MissingFilterError as error:
            if len(paths) == 1:
                raise
            ledger.leave("files", str(error), lost=True)
    layout = layouts.pop() if len(layouts) == 1 else None
    format_names = ", ".join(formats)
    subjects = {summary.subject for summary in summaries}
    read = ledger.totals["files"] - len([entry for entry in ledger.left if entry.kind == "files"])
    for kind, number in (("files", read), ("sessions", len(summaries)), ("animals", len(subjects))):
        left = sum(entry.kind == kind == "sessions" for entry in ledger.left)
        ledger.find(kind, number if kind != "files" else 0, number - left)
    ledger.close()
    return Inspection(
        os.fspath(path),
        format_names,
        layout,
        tuple(summaries),
        _merged(proposals),
        tuple(ledger.skipped),
        ledger.stated(),
    )


def _merged(proposals: list[Proposal]) -> tuple[Proposal, ...]:
    """Join equal proposals of several files: all labels, the fewest trials."""
    merged: dict[str, Proposal] = {}
    for proposal in proposals:
        earlier = merged.get(proposal.conditions, proposal)
        labels = earlier.labels
        if more := set(proposal.labels).difference(labels):
            labels = tuple(sorted({*labels, *more}, key=natural_key))
        merged[proposal.conditions] = Proposal(proposal.conditions, labels, min(earlier.fewest, proposal.fewest))
    return tuple(merged.values())


def _summary(session: Session, usable: bool, ledger: Ledger) -> SessionSummary:
    units = _units(session)
    tables = tuple(_table(table) for table in session.tables.values())
    missing = []
    try:
        if (signal := response_series(session)) is not None:
            shape = " × ".join(map(str, signal.data.shape))
            missing.append(f"no spikes: the responses of trials are means of {signal.name}, {shape} samples")
        elif units is None:
            missing.append(no_units(session))
            if not any(isinstance(item, Series) for item in session.populations.values()):
                ledger.leave("sessions", missing[0], lost=True)
    except DataError as error:
        missing.append(str(error))
    missing += [units.problem] if units is not None and units.problem else []
    missing += [f"table {table.name}: {table.problem}" for table in tables if table.problem]
    for table in tables:
        lost = session.tables[table.name].fault
        ledger.find("tables", read=not lost)
        ledger.leave("tables", lost, int(bool(lost)), lost=bool(lost))
    for reason in session.unread:
        ledger.find("tables")
        ledger.leave("tables", reason, lost=True)
    if units is not None:
        ledger.find("units", units.units, 0 if units.problem else units.units)
        ledger.leave("units", units.problem, units.units if units.problem else 0, lost=bool(units.problem))
    lost = [reason for table in (session.units, *session.tables.values()) if table is not None for reason in table.lost]
    missing += [*lost, *time_faults(session)]
    if not session.tables:
        missing.append("no interval tables: nothing says when which stimulus was presented")
    elif not usable:
        missing.append("no column of the interval tables has 3 to 60 values with at least two trials each")
    series = session.series.values()
    return SessionSummary(
        subject=session.subject,
        session=session.session,
        start=session.start,
        synthetic=session.synthetic,
        units=units,
        tables=tables,
        modules=tuple(session.modules.items()),
        acquired=tuple(AcquiredSummary(s.name, s.kind, tuple(s.data.shape), s.gigabytes) for s in series),
        missing=tuple(missing),
        notes=session.notes,
    )


def _units(session: Session) -> UnitsSummary | None:
    table = session.units
    if table is None or not session.has_spikes:
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


def time_faults(session: Session) -> list[str]:
    """Return what speaks against seconds of one clock, once for all tables."""
    faults: list[str] = []
    with contextlib.suppress(BrainbenchError):  # of spikes, which is told already
        if session.units is not None and session.has_spikes:
            spikes = read_spikes(session.units, faults)
            tables = (table for table in session.tables.values() if not table.fault)
            faults += [fault for table in tables if (fault := time_fault(spikes, table))][:1]
    return faults


def _table(table: SessionTable) -> TableSummary:
    if table.fault:
        return TableSummary(table.name, 0, (), table.fault)
    problem = "" if "start_time" in table else "it has no start_time"
    try:
        return TableSummary(table.name, len(table), tuple(summarise_columns(table)), problem)
    except DataError as error:
        return TableSummary(table.name, len(table), (), str(error))


def _counted(
    dataset: xr.Dataset, path: Path, kind: str = f"{hdf5.FORMAT} {hdf5.VERSION}, counted responses"
) -> Inspection:
    labels = Counter(dataset["stimulus"].values.astype(str).tolist())
    pairs = dict.fromkeys(zip(dataset["subject"].values.tolist(), dataset["session"].values.tolist(), strict=True))
    doubt = (dataset.attrs["label_doubt"],) if "label_doubt" in dataset.attrs else ()
    synthetic = bool(dataset.attrs["synthetic"])
    sessions = tuple(
        SessionSummary(str(subject), str(session), "", synthetic, notes=() if number else doubt)
        for number, (subject, session) in enumerate(pairs)
    )
    vocabulary = tuple(dataset.attrs["vocabulary"])
    proposal = Proposal("(already counted)", vocabulary, min(labels[label] for label in vocabulary))
    return Inspection(str(path), kind, None, sessions, (proposal,))


def _session_lines(session: SessionSummary) -> Iterator[str]:
    origin = "  SYNTHETIC" if session.synthetic else ""
    yield f"subject {session.subject}, session {session.session}, started {session.start or 'unknown'}{origin}"
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
    for (kind, shape), series in groupby(session.acquired, key=lambda entry: (entry.kind, entry.shape)):
        items = list(series)
        gigabytes = sum(item.gigabytes for item in items)
        size = f"{gigabytes:.3g} GB" if gigabytes >= 0.1 else f"{gigabytes * 1e3:.3g} MB"
        names = items[0].name if len(items) == 1 else f"{items[0].name} … {items[-1].name}, {len(items)} series"
        yield f"  {names} ({kind}): {' × '.join(map(str, shape))} samples{' each' * (len(items) > 1)}, {size}, not read"
    for remark in (*session.missing, *session.notes):
        yield f"  ! {remark}"


def propose(session: Session, layout: RecordingLayout | None = None) -> list[Proposal]:
    """Rank the columns that could label trials: 3–60 values (more if named like a stimulus), twice each or more.

    The conditions of the session's layout come first; of its trials only those count that it selects. Stimulus-like
    names come before others and before behavioural ones; then text before integers before the rest, the table
    ``trials`` before others, and balanced columns before unbalanced. Columns with too few trials of a label for the
    default metric come last.
    """
    ranked: list[tuple[tuple[float, ...], Proposal]] = []
    for name, table in session.tables.items():
        if table.fault:
            continue
        ours = layout if layout is not None and name == layout.conditions.table else None
        chosen = slice(None) if ours is None else _selected(table, ours)
        for column in summarise_columns(table):
            # A column named like a stimulus may have thousands of values; others would be mere numbers.
            most = np.inf if _STIMULUS.search(column.name) else _MOST_VALUES
            if (
                FEWEST_LABELS <= column.distinct <= most
                and column.fewest >= 2
                and not column.name.endswith(("_time", "_times"))
            ):
                labels = as_labels(table.column(column.name))[chosen].tolist()
                order = None if ours is None else ours.orders.get(column.name)
                candidate = _proposal(f"{name}:{column.name}", [one for one in labels if order is None or one in order])
                if len(candidate.labels) >= FEWEST_LABELS and candidate.fewest >= 2:
                    ranked.append((_rank(name, column, len(table)), candidate))
    if layout is not None:
        table = session.table(layout.conditions.table)
        if all(name in table for name in layout.conditions.columns):
            rows = layout.conditions.values(table)[_selected(table, layout)].tolist()
            values = [tuple(row) for row in rows if all(row)]
            declared = layout.vocabulary(layout.conditions) or natural_vocabulary(values)
            labels = ["-".join(row) for row in values]
            ranked.append(((-1.0,), _proposal(str(layout.conditions), labels, declared)))
    return [proposal for _, proposal in sorted(ranked, key=lambda entry: entry[0])]


def _selected(table: SessionTable, layout: RecordingLayout) -> NDArray[np.bool_]:
    """Return which rows of the table of trials a layout selects; all where its rules do not fit the table."""
    try:
        return select_rows(table, layout.selection.trials, "trials", Ledger())
    except BrainbenchError:
        return np.ones(len(table), dtype=bool)


def _proposal(conditions: str, labels: list[str], vocabulary: tuple[str, ...] | None = None) -> Proposal:
    """Return a proposal from the label of every trial, in the order of a vocabulary, else natural."""
    counts = Counter(label for label in labels if label)
    ordered = vocabulary or tuple(sorted(counts, key=natural_key))
    return Proposal(conditions, ordered, min((counts[label] for label in ordered), default=0))


def _rank(table: str, column: ColumnSummary, rows: int) -> tuple[float, ...]:
    topic = 0 if _STIMULUS.search(column.name) else 2 if _BEHAVIOUR.search(column.name) else 1
    kind = {"text": 0, "integer": 1}.get(column.kind, 2)
    imbalance = 1 - column.fewest * column.distinct / max(rows, 1)
    return (column.fewest < ENOUGH_TRIALS, topic, kind, table != "trials", imbalance)


def summarise_columns(table: SessionTable) -> Iterator[ColumnSummary]:
    """Describe every column of an interval table."""
    for name in table.columns:
        if name in table.index:
            yield ColumnSummary(name, "list", 0)
            continue
        try:
            values = table.column(name)
        except DataError:
            yield ColumnSummary(name, "other", 0)
            continue
        counts, kind = Counter(as_labels(values).tolist()), _kind(values)
        counts.pop("", None)
        labels = sorted(counts, key=natural_key)[:EXAMPLES]
        examples = tuple(f"{float(item):.6g}" for item in labels) if kind == "number" else tuple(labels)
        yield ColumnSummary(name, kind, len(counts), examples, min(counts.values(), default=0))


def _kind(values: NDArray[Any]) -> str:
    if values.dtype.kind == "f" and len(values) and np.all(np.isfinite(values) & (values == np.round(values))):
        return "integer"
    return {"U": "text", "b": "boolean", "i": "integer", "u": "integer"}.get(values.dtype.kind, "number")
