"""Checks of the interval tables: damaged or misaligned columns, impossible times, and recorded spans."""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from brainbench.core.contracts import as_labels
from brainbench.core.errors import BrainbenchError, DataError, nearest, repeats
from brainbench.core.statistics import presentation_order
from brainbench.datasets.checks.findings import LONGEST_SESSION, Finding, Severity, share, some
from brainbench.datasets.inspection import propose
from brainbench.datasets.layouts.registry import RecordingLayout
from brainbench.datasets.sessions import Session, SessionTable
from brainbench.datasets.trials.conditions import Conditions, joined_labels, label_doubts
from brainbench.datasets.trials.counting import inside_observed_spans, recorded_span
from brainbench.datasets.trials.windows import CONTACTS, WHOLE, Window

_FEW = 2
"""Split halves need this many trials of every stimulus."""


def check_labels(session: Session, layout: RecordingLayout | None, conditions: Conditions | None) -> Iterator[Finding]:
    """Yield the findings about the condition labels of one session."""
    if conditions is None:
        proposals = [item.conditions for item in propose(session)]
        if session.tables:
            message = f"no layout fits, so labels were not checked; columns to try: {some(proposals, 3)}"
            yield Finding("note", "labels", message, "Pass --conditions TABLE:COLUMN to check them.")
        return
    try:
        table = session.table(conditions.table)
        values = conditions.values(table)
    except BrainbenchError as error:
        yield Finding("error", "labels", str(error))
        return
    counts = Counter(joined_labels(values))
    missing = counts.pop("", 0)
    if missing:
        message = f"{share(missing, len(table))} trials have no value of {', '.join(conditions.columns)}"
        yield Finding("warning" if missing < len(table) else "error", "labels", message, "They are left out.")
    vocabulary = layout.vocabulary(conditions) if layout else None
    forms = conditions.forms(table) if all(name in table for name in conditions.columns) else {}
    for doubt in label_doubts(forms, counts if vocabulary is None else ()):
        yield Finding("warning", "labels", doubt, "Make them one, or refuse them by --select.")
    if vocabulary is not None:
        yield from _strangers(counts, vocabulary, layout)
        counts = Counter({label: counts[label] for label in vocabulary})
    yield from _balance(counts, vocabulary)
    yield from _order(table, values)
    if {"outcome", "choice", "rewarded_side"} <= set(table.columns):
        yield from _answers(table)


def _order(table: SessionTable, values: NDArray[np.str_]) -> Iterator[Finding]:
    """Labels in blocks: slow changes over the session then pass for differences between stimuli."""
    labels = np.array(joined_labels(values))
    present = labels != ""
    with contextlib.suppress(DataError):
        order = presentation_order(table.times("start_time")[present], labels[present])
        if order is not None and order.confounded:
            message = f"stimulus and time are confounded: {order}"
            advice = "Drift alone then tells stimuli apart; `score` compares with the times of presentation."
            yield Finding("warning", "order", message, advice, {"share": order.share, "p": order.p})


def _strangers(counts: Counter[str], vocabulary: tuple[str, ...], layout: RecordingLayout | None) -> Iterator[Finding]:
    # What the layout refuses by rule (such as "nothing") is known and no misspelling.
    refused = {value for rule in layout.selection.trials for value in rule.refuse} if layout else set()
    for label in sorted(label for label in counts if label not in vocabulary and not refused & set(label.split("-"))):
        guess = nearest(label, vocabulary)
        meant = f"; did they mean {guess!r}?" if guess else ""
        message = f"{counts[label]} trials are labelled {label!r}, which is no stimulus of this experiment{meant}"
        yield Finding("warning", "labels", message, "They are left out.", {"label": label, "trials": counts[label]})


