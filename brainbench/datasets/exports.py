"""Small copies of recordings: spike times, unit columns and interval tables, never raw data.

Scoring the copy gives what scoring the original gives, to the last bit: rows keep their ids, spike
times their digits, and what coverage was taken from units that are left out is written down.
"""

from __future__ import annotations

import logging
import os
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import DataError, UsageError, check_each, check_name, listing
from brainbench.datasets.hdf5 import RESPONSE, write_recordings
from brainbench.datasets.inspection import time_faults
from brainbench.datasets.ledger import Ledger
from brainbench.datasets.nwb import write_nwb
from brainbench.datasets.reading import (
    Source,
    each_session,
    find_recordings,
    open_file,
    resolve_selection,
    suitable_files,
)
from brainbench.datasets.sessions import (
    OBSERVED,
    SPIKES,
    LostColumn,
    Series,
    Session,
    SessionTable,
    decode,
    neurodata_type,
    ragged,
)
from brainbench.datasets.temporaldata import write_temporaldata
from brainbench.datasets.trials.counting import LICKS, lick_times, no_units, read_spikes, recorded_span
from brainbench.datasets.trials.selection import EVERYTHING, Selection, check_values, select_rows

_LOG = logging.getLogger(__name__)


def export(
    source: Source, target: str | os.PathLike[str], *, select: Selection | str | None = None, format: str | None = None
) -> list[Path]:
    """Copy recordings without raw data.

    Args:
        source: as in :func:`~brainbench.datasets.open_recordings`.
        target: a folder, which gets one file per session, or a file: ``*.h5`` or ``*.nwb``.
        select: subjects, trials and units to copy; all by default. Rules are applied to the table that
            the layout names, else to ``trials``.
        format: ``brainbench`` (our layout, any number of sessions in a file; the one of ``*.h5``), ``nwb`` (the one of
            folders), or ``temporaldata``, whose files torch_brain reads and which holds signals too.
    """
    target = Path(target)
    ending = target.suffix.lower()
    kind = format or ("brainbench" if ending in (".h5", ".hdf5") else "nwb")
    check_name("format", kind, _FORMATS)
    if ending and ending not in (endings := _FORMATS[kind]):
        raise UsageError(f"Files of {kind} end in {listing(endings)}, or name a folder; received {target.name!r}.")
    ledger, rules = Ledger(), Ledger()
    layout, paths = find_recordings(source, ledger)
    paths = suitable_files(paths, ledger)
    chosen = EVERYTHING if select is None else resolve_selection(select)
    sessions, subjects = [], set()
    for path in paths:
        with open_file(path) as file:
            for session, session_layout in each_session(file, path, layout):
                subjects.add(session.subject)
                if not session.has_spikes and not (signals := _signals(session, kind)):
                    held = _signals(session, "temporaldata")
                    reason = f"{session.source} holds {listing(held)}, for which copies in {kind} have no place"
                    ledger.leave("sessions", reason if held else no_units(session), lost=True)
                elif session.subject in (chosen.subjects or subjects):
                    table = session_layout.conditions.table if session_layout else "trials"
                    if not session.has_spikes:
                        session = replace(session, units=None, populations=signals)
                    sessions.append(subset(session, chosen, table, rules))
                    for fault in time_faults(session):
                        _LOG.warning("%s: %s", session.source, fault)
    check_each("subject", chosen.subjects, sorted(subjects))
    check_values(rules)
    for reason in ledger.skipped:
        _LOG.warning("Not copied: %s", reason)
    if not sessions:
        more = "" if kind == "temporaldata" else "; temporaldata holds signals too (--format temporaldata)"
        raise DataError(f"None of the {len(paths)} files of {source} holds units with spike times{more}.")
    if ending and kind != "brainbench" and len(sessions) > 1:
        raise UsageError(f"A file of {kind} holds one session, these are {len(sessions)}; name a folder.")
    places = [target] if ending else [target / name for name in _file_names(sessions, _FORMATS[kind][0])]
    if lost := {place.resolve() for place in places} & {path.resolve() for path in paths}:
        raise UsageError(f"The copy would take the place of its source {str(min(lost))!r}; name another target.")
    if kind == "brainbench":
        return [write_recordings(places[0], sessions)] if ending else list(map(write_recordings, places, sessions))
    return list(map(write_nwb if kind == "nwb" else write_temporaldata, places, sessions))


_FORMATS = {"brainbench": (".h5", ".hdf5"), "nwb": (".nwb",), "temporaldata": (".h5", ".hdf5")}
"""Formats of copies, and how their files end."""


