"""Spike counts of one session: rules, windows, recorded spans, bins."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.contracts import as_labels, as_number, natural_key
from brainbench.core.errors import DataError, UsageError, check_number, listing
from brainbench.datasets.ledger import Ledger
from brainbench.datasets.sessions import OBSERVED, SPIKES, Session, SessionTable
from brainbench.datasets.trials.selection import CONTACTS, Conditions, Selection, Window, joined_labels, select_rows
from brainbench.datasets.trials.signals import VOLTAGES, Samples, response_series

COVARIATES = ("contacts", "licks", "choice")
LICKS = "licks"  # name of the event series, and of the table that a copy keeps it in
_NO_CHOICE = ("", "nogo", "none", "miss", "nan")


def trial_covariates(
    session: Session, table: SessionTable, rows: NDArray[np.int64], edges: NDArray[np.float64]
) -> dict[str, NDArray[np.float64]]:
    """Return what the session tells of the trials ``rows`` [R] with windows ``edges`` [R, 2] (s): name → [R]."""
    covariates = {}
    contacts = [item for name, item in session.tables.items() if CONTACTS.match(name)]
    if contacts:
        begin = np.concatenate([item.times("start_time") for item in contacts])
        end = np.concatenate([item.times("stop_time") for item in contacts])
        # Rows of zero duration are empty intervals.
        covariates["contacts"] = _inside(begin[end > begin], edges)
    if (licks := lick_times(session)) is not None:
        covariates["licks"] = _inside(licks, edges)
    if "choice" in table:
        chosen = as_labels(table.column("choice"))
        sides = sorted({side for side in chosen.tolist() if side.lower() not in _NO_CHOICE})
        if len(sides) == 2:
            # Coded in the order of the names, so that 0 and 1 mean the same sides in every session.
            values = np.select([chosen == side for side in sides], [0.0, 1.0], default=np.nan)
            covariates["choice"] = values[rows]
    return covariates


def lick_times(session: Session) -> NDArray[np.float64] | None:
    """Return the times (s, ascending) of the session's licks, or None if it has none."""
    if LICKS in session.tables:
        return np.sort(session.tables[LICKS].times("start_time"))
    for name, series in session.series.items():
        if name.rpartition("/")[2] == LICKS and series.timestamps is not None:
            return np.sort(np.asarray(series.timestamps[...], dtype=np.float64))
    return None


def _inside(times: NDArray[np.float64], edges: NDArray[np.float64]) -> NDArray[np.float64]:
    """Count the times inside each window, [begin, end)."""
    times = np.sort(times[np.isfinite(times)])
    return np.diff(np.searchsorted(times, edges, side="left"), axis=1)[:, 0].astype(np.float64)


GROUPS = ("area", "layer", "cell_type")  # unit columns whose values are groups of units
UNIT_COLUMNS = {"depth": float, "inhibitory": float, **dict.fromkeys(GROUPS, str)}
"""Unit columns carried along where present, with the type that can say "missing"."""
OTHER_NAMES = {
    "area": ("brain_area", "brain_region", "region", "location"),
    "layer": ("cortical_layer",),
    "cell_type": ("celltype", "cell_class"),
}
"""Names that files give to a unit column, in the order in which they are looked for."""

_TRUTH = {"true": 1.0, "false": 0.0}
_MOST_COUNTS = 1 << 32  # counts of one session that are made at most: 16 GiB
_INSIDE = np.array([1e-6, -1e-6])  # s from a window's ends to where it may touch what lies beside it: sums are rounded


@dataclass(frozen=True)
class ReadingOptions:
    """Everything that decides how sessions are read; equal for all sessions of a data set."""

    conditions: Conditions
    vocabulary: tuple[str, ...] | None
    """Labels in their fixed order; None for those that are found, sorted naturally."""
    selection: Selection
    window: Window
    bin: float | None = None
    """Bin width, s; None for one bin per window."""