def _balance(counts: Counter[str], vocabulary: tuple[str, ...] | None) -> Iterator[Finding]:
    present = {label: number for label, number in counts.items() if number}
    if len(present) < 2:
        message = f"only {len(present)} label has trials; comparing responses needs at least two"
        yield Finding("error", "labels", message)
        return
    absent = [label for label in vocabulary or () if not counts[label]]
    if absent:
        message = f"no trial of {some(absent)}"
        yield Finding("warning", "labels", message, "Pairs with them are missing in this animal's RDM.")
    few = [f"{label} ({number})" for label, number in present.items() if number < _FEW]
    if few:
        message = f"{len(few)} labels have fewer than {_FEW} trials: {some(few)}"
        yield Finding("warning", "labels", message, "A session cannot be split into halves without two of each.")
    least, most = min(present.values()), max(present.values())
    if least >= _FEW and most > 4 * least:
        message = f"trials per label range from {least} to {most}"
        yield Finding("note", "labels", message, "Distances to the rarest label are the noisiest.")


def _answers(table: SessionTable) -> Iterator[Finding]:
    """Hold outcome against choice and rewarded side: they are equal in correct trials of either task."""
    try:
        outcome, choice, side = (as_labels(table.column(name)) for name in ("outcome", "choice", "rewarded_side"))
    except BrainbenchError:
        return
    decided = np.isin(outcome, ("correct", "error")) & np.isin(choice, ("left", "right"))
    wrong = decided & ((outcome == "correct") != (choice == side))
    if decided.any() and wrong.sum() > 0.02 * decided.sum():
        those = share(int(wrong.sum()), int(decided.sum()))
        message = f"outcome contradicts choice and rewarded_side in {those} trials"
        advice = "A column of the table has slipped, or outcome follows another rule; labels may be wrong too."
        yield Finding("error", "labels", message, advice, {"contradicted": int(wrong.sum())})
    if "stimulus" not in table:
        return
    # What was presented decides the rewarded side: by shape in one task, by presence in the other.
    stimulus = as_labels(table.column("stimulus"))
    mixed = []
    for label in sorted(set(stimulus.tolist()) - {""}):
        sides = Counter(side[(stimulus == label) & np.isin(side, ("left", "right"))].tolist())
        if sides and min(sides.values()) / sum(sides.values()) > 0.05 and len(sides) > 1:
            mixed.append(label)
    if mixed:
        message = f"both sides were rewarded for {some(mixed)}"
        advice = "In either task a stimulus has one rewarded side: stimulus and rewarded_side do not belong together."
        yield Finding("error", "labels", message, advice)


_LONGEST_TRIAL = 600.0
_MANY_ROWS = 10
"""A table of few long rows may be one of epochs."""
_SHIFTS = range(-5, 6)
"""Rows by which a column is tried against the trials."""
_GAP = 30.0
"""A silence of all units this long (s) is a break in the recording."""


def check_tables(session: Session) -> Iterator[Finding]:
    """Yield the findings about the interval tables of one session."""
    if not session.tables:
        message = "there are no interval tables: nothing says when which stimulus was presented"
        yield Finding("error", "tables", message)
    for table in session.tables.values():
        if table.fault:
            yield Finding("error", "tables", table.fault)
            continue
        yield from _damaged(table)
        if "start_time" in table and len(table):
            yield from _times(table)
    trials = session.tables.get("trials")
    if trials is not None and not trials.fault and "start_time" in trials and "stop_time" in trials and len(trials):
        try:
            yield from _events(trials)
            yield from _contacts(session, trials)
        except DataError:
            return  # The damaged column has been told already.


def _damaged(table: SessionTable) -> Iterator[Finding]:
    for name in table.columns:
        try:
            if name in table.index:
                table.ends(name)
            elif len(table.data[name]) != len(table):
                table.column(name)
        except BrainbenchError as error:
            advice = "Rows no longer belong together: write the table again."
            yield Finding("error", "tables", str(error), advice)
    if repeated := repeats(as_labels(table.ids()).tolist()):
        yield Finding("warning", "tables", f"table {table.name!r} has ids more than once ({some(repeated)})")