def _signals(session: Session, kind: str) -> dict[str, Series]:
    """Return the signals of a session that a format holds: in our layout responses by trial, in NWB none."""
    signals = {place: item for place, item in session.populations.items() if isinstance(item, Series)}
    by_trial = {RESPONSE: signals[RESPONSE]} if RESPONSE in signals else {}
    return {"nwb": {}, "brainbench": by_trial}.get(kind, signals)


def subset(
    session: Session, selection: Selection = EVERYTHING, table: str = "trials", ledger: Ledger | None = None
) -> Session:
    """Read a session into memory: spikes, else signals, tables and plain columns of the rows that a selection keeps.

    ``ledger`` takes what the rules removed and met.
    """
    ledger = ledger or Ledger()
    tables: dict[str, SessionTable] = {}
    populations: dict[str, Series] = {}
    passing = {name: np.ones(len(original), dtype=bool) for name, original in session.tables.items()}
    if table in passing:
        passing[table] = select_rows(session.tables[table], selection.trials, "trials", ledger)
    for name, original in session.tables.items():
        tables[name] = SessionTable(name, _plain(original, passing[name]), original.where)
    if LICKS not in tables and (licks := lick_times(session)) is not None:
        tables[LICKS] = SessionTable(LICKS, {"start_time": licks, "stop_time": licks}, session.source)
    units = None if session.units is None else _units(session.units, selection, ledger)
    for place, series in session.populations.items() if units is None else ():
        values = np.asarray(series.data[...])
        values = values if values.ndim > 1 else values[:, None]
        cells = series.cells
        columns = select_rows(cells, selection.units, "units", ledger)
        values = values[passing[series.table]] if series.table else values
        stamps = None if series.timestamps is None else np.asarray(series.timestamps[...])
        conversion = np.broadcast_to(np.asarray(series.conversion, np.float64), len(cells))[columns]
        more = {"timestamps": stamps, "columns": _plain(cells, columns), "conversion": conversion}
        populations[place] = replace(series, name=place, data=values[..., columns], **more)
    return replace(session, units=units, tables=tables, series={}, populations=populations)


def _units(units: SessionTable, selection: Selection, ledger: Ledger) -> SessionTable:
    spikes = read_spikes(units, ledger.notes)
    chosen = select_rows(units, selection.units, "units", ledger)
    chosen &= np.array([len(times) for times in spikes]) >= selection.min_spikes
    if not chosen.any():
        raise DataError(f"No unit of {units.label} passes {'; '.join(selection.lines())}; nothing to copy.")
    columns = _plain(units, chosen)
    columns |= ragged(SPIKES, [times for times, keep in zip(spikes, chosen, strict=True) if keep])
    if not chosen.all() and OBSERVED not in columns and (span := recorded_span(spikes)) is not None:
        # The span was that of all units; the copy must not shrink it to that of those it holds.
        columns |= ragged(OBSERVED, [np.array([span])] * int(chosen.sum()))
    return SessionTable("units", columns, units.where)


def _plain(table: SessionTable, rows: NDArray[np.bool_]) -> dict[str, NDArray[Any]]:
    """Return the columns that mean something outside their file, of the rows kept; references do not."""
    columns: dict[str, NDArray[Any]] = {"id": table.ids()[rows]}
    for name in table.columns:
        raw = table.data[name]
        if isinstance(raw, LostColumn) and table.name == "units" and name != OBSERVED:
            continue
        if name == SPIKES or neurodata_type(raw) == "DynamicTableRegion" or table.index.get(name) in table.index:
            continue
        if name == OBSERVED:
            columns |= ragged(OBSERVED, [part for part, keep in zip(table.spans(), rows, strict=True) if keep])
            continue
        values = decode(raw[...]) if raw.size == max(raw.shape, default=1) else np.zeros(0, object)
        if values.dtype.kind not in "biufU":
            if table.name != "units":
                _LOG.warning(
                    "Not copied: column %r of %s, which has not one number or text per row.", name, table.label
                )
            continue
        if name not in table.index:
            columns[name] = table.column(name)[rows]
            continue
        parts = np.split(values.ravel(), table.ends(name)[:-1]) if len(table) else []
        parts = [part for part, keep in zip(parts, rows, strict=True) if keep]
        columns[name] = np.concatenate(parts) if parts else values[:0]
        columns[f"{name}_index"] = np.cumsum([len(part) for part in parts], dtype=np.int64)
    return columns


def _file_names(sessions: list[Session], ending: str) -> list[str]:
    """Return a name for each file; equal ones, as of the probes of one session, are numbered."""
    names: list[str] = []
    for session in sessions:
        subject, name = (re.sub(r"[^A-Za-z0-9]+", "-", part) for part in (session.subject, session.session))
        stem, number = f"sub-{subject}_ses-{name}", 1
        while (name := f"{stem}{f'_probe-{number}' * (number > 1)}{ending}") in names:
            number += 1
        names.append(name)
    return names
