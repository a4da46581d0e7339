"""Checks of one session, each of which yields findings: tables and labels, spikes, and the clock.

Spikes and behaviour share a clock where neurons answer touch within 5 to 30 ms. The response to touch at a lag τ is the
spike rate 5 to 30 ms after (touch + τ) minus the rate in the 60 ms before (touch + τ), averaged over touches. On a
common clock it peaks at τ = 0; if spikes are late by ten seconds, it peaks there. It is computed at all lags within ±10
minutes through one cross-correlation, and judged against its own spread over lags (median absolute deviation).
"""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from brainbench.core.contracts import as_labels
from brainbench.core.errors import BrainbenchError, DataError, listing, nearest, repeats
from brainbench.core.statistics import presentation_order
from brainbench.datasets.inspection import propose
from brainbench.datasets.layouts.registry import RecordingLayout
from brainbench.datasets.ledger import Ledger
from brainbench.datasets.sessions import Session, SessionTable
from brainbench.datasets.trials import selection
from brainbench.datasets.trials.counting import SpikeTrains, recorded_span

Severity = Literal["error", "warning", "note"]
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")  # worst first
LONGEST_SESSION = 48 * 3600.0  # times that span more than this (s) are no seconds


@dataclass(frozen=True)
class Finding:
    """One fault that a check found."""

    severity: Severity
    check: str
    """Name, such as file, units, signals, duplicates, silent, tables, times, labels, order, coverage or clock."""
    message: str
    """The fault, in numbers."""
    advice: str = ""
    values: dict[str, Any] = field(default_factory=dict)
    """The measurements behind it, for programs."""
    where: str = ""
    """The session, or the file; filled in by the checkup."""


def share(part: int, whole: int) -> str:
    """Return a part of a whole for a message: ``"3 of 40 (8 %)"``."""
    return f"{part} of {whole} ({100 * part / max(whole, 1):.0f} %)"


def some(names: list[str], limit: int = 5) -> str:
    """Return the first few names and how many more there are."""
    return listing(names, limit=limit, quoted=False)


_FEW = 2  # split halves need this many trials of every stimulus


def check_labels(
    session: Session, layout: RecordingLayout | None, conditions: selection.Conditions | None
) -> Iterator[Finding]:
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
    counts = Counter(selection.joined_labels(values))
    missing = counts.pop("", 0)
    if missing:
        message = f"{share(missing, len(table))} trials have no value of {', '.join(conditions.columns)}"
        yield Finding("warning" if missing < len(table) else "error", "labels", message, "They are left out.")
    vocabulary = layout.vocabulary(conditions) if layout else None
    forms = conditions.forms(table) if all(name in table for name in conditions.columns) else {}
    for doubt in selection.label_doubts(forms, counts if vocabulary is None else ()):
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
    labels = np.array(selection.joined_labels(values))
    present = labels != ""
    with contextlib.suppress(BrainbenchError):
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


_SHIFTS = range(-5, 6)  # rows by which a column is tried against the trials
_GAP = 30.0  # a silence of all units this long (s) is a break in the recording