@dataclass(frozen=True)
class SessionCounts:
    """The kept trials [R] and units [U] of one session, in canonical order."""

    subject: str
    session: str
    source: str
    values: tuple[tuple[str, ...], ...]
    """[R] condition values."""
    labels: tuple[str, ...]
    """[R] condition values joined."""
    trial_ids: tuple[str, ...]
    unit_ids: tuple[str, ...]
    edges: NDArray[np.float64]
    """[R, 2] window of each trial, s."""
    counts: NDArray[np.float32]
    """[R, T, U] spikes; NaN = not recorded."""
    duration: NDArray[np.float64]
    """[R, T] length of each bin, s."""
    columns: dict[str, NDArray[Any]]
    """Unit columns [U]."""
    covariates: dict[str, NDArray[np.float64]]
    """Covariate → its value in each trial [R]."""
    synthetic: bool
    stimuli: str = ""
    """Recipe of the stimuli, where the file names one."""
    guessed: bool = False
    """True when the file does not name its subject."""
    ledger: Ledger = field(default_factory=Ledger)
    """Balance of the file: tables, trials, units, spikes."""
    measure: str = "spikes"
    """What the responses are: spikes, or name and NWB type of a signal."""
    rows: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    """[R] row of each trial in its table."""
    starts: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    """Start of every row of the table, before any rule, s."""
    table_labels: NDArray[np.str_] = field(default_factory=lambda: np.zeros(0, "U1"))
    """Label of every row of the table; "" for none."""


def count_session(
    session: Session,
    options: ReadingOptions,
    look: Callable[[Session, Sequence[NDArray[np.float64]]], str] | None = None,
) -> SessionCounts:
    """Count the trials of one session; ``look`` sees it with the spikes of all units, and may return a doubt."""
    series = response_series(session, options.window)
    if series is None and not session.has_spikes:
        raise DataError(no_units(session))
    ledger = Ledger(notes=[*session.notes])
    table = session.table(options.conditions.table)
    if "start_time" not in table:
        raise DataError(f"{table.label} has no start_time; conditions need a table of time intervals.")
    values, ledger.forms = options.conditions.values(table), options.conditions.forms(table)
    labels = np.array(joined_labels(values), dtype=str)
    keep, parts = _windows(session, table, labels, options, ledger)
    edges, *before = parts
    source = (
        SpikeTrains.of(session, table, ledger, look)
        if series is None
        else Samples.of(session, series, table, options.window, options.bin)
    )
    chosen = select_rows(source.units, options.selection.units, "units", ledger)
    chosen = source.rule_out(chosen, options.selection, ledger)
    # A window outside the recorded span is missing data, not silence: zero counts there would lower every mean.
    covered = np.all([source.covered(part, ledger) for part in parts], axis=0)
    # A trial that only removed units saw is of no use, but with no unit left it is not the trial's fault.
    covered = covered & chosen if chosen.any() else covered
    keep = ledger.apply(keep, covered.any(axis=1), "trials", "outside the recorded span")
    # Trials by start and id, units by id: the order of rows in the file changes nothing.
    start, ids, unit_ids = table.times("start_time"), as_labels(table.ids()), as_labels(source.units.ids())
    rows = _sorted(keep, lambda row: (start[row], natural_key(ids[row])))
    # Equal ids (several probes) are told apart by number of spikes and first spike.
    spikes = source.spikes if isinstance(source, SpikeTrains) else [np.zeros(0)] * len(unit_ids)
    units = _sorted(chosen, lambda unit: (natural_key(unit_ids[unit]), len(spikes[unit]), spikes[unit][:1].tolist()))
    bounds = bin_bounds(edges[rows], options.bin, options.window.length, units=len(units))
    counts = source.respond(rows, units, bounds)
    counts, duration = mask_missing(counts, bounds, covered[np.ix_(rows, units)])
    seen = np.isfinite(counts).any(axis=(0, 1)) | ~keep.any()
    ledger.leave("units", "recorded in no kept trial", int((~seen).sum()))
    if not seen.all():
        units, counts = units[seen], counts[:, :, seen]
    source.enter(units, bounds, counts, ledger)
    measure = source.measure
    for part in before:
        rates = source.respond(rows, units, part[rows]) / np.diff(part[rows], axis=1)[:, :, None]
        counts = (counts - rates * duration[:, :, None]).astype(np.float32)
        measure += f" minus their mean in {options.window.baseline}"
    for kind, number, total in (("trials", len(rows), len(table)), ("units", len(units), len(source.units))):
        ledger.find(kind, total, number)
    _enter_tables(ledger, session, options.conditions.table)
    stated = ("subject", "session", "source", "synthetic", "stimuli", "guessed")
    columns = UNIT_COLUMNS.items()
    return SessionCounts(
        **{name: getattr(session, name) for name in stated},
        values=tuple(tuple(values[row].tolist()) for row in rows),
        labels=tuple(labels[rows].tolist()),
        trial_ids=tuple(ids[rows].tolist()),
        unit_ids=tuple(unit_ids[units].tolist()),
        edges=edges[rows],
        counts=counts,
        duration=duration,
        columns={name: _unit_column(source.units, name, kind, units, ledger.notes) for name, kind in columns},
        covariates=trial_covariates(session, table, rows, edges[rows]),
        measure=measure,
        rows=rows,
        starts=start,
        table_labels=labels,
        ledger=ledger,
    )