def _times(table: SessionTable) -> Iterator[Finding]:
    try:
        start = table.times("start_time")
        stop = table.times("stop_time") if "stop_time" in table else start
    except DataError as error:
        yield Finding("error", "tables", str(error))
        return
    name, rows = f"table {table.name!r}", len(table)
    impossible: tuple[tuple[Severity, NDArray[np.bool_], str], ...] = (
        ("error", ~np.isfinite(start), "no start_time"),
        ("error", stop < start, "a stop_time before their start_time"),
        ("warning", start < 0, "a start_time before the session began"),
    )
    for severity, bad, what in impossible:
        if bad.any():
            message = f"{share(int(bad.sum()), rows)} rows of {name} have {what}"
            yield Finding(severity, "times", message, "Such rows cannot be counted.")
    duration = stop - start
    finite = np.isfinite(duration)
    if not finite.any():
        return
    middle, last = float(np.median(duration[finite])), float(stop[finite].max())
    if (rows >= _MANY_ROWS and middle > _LONGEST_TRIAL) or last > LONGEST_SESSION:
        message = f"{name} runs to {last:g} s with rows of {middle:g} s (median)"
        yield Finding("error", "times", message, "Its times look like milliseconds or samples, not seconds.")
    if table.name == "trials" and np.any(np.diff(start) < 0):
        message = f"{name} is not in the order of time"
        yield Finding("note", "tables", message, "Trials are sorted when they are read; nothing is lost.")


def _events(trials: SessionTable) -> Iterator[Finding]:
    """Event times must lie in their own trial; if they fit another row, the column has slipped."""
    start, stop = trials.times("start_time"), trials.times("stop_time")
    for name in trials.columns:
        events = np.zeros(0)
        if name.endswith("_time") and name not in ("start_time", "stop_time"):
            with contextlib.suppress(BrainbenchError):
                events = trials.times(name)
        finite = np.isfinite(events)
        if finite.sum() < 5:
            continue
        inside = {shift: _inside(events, start, stop, shift) for shift in _SHIFTS}
        # Of shifts that fit equally well the smallest: events that fit every row have not slipped.
        best = max(inside, key=lambda shift: (inside[shift], -abs(shift)))
        values = {"column": name, "inside": inside[0], "shift": best, "inside_shifted": inside[best]}
        if best and inside[best] > 0.8 and inside[0] < 0.5:
            message = (
                f"{name} lies in its own trial in {100 * inside[0]:.0f} % of rows, but in the trial {best:+d} "
                f"rows away in {100 * inside[best]:.0f} %"
            )
            yield Finding("error", "tables", message, f"The column {name!r} has slipped against the others.", values)
        elif inside[0] < 0.5:
            advice = "The column may be on another clock; do not use it as an edge of windows."
            if np.mean((events[finite] >= 0) & (events[finite] <= (stop - start)[finite])) > 0.8:
                advice = "Its times look relative to the trial's start; windows need times of the session."
            outside = share(int(np.sum(finite) * (1 - inside[0])), int(finite.sum()))
            yield Finding("warning", "tables", f"{name} lies outside its own trial in {outside} rows", advice, values)


def _inside(events: NDArray[np.float64], start: NDArray[np.float64], stop: NDArray[np.float64], shift: int) -> float:
    """Share of events that lie in the trial ``shift`` rows away."""
    rows = np.arange(len(events)) + shift
    fits = np.isfinite(events) & (rows >= 0) & (rows < len(start))
    if not fits.any():
        return 0.0
    low, high = start[rows[fits]], stop[rows[fits]]
    return float(np.mean((events[fits] >= low) & (events[fits] <= high)))


