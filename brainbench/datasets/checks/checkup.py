"""Checks of whole recordings: what is wrong with files, worst first, before a score hides it.

:func:`check` reads spike times and tables of every session (no raw data) and applies the checks of ``tables``,
``labels``, ``spikes`` and ``clock``. A finding is an *error* when results would be wrong, a *warning* when they may be,
a *note* when it only has to be known.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

from brainbench.core.errors import BrainbenchError, DataError
from brainbench.core.progress import Progress, track
from brainbench.datasets import hdf5
from brainbench.datasets.checks.findings import (
    SEVERITIES,
    Finding,
    Severity,
    check_clock,
    check_coverage,
    check_labels,
    check_spikes,
    check_tables,
    some,
)
from brainbench.datasets.layouts.registry import RecordingLayout, counted_layout
from brainbench.datasets.ledger import Ledger
from brainbench.datasets.reading import Source, each_session, find_recordings, open_file
from brainbench.datasets.sessions import Series, Session
from brainbench.datasets.trials.counting import ReadingOptions, count_session, no_units, read_spikes, time_fault
from brainbench.datasets.trials.selection import DEFAULT, WHOLE, Conditions, divided_labels, joined_labels, label_doubts
from brainbench.datasets.trials.session_trials import Copies

_NUMBER = re.compile(r"\d+(?:,\d{3})*(?:\.\d+)?")


@dataclass(frozen=True)
class Checkup:
    """Findings about the sessions of one source, worst first."""

    source: str
    files: int
    sessions: tuple[str, ...]
    """Sessions that could be opened, by name."""
    findings: tuple[Finding, ...]

    @property
    def verdict(self) -> str:
        """The worst severity found, ``"ok"`` if nothing was."""
        return next((level for level in SEVERITIES if self.count(level)), "ok")

    def count(self, severity: str) -> int:
        """Return the number of findings of one severity."""
        return sum(item.severity == severity for item in self.findings)

    def __str__(self) -> str:
        return "\n".join(self._lines())

    def _lines(self) -> Iterator[str]:
        counts = ", ".join(f"{self.count(level)} {level}{'s' * (self.count(level) != 1)}" for level in SEVERITIES)
        yield f"{self.source}: {len(self.sessions)} session{'s' * (len(self.sessions) != 1)}, {counts}"
        for items in _alike(self.findings):
            first, names = items[0], [item.where for item in items]
            where = names[0] if len(names) == 1 else f"{len(names)} sessions ({some(names, 3)})"
            yield f"{first.severity.upper():8}{first.check:12}{where}: {_ranges([item.message for item in items])}"
            if first.advice:
                yield f"{'':20}→ {first.advice}"


def _alike(findings: Iterable[Finding]) -> Iterable[list[Finding]]:
    """Return findings in groups: notes that differ in numbers alone stand together, others for themselves."""
    groups: dict[object, list[Finding]] = {}
    for place, finding in enumerate(findings):
        note = (finding.check, _NUMBER.sub("#", finding.message), finding.advice)
        groups.setdefault(note if finding.severity == "note" else place, []).append(finding)
    return groups.values()


def _ranges(messages: list[str]) -> str:
    """Return messages that differ in numbers alone as one, with the range of each number."""
    columns = zip(*(_NUMBER.findall(message) for message in messages), strict=True)
    spans = [sorted(set(numbers), key=lambda text: float(text.replace(",", ""))) for numbers in columns]
    texts = iter(numbers[0] if len(numbers) == 1 else f"{numbers[0]}–{numbers[-1]}" for numbers in spans)
    return _NUMBER.sub(lambda _: next(texts), messages[0])


def check(source: Source, *, conditions: str | Conditions | None = None, progress: Progress | None = None) -> Checkup:
    """Look for what would make scores of these recordings wrong.

    Files that cannot be read become findings, so that a folder is judged as a whole.

    Args:
        source: as in :func:`~brainbench.datasets.open_recordings`.
        conditions: table and columns that label the trials, to check the labels; the layout's by default.
        progress: called with (files checked, files, what).
    """
    ledger = Ledger()
    layout, paths = find_recordings(source, ledger)
    wanted = Conditions.parse(conditions) if isinstance(conditions, str) else conditions
    findings = [Finding("warning", "file", reason, where=str(source)) for reason in ledger.skipped]
    names: list[str] = []
    every = _Everything()
    for path in track(paths, "checking recordings", progress):
        try:
            findings += _check_file(path, layout, wanted, names, every)
        except DataError as error:
            beside = path in ledger.incidental and any(neighbour.suffix == ".nwb" for neighbour in paths)
            severity: Severity = "note" if beside and path.suffix != ".nwb" else "error"
            findings.append(Finding(severity, "file", str(error), where=path.name))
    singly = {finding.message for finding in findings}
    doubts = [*label_doubts(every.ledger.forms, {label for _, label in every.labels}), *divided_labels(every.labels)]
    across = (doubt for doubt in doubts if doubt not in singly)
    findings += [Finding("warning", "labels", doubt, _LABELS, where="all sessions") for doubt in across]
    place = str(source) if not isinstance(source, (list, tuple)) else ", ".join(map(str, source))
    worst_first = sorted(findings, key=lambda finding: SEVERITIES.index(finding.severity))
    return Checkup(place, len(paths), tuple(names), tuple(worst_first))


_LABELS = "Make them one, or refuse them by --select."


@dataclass
class _Everything:
    """What is compared across sessions: spikes, and the values that label trials."""

    copies: Copies = field(default_factory=Copies)
    ledger: Ledger = field(default_factory=Ledger)
    """How files write the labels."""
    labels: set[tuple[str, str]] = field(default_factory=set)
    """Each animal with each of its labels."""


def _check_file(
    path: Path, layout: RecordingLayout | None, conditions: Conditions | None, names: list[str], every: _Everything
) -> Iterator[Finding]:
    if (counted := counted_layout(path, layout)) is not None and counted.check_counted is not None:
        yield from counted.check_counted(path, names)
        return
    with open_file(path) as file:
        if hdf5.holds_counts(file, path):
            hdf5.read_counts(file, path)
            message = "holds responses that are already counted; spikes, clock and tables cannot be checked"
            yield Finding("note", "file", message, where=path.name)
            return
        for session, session_layout in each_session(file, path, layout):
            names.append(session.subject + f" / {session.session}" * (session.session != session.subject))
            for finding in check_session(session, session_layout, conditions, every):
                yield replace(finding, where=names[-1])


def check_session(
    session: Session,
    layout: RecordingLayout | None = None,
    conditions: Conditions | None = None,
    every: _Everything | None = None,
) -> Iterator[Finding]:
    """Yield the findings about one session, which must still be open."""
    every = every or _Everything()
    signals = [place for place, item in session.populations.items() if isinstance(item, Series)]
    if not session.has_spikes and not signals:
        # Nothing else matters of a file that scores skip.
        yield Finding("error", "units", no_units(session))
        return
    conditions = conditions or (layout.conditions if layout else None)
    yield from check_tables(session)
    yield from check_labels(session, layout, conditions)
    if not session.has_spikes or session.units is None:
        yield Finding("note", "units", f"holds signals and no spikes ({some(signals)}); tables and drift are checked")
        if conditions is not None:
            yield from _check_signal(session, conditions, layout)
        return
    table = session.tables.get(conditions.table if conditions else "trials")
    with contextlib.suppress(BrainbenchError):
        if table is not None and conditions is not None:
            every.ledger.add(Ledger(forms=conditions.forms(table)))
            fixed = layout is not None and layout.vocabulary(conditions) is not None
            labels = set() if fixed else {*joined_labels(conditions.values(table))} - {""}
            every.labels |= {(session.subject, label) for label in labels}
    notes: list[str] = []
    try:
        spikes = read_spikes(session.units, notes)
    except DataError as error:
        yield Finding("error", "spikes", str(error))
        return
    for note in notes:
        yield Finding("warning", "spikes", note, "Whoever wrote the file may have joined trials or probes.")
    with contextlib.suppress(BrainbenchError):  # of the table, which is told already
        if table is not None and (fault := time_fault(spikes, table)):
            yield Finding("error", "times", fault)
    try:
        if doubt := every.copies.compare(session, spikes):
            yield Finding("warning", "duplicates", doubt)
    except DataError as error:
        yield Finding("error", "duplicates", str(error))
    yield from check_spikes(session, spikes)
    yield from check_coverage(session, spikes, layout, conditions)
    yield from check_clock(session, spikes, layout)


def _check_signal(session: Session, conditions: Conditions, layout: RecordingLayout | None) -> Iterator[Finding]:
    """Yield what is said of the signal of a session whose trials are read: time base, frame rate, drift."""
    rules = (layout.selection, layout.window) if layout else (DEFAULT, WHOLE)
    try:
        part = count_session(session, ReadingOptions(conditions, None, *rules))
    except BrainbenchError as error:
        advice = "Or name another signal or window: --window 'FROM..TO of SIGNAL'."
        yield Finding("error", "signals", str(error), advice)
        return
    for doubt in part.ledger.doubts:
        yield Finding("warning", "signals", doubt)