def check_tables(session: Session) -> Iterator[Finding]:
    """Yield the findings about the interval tables of one session."""
    if not session.tables:
        yield Finding("error", "tables", "there are no interval tables: nothing says when which stimulus was presented")
    for reason in session.unread:
        yield Finding("warning", "units", reason, "Put all units into one table, or remove those that are not wanted.")
    for reason in [] if session.units is None or session.units.fault else session.units.lost:
        yield Finding("warning", "units", reason, "Scores that ask for this column are refused.")
    for table in session.tables.values():
        if table.fault:
            yield Finding("error", "tables", table.fault)
            continue
        yield from _damaged(table)
        if "start_time" not in table:
            yield Finding("error", "tables", f"{table.label} has no start_time: nothing says when its rows began")
        elif len(table):
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
            yield Finding("error", "tables", str(error), "Rows no longer belong together: write the table again.")
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
        if not selection.CONTACTS.match(name) or not len(table):
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
    session: Session,
    spikes: list[NDArray[np.float64]],
    layout: RecordingLayout | None,
    conditions: selection.Conditions | None,
) -> Iterator[Finding]:
    """Yield the findings about trials without recording, and breaks inside it.

    Of a trial the layout's window counts, without a layout all of it.
    """
    table = session.tables.get(conditions.table if conditions else "trials")
    span = recorded_span(spikes)
    if table is None or span is None or table.fault or "start_time" not in table or not len(table):
        return
    if layout is None and "stop_time" not in table:
        advice = "Name the end of the window: --window start..+SECONDS."
        yield Finding("warning", "coverage", f"{table.label} has no stop_time, and by default it ends windows", advice)
    # Without ends of trials only their beginnings can be held against the recorded span.
    whole = selection.WHOLE if "stop_time" in table else selection.Window("start", length=1e-3)
    window = layout.window if layout else whole
    try:
        edges = window.edges(session, table, [])
    except BrainbenchError:
        return  # What is wrong with the columns has been told already.
    edges = edges[np.isfinite(edges).all(axis=1)]
    start, stop = edges.T
    if not len(start):
        yield Finding("error", "coverage", f"none of {len(table)} trials has the events of the window {window}")
        return
    low, high = span
    assert session.units is not None
    # One unit is enough: others may have been lost before the trial.
    outside = ~SpikeTrains(session.units, spikes).covered(edges, ledger := Ledger()).any(axis=1)
    if ledger.notes:
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
        places = f"{len(gaps)} places ({examples}), {hit} of them during trials"
        message = f"no unit fires for more than {_GAP:g} s in {places}"
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


BIN = 0.005  # resolution, s
RESPONSE = (0.005, 0.030)  # time after a touch in which neurons answer, s
BEFORE = 0.060  # baseline before it, s
LARGEST = 600.0  # largest shift that is searched for, s
CLEAR = 6.5
"""Standard deviations from which a response at any of 240,000 lags is taken for real; Poisson noise of
one to thirty units reached 6 in 450 sessions."""
PRESENT, ABSENT = 3.5, 2.5
"""Standard deviations from which, and below which, there is (not) a response at the touch itself; noise
exceeds the first in one session of 450."""
RHYTHM = 2.0  # time (s) around a first touch in which other touches are answered too
TOLERANCE = 0.020  # shift (s) up to which the clock is taken for right
_FEWEST_EVENTS = 20
# Longest span of spikes that is searched, s: 8.6 million bins, of which the correlation makes several arrays.
_LONGEST = 12 * 3600.0


def check_clock(
    session: Session, spikes: list[NDArray[np.float64]], layout: RecordingLayout | None
) -> Iterator[Finding]:
    """Yield what can be said about the clock of one session."""
    contacts = touches(session, layout)
    if contacts is None:
        message = "no touch times (tables contacts_by_whisker_*, or a layout's event), so the clock cannot be checked"
        yield Finding("note", "clock", message, "Look at spike rates around a known event before scoring.")
        return
    times, event = contacts
    every = np.concatenate(spikes) if spikes else np.zeros(0)
    span = float(np.ptp(every)) if len(every) else 0.0
    if len(every) and span <= _LONGEST:
        times = times[(times > every.min() - LARGEST) & (times < every.max() + LARGEST)]
    if len(times) < _FEWEST_EVENTS or len(every) < _FEWEST_EVENTS or span > _LONGEST:
        why = f"over {span / 3600:.0f} hours" if span > _LONGEST else "are too few"
        message = f"{len(times)} touches near the recording and {len(every)} spikes {why}: the clock was not checked"
        yield Finding("warning", "clock", message)
        return
    lags, response, size = response_by_lag(every, times)
    near = np.abs(lags) <= TOLERANCE
    at_touch = float(size[near].max())
    lag, elsewhere = _other_lag(lags, size, at_touch)
    values = {"event": event, "touches": len(times), "response_hz": float(response[near].max())}
    values |= {"sd_at_touch": at_touch, "lag": lag, "sd_at_lag": elsewhere}
    if lag:
        message = (
            f"spikes follow touch ({event}) by about {_seconds(lag)} s instead of 5 to 30 ms (response "
            f"{elsewhere:.0f} SD there, {at_touch:.1f} SD at the touch)"
        )
        yield Finding("error", "clock", message, _advice(session, lag), values)
    elif at_touch >= PRESENT:
        message = f"spikes answer touch ({event}) within 5 to 30 ms ({at_touch:.1f} SD, {len(times)} touches)"
        yield Finding("note", "clock", message, "", values)
    else:
        message = (
            f"no response to touch ({event}) stands out at any lag within ±{-lags[0]:.0f} s ({at_touch:.1f} SD at "
            f"the touch); the clock cannot be confirmed"
        )
        yield Finding("warning", "clock", message, "Few or untuned units, or a clock that drifts.", values)