def _windows(
    session: Session, table: SessionTable, labels: NDArray[np.str_], options: ReadingOptions, ledger: Ledger
) -> tuple[NDArray[np.bool_], list[NDArray[np.float64]]]:
    """Return which trials are left by rules, labels and events, and their windows and baselines [rows, 2] (s)."""
    # Each rule counts only rows that no earlier rule removed, so removed and kept rows add up to the table.
    keep = select_rows(table, options.selection.trials, "trials", ledger)
    keep = ledger.apply(keep, labels != "", "trials", f"no value of {','.join(options.conditions.columns)}")
    if options.vocabulary is not None:
        keep = ledger.apply(keep, np.isin(labels, options.vocabulary), "trials", "label outside the vocabulary")
    parts = []
    for what, window in {"window": options.window, "baseline": options.window.baseline}.items():
        if window is not None:
            edges = window.edges(session, table, ledger.notes)
            keep = ledger.apply(keep, np.isfinite(edges).all(axis=1), "trials", f"no event for the {what} {window}")
            name = f"{what} {window}" if parts else what
            keep = ledger.apply(keep, ~(edges[:, 1] <= edges[:, 0]), "trials", f"{name} of no length")
            parts.append(edges)
    invalid = session.tables.get("invalid_times")
    if invalid is not None:
        begin, end = invalid.times("start_time"), invalid.times("stop_time")
        if wrong := int((~(end >= begin)).sum()):
            raise DataError(f"{wrong} of {len(end)} rows of {invalid.label} end before they begin, or at no time.")
        inner = np.add(parts, _INSIDE)
        overlap = ((inner[..., :1] < end) & (inner[..., 1:] > begin)).any(axis=(0, 2))
        keep = ledger.apply(keep, ~overlap, "trials", "overlap with invalid_times")
    return keep, parts