def _contacts(session: Session, trials: SessionTable) -> Iterator[Finding]:
    start, stop = np.sort(trials.times("start_time")), np.sort(trials.times("stop_time"))
    brief, every = 0, 0
    for name, table in session.tables.items():
        if not CONTACTS.match(name) or not len(table):
            continue
        begin, end = table.times("start_time"), table.times("stop_time")
        # The last trial that began before each contact; −1 for contacts before the first trial.
        row = np.searchsorted(start, begin, side="right") - 1
        outside = (row < 0) | (begin > stop[np.maximum(row, 0)])
        if np.mean(outside) > 0.5:
            message = f"{share(int(outside.sum()), len(begin))} contacts of {name} lie in no trial"
            yield Finding("error", "tables", message, "Contacts and trials are on different clocks.")
        brief, every = brief + int(np.sum(end == begin)), every + len(begin)
    if brief:
        message = f"{share(brief, every)} contacts have zero duration"
        yield Finding("note", "tables", message, "They are not taken for a first contact.")


def check_coverage(
    session: Session, spikes: list[NDArray[np.float64]], layout: RecordingLayout | None, conditions: Conditions | None
) -> Iterator[Finding]:
    """Yield the findings about trials without recording, and breaks inside it.

    Of a trial the layout's window counts, without a layout all of it.
    """
    table = session.tables.get(conditions.table if conditions else "trials")
    span = recorded_span(spikes)
    if table is None or span is None or table.fault or "start_time" not in table or not len(table):
        return
    # Without ends of trials only their beginnings can be held against the recorded span.
    window = layout.window if layout else WHOLE if "stop_time" in table else Window("start", length=1e-3)
    try:
        edges = window.edges(session, table, [])
    except BrainbenchError:
        return  # What is wrong with the columns has been told already.
    edges = edges[np.isfinite(edges).all(axis=1)]
    start, stop = edges.T
    if not len(start):
        message = f"none of {len(table)} trials has the events of the window {window}"
        yield Finding("error", "coverage", message)
        return
    low, high = span
    observed = inside_observed_spans(session.units, edges) if session.units is not None else None
    if observed is not None:
        # One unit is enough: others may have been lost before the trial.
        outside = ~observed.any(axis=1)
    else:
        outside = ~((start >= low) & (stop <= high))
        message = "no obs_intervals: the recorded span is taken from the first to the last spike of all units"
        yield Finding("note", "coverage", message, "A unit lost early cannot be told from a silent one.")
    values = {"first_spike": low, "last_spike": high, "trials": len(start), "outside": int(outside.sum())}
    if outside.any():
        message = (
            f"{share(int(outside.sum()), len(start))} trials lie outside the recorded span (spikes: {low:.1f} to "
            f"{high:.1f} s, trials: {start.min():.1f} to {stop.max():.1f} s)"
        )
        severity: Severity = "error" if outside.all() else "warning" if outside.mean() > 0.1 else "note"
        question = " Do spikes and trials share a clock?" if severity != "note" else ""
        yield Finding(severity, "coverage", message, f"They are excluded, not read as silence.{question}", values)
    gaps = _gaps(spikes, low, high)
    if gaps:
        hit = sum(bool(np.any((start < end) & (stop > begin))) for begin, end in gaps)
        examples = some([f"{begin:.0f}–{end:.0f} s" for begin, end in gaps], 3)
        message = (
            f"no unit fires for more than {_GAP:g} s in {len(gaps)} places ({examples}), {hit} of them during trials"
        )
        advice = "If recording stopped, put these spans into an invalid_times table or leave them out of obs_intervals."
        yield Finding("warning" if hit else "note", "coverage", message, advice, {"gaps": gaps})


def _gaps(spikes: list[NDArray[np.float64]], low: float, high: float) -> list[tuple[float, float]]:
    """Spans without any spike longer than ``_GAP``, found on a grid of one second."""
    if high - low > LONGEST_SESSION:
        return []  # Times that cannot be seconds are told by another check.
    edges = np.arange(np.floor(low), np.ceil(high) + 2)
    fired = np.zeros(len(edges), dtype=bool)
    for times in spikes:
        fired[(times - edges[0]).astype(np.int64)] = True
    busy = np.flatnonzero(fired)
    after = np.flatnonzero(np.diff(busy) > _GAP)
    # The second of the last spike before a gap does not belong to it.
    return [(float(edges[busy[index]] + 1), float(edges[busy[index + 1]])) for index in after]