def _other_lag(lags: NDArray[np.float64], size: NDArray[np.float64], at_touch: float) -> tuple[float, float]:
    """Return the lag (s) of a response that shows another clock and its size (SD); 0 if there is none.

    A first touch is followed by others, so a response up to ``RHYTHM`` away counts only if there is
    none at the touch itself, and one further away only if it is clearly larger than any nearby.
    """
    close = np.abs(lags) <= RHYTHM
    # In a recording of a few seconds all lags are close, and none is far.
    far = int(np.argmax(np.where(close, -np.inf, size))) if not close.all() else 0
    near = int(np.argmax(np.where(close, size, -np.inf)))
    if not close.all() and size[far] >= CLEAR and size[far] > 1.5 * size[near]:
        best = far
    elif size[near] >= CLEAR and at_touch < ABSENT:
        best = near
    else:
        return 0.0, 0.0
    # Later touches may be answered more; the first clear answer is that to the first touch.
    before = (lags >= lags[best] - RHYTHM) & (lags <= lags[best]) & (size >= 0.5 * size[best])
    return float(lags[np.flatnonzero(before)[0]]), float(size[best])


def touches(session: Session, layout: RecordingLayout | None) -> tuple[NDArray[np.float64], str] | None:
    """Return touch times (s) of a session and what they are, or None where it has none.

    First contacts of the trials if there are contact tables, else the event that the layout names.
    """
    trials = session.tables.get(layout.conditions.table if layout else "trials")
    contacts = any(selection.CONTACTS.match(name) for name in session.tables)
    event = selection.FIRST_CONTACT if contacts else layout.touch if layout else ""
    if trials is None or not event or (event == selection.FIRST_CONTACT and not contacts):
        return None
    try:
        edges = selection.Window(event, length=1.0).edges(session, trials, [])
    except BrainbenchError:
        return None
    return np.sort(edges[np.isfinite(edges[:, 0]), 0]), event