@dataclass(frozen=True)
class SpikeTrains:
    """Units with spike times, whose responses are counts; for signals see :class:`Samples`."""

    units: SessionTable
    spikes: list[NDArray[np.float64]]
    """[U] ascending times, s."""
    measure: str = "spikes"

    @classmethod
    def of(
        cls,
        session: Session,
        table: SessionTable,
        ledger: Ledger,
        look: Callable[[Session, Sequence[NDArray[np.float64]]], str] | None,
    ) -> SpikeTrains:
        """Read the spikes of a session, which must be on the clock of its trials."""
        assert session.units is not None
        spikes = read_spikes(session.units, ledger.doubts)
        if fault := time_fault(spikes, table):
            raise DataError(f"{session.source}: {fault}.")
        if look is not None and (doubt := look(session, spikes)):
            ledger.doubts.append(doubt)
        return cls(session.units, spikes)

    def rule_out(self, keep: NDArray[np.bool_], selection: Selection, ledger: Ledger) -> NDArray[np.bool_]:
        """Return which units [U] remain without those of too few spikes."""
        if selection.min_spikes:
            few = "no spikes" if selection.min_spikes == 1 else f"fewer than {selection.min_spikes} spikes"
            numbers = np.array([len(times) for times in self.spikes], dtype=np.int64)
            keep = ledger.apply(keep, numbers >= selection.min_spikes, "units", few)
        return keep

    def covered(self, edges: NDArray[np.float64], ledger: Ledger) -> NDArray[np.bool_]:
        """Return which windows [R, 2] (s) lie in observed spans, else between first and last spike: [R, U]."""
        if (observed := inside_observed_spans(self.units, edges := edges + _INSIDE)) is not None:
            return observed
        covered = np.zeros((len(edges), len(self.spikes)), dtype=bool)
        if (span := recorded_span(self.spikes)) is not None:
            low, high = span
            # One span for all units: a unit that fires rarely would get too short a span from its own spikes.
            covered[:] = ((edges[:, 0] >= low) & (edges[:, 1] <= high))[:, None]
            note = f"{self.units.label}: no obs_intervals; recorded span taken from first to last spike"
            ledger.note(f"{note}, {low:.3f}–{high:.3f} s")
        return covered

    def respond(
        self, rows: NDArray[np.int64], units: NDArray[np.int64], bounds: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        """Count the spikes of units in bins [begin, end) between bounds [R, T + 1] (s): [R, T, units]."""
        counts = np.empty((len(units), len(bounds), bounds.shape[1] - 1), dtype=np.float32)
        for index, unit in enumerate(units):
            # Differences of the numbers of spikes before each bound; "left" puts a spike on a bound into the later bin.
            counts[index] = np.diff(np.searchsorted(self.spikes[unit], bounds, side="left"), axis=1)
        return np.ascontiguousarray(counts.transpose(1, 2, 0))

    def enter(
        self, units: NDArray[np.int64], bounds: NDArray[np.float64], counts: NDArray[np.float32], to: Ledger
    ) -> None:
        """Enter all spikes, those of the units that are used in their windows, and those between these."""
        edges = bounds[:, [0, -1]]
        used, total = [self.spikes[unit] for unit in units], sum(map(len, self.spikes))
        to.find("spikes", total)
        to.leave("spikes", "of units that are left out", total - sum(map(len, used)))
        inside, outside = 0, 0
        covered = np.asarray(np.isfinite(counts).any(axis=1))
        bounds_of: dict[bytes, NDArray[np.float64]] = {}
        for unit, times in enumerate(used):
            key = covered[:, unit].tobytes()
            if key not in bounds_of:
                bounds_of[key] = np.array(merged(edges[covered[:, unit]])).reshape(-1)
            place = np.searchsorted(bounds_of[key], times, side="right")
            inside += int((place % 2 == 1).sum())
            outside += int((place % 2 == 0).sum())
        to.leave("spikes", "between the windows", outside)
        begin, end = edges[np.argsort(edges[:, 0])].T
        # A spike in two windows is counted in both; else the counts themselves must add up.
        apart = bool((begin[1:] >= end[:-1]).all())
        to.find("spikes", 0, int(np.nansum(counts, dtype=np.float64)) if apart else inside)


def _enter_tables(ledger: Ledger, session: Session, conditions: str) -> None:
    used = {name for name in session.tables if name in (conditions, "invalid_times", LICKS) or CONTACTS.match(name)}
    ledger.find("tables", len(session.tables) + len(session.unread), len(used))
    for reason in session.unread:
        ledger.leave("tables", reason, lost=True)
    for name, table in session.tables.items():
        if name not in used:
            ledger.leave("tables", table.fault or "not asked for", lost=bool(table.fault))


def no_units(session: Session) -> str:
    """Return one sentence: why a session without units cannot be used, and what it holds instead."""
    series = ", ".join(f"{number} {kind}" for kind, number in session.intracellular.items())
    total = sum(session.intracellular.values())
    voltages = [place for place, item in session.populations.items() if getattr(item, "kind", "") == VOLTAGES]
    if voltages:
        return (
            f"{session.source} has no spike times; its voltages ({listing(voltages, limit=3)}) are read as power in a "
            f"band (Hz) that the window names, such as 'start..stop of {voltages[0]}@70..150'."
        )
    if total:
        return (
            f"{session.source} has no units table: it holds {total} intracellular series ({series}), which are "
            f"voltages or currents of single cells, while brainbench needs spike times of units per trial."
        )
    tables = [place for place, item in session.populations.items() if isinstance(item, SessionTable)]
    if len(tables) > 1:
        return (
            f"{session.source} has {len(tables)} tables of units ({listing(tables)}) and none at /units, where the one "
            "to read stands; copy one of them there."
        )
    holds = f"interval tables {', '.join(session.tables)}" if session.tables else "no interval tables either"
    return f"{session.source} has no units table with spike_times (it holds {holds}); there is nothing to score."


def read_spikes(units: SessionTable, doubts: list[str]) -> list[NDArray[np.float64]]:
    """Read the spike times (s, ascending) of every unit.

    Raises DataError where the times of most units start anew: their files were joined, or each trial has its own zero.
    """
    spikes = units.rows(SPIKES)
    unsorted = [index for index, times in enumerate(spikes) if np.any(np.diff(times) < 0)]
    if unsorted:
        # Times in any order step back at every second spike; times that start anew do so seldom, and far.
        again = [index for index in unsorted if _starts_anew(spikes[index])]
        if 2 * len(again) > sum(len(times) > 1 for times in spikes):
            raise DataError(
                f"{units.label}: the spike times of {len(again)} units start anew within the session, as where files "
                "were joined or times count from each trial; write them on one clock first."
            )
        doubts.append(f"{units.label}: spike times of {len(unsorted)} units were not in order and have been sorted")
        for index in unsorted:
            spikes[index] = np.sort(spikes[index])
    number, equal = sum(map(len, spikes)), sum(int((np.diff(times) == 0).sum()) for times in spikes)
    if equal > 0.1 * number:
        doubts.append(f"{units.label}: {equal:,} of {number:,} spikes stand twice in their unit, and count twice")
    trains = Counter(times.tobytes() for times in spikes if len(times) >= 8)
    if copies := sum(trains.values()) - len(trains):
        doubts.append(f"{units.label}: {copies} of {len(spikes)} units have all spikes of another one, and count twice")
    return spikes


def _starts_anew(times: NDArray[np.float64]) -> bool:
    """Return whether ascending runs of times (s), of four or more on average, begin near the start again."""
    back = np.flatnonzero(np.diff(times) < 0)
    steps, whole = times[back] - times[back + 1], np.ptp(times)
    near = np.median(times[back + 1] - times.min()) < 0.5 * whole and np.median(steps) > 0.25 * whole
    return bool(len(times) >= 4 * (len(back) + 1) and near)


_UNITS_OF_TIME = {
    "milliseconds: divide them by 1000": 1e3,
    "samples: divide them by the sampling rate": 2.5e4,
    "microseconds: divide them by 1,000,000": 1e6,
}
"""What times that are no seconds may be → about how many of it are in a second."""


def time_fault(spikes: list[NDArray[np.float64]], table: SessionTable) -> str:
    """Return why spikes and trials seem not to be both in seconds of one clock; empty where nothing speaks for it."""
    span = recorded_span(spikes)
    if span is None or "start_time" not in table or len(table) < 5:
        return ""
    start = table.times("start_time")
    stop = table.times("stop_time") if "stop_time" in table else start
    end = float(np.nanmax([*start, *stop], initial=-np.inf))
    starts = np.sort(start[np.isfinite(start)])
    if len(starts) < 5 or not (end > starts[0] and span[1] > span[0] and span[1] > 0 and end > 0):
        return ""
    number, last = sum(map(len, spikes)), span[1]
    rate, interval = number / len(spikes) / (last - span[0]), float(np.median(np.diff(starts)))
    where = f"spikes run to {last:g} and trials to {end:g}"
    for unit, factor in _UNITS_OF_TIME.items():
        # Neurons fire more than once in ten seconds, and a recording lasts no longer than some times its trials.
        least = 0.35 if factor == 2.5e4 else 0.9
        if rate < 0.1 and least <= last / end / factor <= 5:
            return f"{where} s, so the spike times look like {unit}"
        if 0.2 <= end / last / factor <= 1.2 / (least if least < 0.5 else 1.0):
            return f"spikes run to {last:g} s and trials to {end:g}, so the times of the trials look like {unit}"
    longest = 1.5 * interval
    if number > 20 and span[0] >= -longest and last <= longest and end > 5 * last:
        return f"{where} s, so the spike times seem to count from the start of each trial: add its start_time"
    if end < span[0] or starts[0] > last:
        return (
            f"spikes run from {span[0]:g} to {last:g} s and trials from {starts[0]:g} to {end:g} s, so they are not on "
            "one clock, or not in seconds"
        )
    if rate < 0.1 and interval > 300:
        return (
            f"trials begin every {interval:g} s and units fire {rate:.2g} times a second, so all times look like "
            "milliseconds or samples: write seconds"
        )
    return ""


def recorded_span(spikes: list[NDArray[np.float64]]) -> tuple[float, float] | None:
    """Return the first and last spike (s) of all units, or None without any."""
    firing = [times for times in spikes if len(times)]
    return (float(min(times[0] for times in firing)), float(max(times[-1] for times in firing))) if firing else None


def bin_bounds(
    edges: NDArray[np.float64], bin: float | None, length: float | None = None, *, units: int = 1
) -> NDArray[np.float64]:
    """Return the bounds [R, T + 1] (s) of bins from the begin of each window [R, 2] (s); without ``bin`` (s), one bin.

    The last bin of a window may be shorter than ``bin``; those past its end have no length. ``length`` (s) is common to
    all windows, if they have one.
    """
    if bin is None:
        return edges
    check_number("bin (s)", bin, above=0)
    longest = max([length or 0.0, *(edges[:, 1] - edges[:, 0]).tolist()])
    # Rounding must not add an empty bin when the length is a whole number of bins.
    number = max(1, math.ceil(longest / bin - 1e-6))
    if number * len(edges) * max(1, units) > _MOST_COUNTS:
        raise UsageError(
            f"A bin of {bin:g} s cuts windows of up to {longest:g} s into {number:,} bins; with {len(edges):,} "
            f"trials and {units:,} units that is more than {_MOST_COUNTS:,} counts. Take wider bins."
        )
    # Bounds past the end of a shorter window are moved onto it.
    bounds = np.minimum(edges[:, :1] + bin * np.arange(number + 1), edges[:, 1:])
    # The tolerance above may leave the last bound just short of the end, which would lose a spike in between.
    bounds[:, -1] = edges[:, 1]
    return bounds


def mask_missing(
    counts: NDArray[np.float32], bounds: NDArray[np.float64], covered: NDArray[np.bool_]
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Return counts [R, T, U], NaN in bins of no length and where not ``covered`` [R, U], and duration [R, T] (s)."""
    duration = np.diff(bounds, axis=1)
    # NaN says "not recorded"; zero would say that the unit was silent for a time that nobody observed.
    counts[duration <= 1e-9] = np.nan
    counts[np.broadcast_to(~covered[:, None, :], counts.shape)] = np.nan
    return counts, np.where(duration > 1e-9, duration, 0.0)


def inside_observed_spans(units: SessionTable, edges: NDArray[np.float64]) -> NDArray[np.bool_] | None:
    """Return which windows [R, 2] (s) lie in the spans in which each unit was observed [R, U]; None without spans."""
    if OBSERVED not in units and f"{OBSERVED}_index" not in units:
        return None
    inside = np.zeros((len(edges), len(units)), dtype=bool)
    # Units of one probe share their spans, so each distinct list is looked at once.
    inside_of: dict[bytes, NDArray[np.bool_]] = {}
    for unit, unit_spans in enumerate(units.spans()):
        key = unit_spans.tobytes()
        if key not in inside_of:
            fits = [(edges[:, 0] >= low) & (edges[:, 1] <= high) for low, high in merged(unit_spans)]
            inside_of[key] = np.any(fits, axis=0) if fits else inside[:, unit]
        inside[:, unit] = inside_of[key]
    return inside


def merged(spans: NDArray[np.float64]) -> list[tuple[float, float]]:
    """Join the spans [n, 2] (s) that touch or overlap."""
    merged: list[tuple[float, float]] = []
    # What ends before it begins, or at no known time, holds nothing; NaN would also undo the order.
    for low, high in sorted(map(tuple, spans[spans[:, 0] <= spans[:, 1]].tolist())):
        # Spans that touch are one recording: a window across their common end lies inside it.
        if merged and low <= merged[-1][1] + _INSIDE[0]:
            merged[-1] = (merged[-1][0], max(high, merged[-1][1]))
        else:
            merged.append((low, high))
    return merged


def _sorted(keep: NDArray[np.bool_], key: Callable[[int], Any]) -> NDArray[np.int64]:
    """Return the numbers of the rows that are kept, in order."""
    return np.array(sorted(np.flatnonzero(keep).tolist(), key=key), dtype=np.int64)


def missing_column(kind: type, units: int) -> NDArray[Any]:
    """Return a unit column [units] that says "missing" everywhere."""
    return np.full(units, np.nan) if kind is float else np.full(units, "", dtype="U1")


def _unit_column(units: SessionTable, name: str, kind: type, rows: NDArray[np.int64], notes: list[str]) -> NDArray[Any]:
    """Return a unit column of the kept units, of one type in all sessions: a text that is no number is NaN."""
    name = next((column for column in (name, *OTHER_NAMES.get(name, ())) if column in units), name)
    if name not in units:
        return missing_column(kind, len(rows))
    values = units.column(name)[rows]
    if kind is not float:
        return as_labels(values)
    if values.dtype.kind != "U":
        return values.astype(np.float64)
    texts = np.char.lower(as_labels(values)).tolist()
    numbers = np.array([_TRUTH.get(text, as_number(text)) for text in texts], dtype=np.float64)
    if lost := sorted({text for text, number in zip(texts, numbers, strict=True) if text and np.isnan(number)}):
        notes.append(f"{units.label}: column {name!r} holds numbers; missing where it says {listing(lost, limit=4)}")
    return numbers
