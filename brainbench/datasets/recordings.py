"""Open recordings: files → sessions → one data set of counted trials.

The result (contract: :func:`brainbench.core.contracts.check_recordings`) depends on the content of the files
only: trials are sorted by subject, session, start time and id, units by subject, session and id.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np

from brainbench.core.contracts import check_recordings
from brainbench.core.errors import DataError, UsageError, check_each, listing
from brainbench.core.progress import Progress, track
from brainbench.core.reading.hdf5 import MissingFilterError
from brainbench.datasets import hdf5
from brainbench.datasets.inspection import propose
from brainbench.datasets.layouts.registry import RecordingLayout, counted_layout, list_layouts
from brainbench.datasets.ledger import Ledger
from brainbench.datasets.reading import (
    Source,
    each_session,
    find_recordings,
    open_file,
    resolve_selection,
    suitable_files,
)
from brainbench.datasets.sessions import Session
from brainbench.datasets.trials.counting import ReadingOptions, SessionCounts, count_session, no_units
from brainbench.datasets.trials.selection import DEFAULT, WHOLE, Conditions, Selection, Window
from brainbench.datasets.trials.session_trials import Copies, join_sessions, joined_probes
from brainbench.datasets.trials.signals import response_series

if TYPE_CHECKING:
    import xarray as xr


def open_recordings(
    source: Source,
    *,
    conditions: str | Conditions | None = None,
    select: Selection | str | None = None,
    window: Window | str | None = None,
    bin: float | None = None,
    strict: bool = False,
    progress: Progress | None = None,
) -> xr.Dataset:
    """Read recordings into counted trials.

    Args:
        source: a file (NWB 2.x, our HDF5 layout or the published ``.npz``), a folder, a glob, a list of these, or
            ``LAYOUT:PATH`` to read them by a named layout. Every file is a session.
        conditions: ``TABLE:COLUMN[,COLUMN]``: the interval table whose rows are trials and the columns
            whose values, joined with "-", label them.
        select: a :class:`Selection`, a name ("none", "default", "rodgers") or rules in text. By default
            the layout's, else all trials and every unit with a spike.
        window: a :class:`Window` or text such as "first-contact..choice" or "start+0.2..+0.5". By
            default the layout's, else start..stop.
        bin: bin width, s; None counts each window as one bin.
        strict: refuse files among several that hold no recordings (another kind of file, a damaged one, no units),
            which are skipped and named by default.
        progress: called with (files read, files, what).

    A layout is used when it is named, or when every file has its layout and ``conditions`` are left out
    or use its table; an argument replaces the layout's part. Labels follow the layout's fixed
    vocabulary, else they are sorted naturally; never by appearance.

    Returns:
        ``counts`` [trial, time, unit] (float32; NaN = not recorded) and ``duration`` [trial, time] (s), with
        ``stimulus, subject, session, trial_id, window_start, window_stop`` per trial, ``unit_subject, unit_session,
        unit_id, depth, layer, inhibitory`` per unit, ``time`` (begin of the bin, s from the window's begin), and
        attributes: vocabulary, conditions, layout, window, bin, selection, removed (rule → trials or units that it
        removed, each counted once, in the order of the rules), missing (subject → labels without a trial), sessions,
        notes, doubts (notes that every result must state), overlap (share of trials whose window overlaps with that of
        an earlier one of their label), skipped (why a file is left out), sizes, source, synthetic, content_hash.
    """
    ledger = Ledger(strict=strict)
    layout, paths = find_recordings(source, ledger)
    wanted = Conditions.parse(conditions) if isinstance(conditions, str) else conditions
    given = {"conditions": wanted, "select": select, "window": window, "bin": bin}
    if len(paths) == 1 and (ready := _already_counted(paths[0], layout, given)) is not None:
        return ready
    reader = _Reader(
        conditions=wanted,
        selection=None if select is None else resolve_selection(select),
        window=Window.parse(window) if isinstance(window, str) else window,
        bin=bin,
        layout=layout,
        layout_given=layout is not None,
        ledger=ledger,
    )
    suitable = suitable_files(paths, ledger)
    reader.lenient = len(suitable) > 1 and not strict
    for path in track(suitable, "reading recordings", progress):
        reader.read(path)
    name = ", ".join(map(str, suitable)) if len(suitable) < 4 else f"{len(suitable)} files, {suitable[0]} …"
    return reader.dataset(name)


@dataclass
class _Reader:
    """Counts session after session; makes sure all are read alike and none comes twice."""

    conditions: Conditions | None
    selection: Selection | None
    window: Window | None
    bin: float | None
    layout: RecordingLayout | None
    """The layout that the source named; else the one by which the first session was recognised."""
    layout_given: bool
    ledger: Ledger
    lenient: bool = False  # skip what cannot be used of one file, because others may have it
    options: ReadingOptions | None = None  # made for the first session and kept for all others
    counted: list[SessionCounts] = field(default_factory=list)
    copies: Copies = field(default_factory=Copies)
    first: str = ""  # source of the session for which the options were made
    subjects: dict[str, str] = field(default_factory=dict)
    """Every animal of the files → why it is left out; empty for one that is read."""

    def read(self, path: Path) -> None:
        """Count the sessions of one file."""
        number, why = len(self.counted), (f"{path} holds no session", True)
        try:
            with open_file(path) as file:
                for session, session_layout in each_session(file, path, self.layout if self.layout_given else None):
                    self.ledger.find("sessions")
                    reason, lost = self._count(session, session_layout)
                    if reason:
                        self.ledger.leave("sessions", reason, lost=lost)
                        why = reason, lost
                        self.subjects.setdefault(session.subject, reason)
                    else:
                        self.ledger.find("sessions", 0, 1)
                        self.subjects[session.subject] = ""
        except MissingFilterError as error:
            if not self.lenient:
                raise
            self.ledger.leave("files", str(error), lost=True)
            self.ledger.leave("sessions", str(error), lost=True)
            return
        if len(self.counted) > number:
            self.ledger.find("files", 0, 1)
        else:
            self.ledger.leave("files", why[0], lost=why[1])

    def _count(self, session: Session, session_layout: RecordingLayout | None) -> tuple[str, bool]:
        """Count a session; else return why not, and whether nobody asked for that."""
        if not session.has_spikes and response_series(session, self.window) is None:
            return no_units(session), True
        table = None if self.conditions is None else self.conditions.table
        if self.lenient and table is not None and table not in session.tables:
            return f"{session.source} has no table {table!r}; its tables: {listing(session.tables)}", True
        options = self._options_for(session, session_layout)
        if options.selection.subjects and session.subject not in options.selection.subjects:
            return f"{session.subject} is not among the chosen animals", False
        part = count_session(session, options, self.copies.compare)
        self.counted.append(part)
        return "", False

    def _options_for(self, session: Session, session_layout: RecordingLayout | None) -> ReadingOptions:
        """Return the options of all sessions, made for the first one; a later one must have its layout."""
        if not self.layout_given:
            if (
                session_layout is not None
                and self.conditions is not None
                and self.conditions.table != session_layout.conditions.table
            ):
                session_layout = None
            if self.options is not None and session_layout is not self.layout:
                # Going on with the first file's layout would make the result depend on the order of files.
                raise UsageError(
                    f"{session.source} has another layout than {self.first}; open them apart, or "
                    f"name the layout for both: {listing(f'{name}:PATH' for name in list_layouts())}."
                )
            self.layout = session_layout
        if self.options is None:
            self.first = session.source
            layout = self.layout
            conditions = self.conditions or (layout.conditions if layout else _no_conditions(session))
            self.options = ReadingOptions(
                conditions=conditions,
                vocabulary=layout.vocabulary(conditions) if layout else None,
                selection=self.selection or (layout.selection if layout else DEFAULT),
                window=self.window or (layout.window if layout else WHOLE),
                bin=self.bin,
            )
        return self.options

    def dataset(self, source: str) -> xr.Dataset:
        """Join what was counted; see :func:`open_recordings`."""
        skipped = self.ledger.skipped
        if self.options is None:
            more = f" ({len(skipped) - 1} more likewise)" if len(skipped) > 1 else ""
            raise DataError(f"{skipped[0]}{more}" if skipped else "The file holds no session.")
        check_each("subject", self.options.selection.subjects, sorted(self.subjects))
        if not self.counted:
            raise DataError(f"No session of the chosen subjects can be counted. {skipped[0]}")
        name = self.layout.name if self.layout else ""
        name += "" if self.layout_given or not name else " (detected from its columns)"
        parts = joined_probes(self.counted, self.ledger.doubts)
        stated = {"source": source, "layout": name, "notes": skipped, "doubts": self.ledger.doubts}
        joined = join_sessions(parts, self.options, **stated)
        if self.bin is not None and (longest := float(joined["duration"].max())) < (1 - 1e-6) * self.bin:
            raise UsageError(
                f"A bin of {self.bin:g} s is longer than every window (up to {longest:g} s), so it cuts nothing; leave "
                "it out, or give it in seconds."
            )
        self._balance(parts, joined)
        return check_recordings(joined)

    def _balance(self, parts: list[SessionCounts], joined: xr.Dataset) -> None:
        """Close the ledger over the sessions that were counted, and write it into the data set."""
        ledger, read = self.ledger, {*joined["subject"].values.tolist()}
        ledger.find("animals", len(self.subjects), len(read))
        for name, reason in self.subjects.items():
            if name not in read:
                chosen = reason.endswith("chosen animals")
                ledger.leave("animals", reason or f"{name}: no trial is left", lost=not chosen)
        labels = {*np.concatenate([part.table_labels for part in parts]).tolist()} - {""}
        present = labels & {*joined["stimulus"].values.tolist()}
        ledger.find("labels", len(labels), len(present))
        for label in sorted(labels - present):
            ledger.leave("labels", f"{label}: no trial is left")
        for part in parts:
            ledger.add(part.ledger)
        for entry in ledger.close():
            joined.attrs["doubts"] = [*joined.attrs["doubts"], f"the balance does not close: {entry}"]
        joined.attrs |= {"skipped": ledger.skipped, "ledger": ledger.stated()}


def _no_conditions(session: Session) -> NoReturn:
    """Raise the error for a session that no layout says how to label, with columns to try."""
    proposals = [item.conditions for item in propose(session)][:4]
    if not proposals:
        raise DataError(
            f"{session.source} has no interval table with a column that could label trials (3 to 60 values, "
            f"each at least twice; tables: {listing(session.tables)}); there is nothing to compare."
        )
    raise UsageError(
        f"{session.source} does not say which column holds the conditions; pass conditions TABLE:COLUMN, such "
        f"as {listing(proposals)}."
    )


def _already_counted(path: Path, layout: RecordingLayout | None, given: Mapping[str, Any]) -> xr.Dataset | None:
    if (counted := counted_layout(path, layout)) is not None and counted.open_counted is not None:
        return counted.open_counted(path, **given)
    with open_file(path) as file:
        if not hdf5.holds_counts(file, path):
            return None
        if layout is not None or any(option is not None for option in given.values()):
            raise UsageError(
                f"{path} holds responses that are already counted, so conditions, select, window, bin and layouts "
                f"cannot apply; leave them out, or open the original spike times."
            )
        return hdf5.read_counts(file, path)