def response_by_lag(
    spikes: NDArray[np.float64], touches: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Cross-correlate touches and spikes.

    Returns lags [L] (s), response [L] (Hz, all units together), and its size [L] in robust standard deviations over
    lags.
    """
    from scipy.signal import fftconvolve

    # Room for the largest shift on both sides, so that every touch + lag lies on the grid.
    low = min(float(spikes.min()), float(touches[0])) - LARGEST - 1.0
    high = max(float(spikes.max()), float(touches[-1])) + LARGEST + 1.0
    number = int((high - low) / BIN) + 1
    # Rate of all units together in each bin, Hz.
    rate = np.bincount(((spikes - low) / BIN).astype(np.int64), minlength=number) / BIN
    after = np.zeros(number)
    begin, end = round(RESPONSE[0] / BIN), round(RESPONSE[1] / BIN)
    before = round(BEFORE / BIN)
    total = np.concatenate([[0.0], np.cumsum(rate)])
    index = np.arange(before, number - end)
    # Mean rate in RESPONSE after each bin less that in BEFORE, Hz: differences of running sums, for all bins at once.
    after[index] = (total[index + end] - total[index + begin]) / (end - begin)
    after[index] -= (total[index] - total[index - before]) / before
    events = np.bincount(((touches - low) / BIN).astype(np.int64), minlength=number).astype(np.float64)
    # The correlation at lag τ is the sum of ``after`` at touch + τ; lag 0 stands in the middle.
    correlation = fftconvolve(after, events[::-1], mode="full")
    # Further away, fewer than half of the touches would still fall into the recording.
    reach = round(min(LARGEST, 0.5 * float(np.ptp(spikes))) / BIN)
    lags = np.arange(-reach, reach + 1, dtype=np.float64) * BIN
    # Number of touches at each lag whose shifted time lies between the first and the last spike.
    first, last = np.searchsorted(touches, spikes.min() - lags), np.searchsorted(touches, spikes.max() - lags)
    inside = np.maximum(last - first, 1)
    response = correlation[number - 1 - reach : number + reach] / inside
    # A mean of fewer touches is noisier; at equal numbers the noise of all lags can be pooled.
    scaled = (response - np.median(response)) * np.sqrt(inside)
    # 1.4826 × the median absolute deviation is the standard deviation of normal noise; unlike that, it is not
    # widened by the few lags at which there is a response.
    spread = max(1.4826 * float(np.median(np.abs(scaled))), 1e-9)
    return lags, response, scaled / spread


def _advice(session: Session, lag: float) -> str:
    for series in session.series.values():
        if series.start and abs(abs(lag) - series.start) < 0.05:
            return (
                f"That is the starting_time of {series.name} ({series.start:g} s): it was "
                f"{'added' if lag > 0 else 'subtracted'} though spikes are on the session's clock already."
            )
    return f"Subtract about {_seconds(lag)} s from all spike times, or find out their clock, before scoring."


def _seconds(lag: float) -> str:
    """Write a lag (s) as exactly as it is known, which is the width of the response."""
    return f"{lag:+.1f}" if abs(lag) >= 1 else f"{lag:+.2f}"


Spikes = list[NDArray[np.float64]]

COINCIDENT = 2e-4  # spikes of two units this close (s) are taken for one: a spike lasts about a millisecond
SAME, SIMILAR = 0.95, 0.5  # share of the smaller unit's spikes that coincide with the other's, beyond chance
REFRACTORY = 1.5e-3  # no neuron fires again within this time (s)
VIOLATIONS, MANY_VIOLATIONS = 0.01, 0.1
"""Share of intervals below the refractory time in a unit that is not one neuron, or no neuron at all."""
_FEWEST_SPIKES = 50  # spikes that a unit needs to be judged


def check_spikes(session: Session, spikes: Spikes) -> Iterator[Finding]:
    """Yield the findings about spike times [U] of one session."""
    ids = as_labels(session.units.ids()).tolist() if session.units is not None else []
    names = [f"unit {name}" for name in ids]
    yield from _silent(spikes, names)
    yield from _impossible(spikes, names)
    yield from _refractory(spikes, names)
    yield from _duplicates(spikes, names)
    if repeated := repeats(ids):
        message = f"{len(repeated)} unit ids occur more than once ({some(repeated)})"
        yield Finding("warning", "units", message, "Fine for several probes; else units were merged wrongly.")


def _silent(spikes: Spikes, names: list[str]) -> Iterator[Finding]:
    silent = [name for name, times in zip(names, spikes, strict=True) if not len(times)]
    if silent:
        message = f"{share(len(silent), len(names))} units have no spike ({some(silent)})"
        advice, values = "They are left out unless the selection says otherwise.", {"silent": len(silent)}
        severity: Severity = "error" if len(silent) == len(names) else "note"
        yield Finding(severity, "silent", message, advice, {**values, "units": len(names)})


def _impossible(spikes: Spikes, names: list[str]) -> Iterator[Finding]:
    low = min((float(times[0]) for times in spikes if len(times)), default=0.0)
    if low < 0:
        early = [name for name, times in zip(names, spikes, strict=True) if len(times) and times[0] < 0]
        message = f"{share(len(early), len(names))} units have spikes before the session began (first at {low:.3f} s)"
        yield Finding("warning", "times", message, "Was a starting time subtracted twice?", {"first": low})


def _refractory(spikes: Spikes, names: list[str]) -> Iterator[Finding]:
    rates = {
        name: float(np.mean(np.diff(times) < REFRACTORY))
        for name, times in zip(names, spikes, strict=True)
        if len(times) >= _FEWEST_SPIKES
    }
    bands: tuple[tuple[Severity, float, float, str], ...] = (
        ("error", MANY_VIOLATIONS, np.inf, "These are no single neurons: exclude them or sort again."),
        ("warning", VIOLATIONS, MANY_VIOLATIONS, "They mix neurons; RDMs stand, claims about single neurons do not."),
    )
    for severity, low, high, advice in bands:
        bad = {name: rate for name, rate in rates.items() if low <= rate < high}
        if bad:
            worst_first = sorted(bad, key=lambda name: -bad[name])
            examples = some([f"{name}: {100 * bad[name]:.1f} %" for name in worst_first], 3)
            message = f"{share(len(bad), len(names))} units fire again within {1e3 * REFRACTORY:g} ms ({examples})"
            yield Finding(severity, "refractory", message, advice, {"share": bad})


def _duplicates(spikes: Spikes, names: list[str]) -> Iterator[Finding]:
    pairs_alike = coincidences(spikes)
    bands: tuple[tuple[Severity, float, float, str], ...] = (
        ("error", SAME, np.inf, "Remove one of each pair: twins count twice in every RDM."),
        ("warning", SIMILAR, SAME, "Was one neuron split, or sorted on two channels? Twins count twice in every RDM."),
    )
    for severity, low, high, advice in bands:
        pairs = [(one, two, part) for one, two, part in pairs_alike if low <= part < high]
        if pairs:
            examples = some([f"{names[one]} = {names[two]}: {100 * part:.0f} %" for one, two, part in pairs], 3)
            what = f"{len(pairs)} pair{'s' * (len(pairs) > 1)} of units"
            message = f"{what} have the same spikes within {1e3 * COINCIDENT:g} ms ({examples})"
            values = {"pairs": [[names[one], names[two], part] for one, two, part in pairs]}
            yield Finding(severity, "duplicates", message, advice, values)


def coincidences(spikes: Spikes) -> list[tuple[int, int, float]]:
    """Find pairs of units whose spikes coincide more than chance.

    Every spike is compared with the next ones of all units together, so the cost grows with the number of spikes and
    not with that of pairs. Returns (unit, unit, share of the smaller one's spikes beyond chance) of all pairs above
    ``SIMILAR``.
    """
    lengths = np.array([len(times) for times in spikes])
    judged = np.flatnonzero(lengths >= _FEWEST_SPIKES)
    if len(judged) < 2:
        return []
    times = np.concatenate([spikes[unit] for unit in judged])
    units = np.repeat(judged, lengths[judged])
    order = np.argsort(times, kind="stable")
    times, units = times[order], units[order]
    size = len(spikes)
    codes, step = [], 1
    while step < len(times):
        # Times are sorted: once no two spikes `step` places apart are close, none further apart are.
        near = np.flatnonzero(times[step:] - times[:-step] <= COINCIDENT)
        if not len(near):
            break
        left, right = units[near], units[near + step]
        distinct = left != right
        # One number per pair of units in either order; how often it occurs is how often they coincide.
        codes.append(np.minimum(left, right)[distinct] * size + np.maximum(left, right)[distinct])
        step += 1
    if not codes:
        return []
    pairs, number = np.unique(np.concatenate(codes), return_counts=True)
    left, right = pairs // size, pairs % size
    fewer, more = np.minimum(lengths[left], lengths[right]), np.maximum(lengths[left], lengths[right])
    span = max(float(times[-1] - times[0]), COINCIDENT)
    # An unrelated train of n spikes in T seconds has one within ±δ of a given time with probability 2 δ n/T or so.
    chance = np.minimum(2 * COINCIDENT * more / span, 1.0)
    # Corrected for chance as Cohen's kappa (1960) is: about 0 for unrelated units, 1 where every spike coincides.
    part = (number / fewer - chance) / np.maximum(1 - chance, 1e-9)
    similar = np.flatnonzero(part >= SIMILAR)
    similar = similar[np.argsort(-part[similar], kind="stable")]
    return [(int(left[index]), int(right[index]), float(min(part[index], 1.0))) for index in similar]
