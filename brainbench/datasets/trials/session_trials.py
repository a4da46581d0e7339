"""Trials by animal and session: what counts as one brain, and the trials that the metrics take.

Units differ between sessions, so every session stands for itself.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import PurePath
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from brainbench.core.contracts import Trials, check_recordings, natural_key
from brainbench.core.errors import DataError, check_name, listing
from brainbench.core.files import content_hash, hash_arrays
from brainbench.datasets.ledger import Ledger
from brainbench.datasets.sessions import Session
from brainbench.datasets.trials.counting import COVARIATES, GROUPS, UNIT_COLUMNS, ReadingOptions, SessionCounts
from brainbench.datasets.trials.selection import check_values, divided_labels, label_doubts, natural_vocabulary

if TYPE_CHECKING:
    import xarray as xr

Floats = NDArray[np.float64]
POOLS = ("subject", "session", "all")
ALL = "all"  # name of the one subject that pooling all animals makes
NAMES = ("stimulus", "subject", "session", "unit_subject", "unit_session")
"""Coordinates that decide which counts are compared."""


def fingerprint(dataset: xr.Dataset) -> str:
    """Return a hash of counts and names as they stand in memory, by which a part or an edited copy is told."""
    names = (dataset[name].values.astype(str).tolist() for name in NAMES)
    return content_hash(hash_arrays({name: dataset[name].values for name in ("counts", "duration")}), *names)


def pooled(dataset: xr.Dataset, by: str = "subject") -> xr.Dataset:
    """Return recordings whose subjects are animals, single sessions, or one pool of everything.

    Only names change, no count does, so whatever takes recordings (``trials_by_subject``, ``score``) then gives one
    RDM per pool: ``"subject"`` leaves the animals as they are, ``"session"`` makes every session its own
    subject ``ANIMAL/SESSION``, ``"all"`` puts all sessions of all animals into the subject ``all``.
    """
    check_recordings(dataset)
    check_name("pool", by, POOLS)
    if by == "subject":
        return dataset
    changed = {}
    for prefix in ("", "unit_"):
        subject, session = dataset[f"{prefix}subject"], dataset[f"{prefix}session"]
        pairs = zip(subject.values.astype(str).tolist(), session.values.astype(str).tolist(), strict=True)
        both = np.array([f"{animal}/{name}" for animal, name in pairs], dtype=str)
        if by == "session":
            changed[f"{prefix}subject"] = (subject.dims, both)
        else:
            # Two animals may both have a session "1"; inside the pool they must stay apart.
            changed[f"{prefix}subject"] = (subject.dims, np.full(subject.shape, ALL))
            changed[f"{prefix}session"] = (session.dims, both)
    result = dataset.assign_coords(changed)
    pool = {"pool": by, "content_hash": content_hash(dataset.attrs["content_hash"], by)}
    result.attrs = {**dataset.attrs, **pool, "missing": missing_labels(result)}
    if dataset.attrs.get("fingerprint") == fingerprint(dataset):  # else it was edited, which must still show
        result.attrs["fingerprint"] = fingerprint(result)
    return result


def missing_labels(dataset: xr.Dataset) -> dict[str, list[str]]:
    """Return the labels of the vocabulary without a trial, by subject; subjects that lack none do not appear."""
    subjects, stimuli = (dataset[name].values.astype(str) for name in ("subject", "stimulus"))
    gaps = {}
    for subject in dict.fromkeys(subjects.tolist()):
        have = set(stimuli[subjects == subject].tolist())
        gaps[subject] = [label for label in dataset.attrs["vocabulary"] if label not in have]
    return {subject: labels for subject, labels in gaps.items() if labels}


def trials_by_subject(dataset: xr.Dataset, *, averaged: bool = False) -> dict[str, tuple[Trials, ...]]:
    """Return firing rates [R, T, U] in Hz of every session by subject, both in the order of the data set.

    ``averaged`` rates [R, 1, U] are those of the whole window. Covariates are those of
    :mod:`brainbench.datasets.trials.counting` that the data set holds. Trials and units without any recorded value
    are left out, and so are sessions and subjects without a trial left.
    """
    check_recordings(dataset)
    counts, duration = dataset["counts"].values, dataset["duration"].values
    position = {label: index for index, label in enumerate(dataset.attrs["vocabulary"])}
    labels = np.array([position[label] for label in dataset["stimulus"].values.astype(str).tolist()], dtype=np.int64)
    ids, subjects, sessions, unit_subjects, unit_sessions = (
        dataset[name].values.astype(str) for name in ("trial_id", "subject", "session", "unit_subject", "unit_session")
    )
    covariates = [name for name in COVARIATES if name in dataset.coords]
    groups = {name: dataset[name].values.astype(str) for name in GROUPS if name in dataset.coords}
    start = dataset["window_start"].values if "window_start" in dataset.coords else np.full(len(labels), np.nan)
    by_subject: dict[str, list[Trials]] = {}
    before: dict[str, list[tuple[NDArray[np.int64], Sequence[str]]]] = {}
    for subject, session in dict.fromkeys(zip(subjects.tolist(), sessions.tolist(), strict=True)):
        rows = np.flatnonzero((subjects == subject) & (sessions == session))
        columns = np.flatnonzero((unit_subjects == subject) & (unit_sessions == session))
        # One session of all units is no copy: in narrow bins its counts are many.
        whole = len(rows) == len(counts) and len(columns) == counts.shape[2]
        part_counts = counts if whole else counts[np.ix_(rows, np.arange(counts.shape[1]), columns)]
        recorded = np.isfinite(part_counts)
        # Units may be lost in mid-session: only what is missing everywhere is left out, other gaps stay NaN.
        keep, units = recorded.any(axis=(1, 2)), recorded.any(axis=(0, 1))
        if not keep.any():
            continue
        rows = rows[keep]
        if not (keep.all() and units.all()):
            part_counts = part_counts[np.ix_(keep, np.arange(part_counts.shape[1]), units)]
        # Bins past a window's end have NaN counts and duration 0; NaN seconds avoid the division by zero.
        seconds = np.where(duration[rows] > 0, duration[rows], np.nan)
        rates = part_counts / seconds[:, :, None]
        keys = [f"{subject}/{session}/{ids[row]}" for row in rows]
        twice = len(rows) - len({*zip(keys, start[rows].tolist(), labels[rows].tolist(), strict=True)})
        if twice and np.isfinite(start[rows]).all():
            raise DataError(f"{twice} trials of session {session} of {subject} stand twice; they would count twice.")
        for earlier, names in before.setdefault(subject, []):
            # Probes of one session in files of their own share the noise of their trials, so the same trials must go
            # into the same half: noise in both halves would pass for what is reliable.
            if same := same_trials(start[rows], labels[rows], start[earlier], labels[earlier]):
                keys = [names[same[index]] if index in same else key for index, key in enumerate(keys)]
                break
        unique = _unique(keys)
        before[subject].append((rows, unique))
        by_subject.setdefault(subject, []).append(
            Trials(
                responses=_average(rates, seconds) if averaged else rates,
                labels=labels[rows],
                keys=unique,
                covariates={name: dataset[name].values[rows].astype(np.float64) for name in covariates},
                times=start[rows].astype(np.float64) if np.isfinite(start[rows]).all() else None,
                session=session,
                columns={name: values[columns][units] for name, values in groups.items()},
            )
        )
    return {subject: tuple(items) for subject, items in by_subject.items()}


def same_trials(start: Floats, labels: Any, earlier: Floats, others: Any, *, clocks: bool = True) -> dict[int, int]:
    """Return the trials that are those of an earlier session, by start (s) and label: trial → its; none if few are.

    With ``clocks`` the times of both may differ by any offset, and by a drift of 200 ppm.
    """
    if not (np.isfinite(start).all() and np.isfinite(earlier).all()):
        return {}
    least = min(len(start), len(earlier)) / 2
    same = _coincident(start, labels, earlier, others, 1e-3)
    if len(same) <= least and clocks:
        # Trials of one session have one offset, at which the most pairs of one label agree. Chance agrees less often
        # than in three of four trials, also where all intervals are equal.
        gaps = [np.subtract.outer(start[labels == one], earlier[others == one]).ravel() for one in np.unique(labels)]
        gap, width, least = np.sort(np.concatenate(gaps)), 1e-3 + 2e-4 * float(np.ptp(start)), 1.5 * least
        number = np.searchsorted(gap, gap + width, side="right") - np.arange(len(gap))
        if len(gap) and number.max() > least:
            best = int(number.argmax())
            same = _coincident(start - np.median(gap[best : best + number[best]]), labels, earlier, others, width)
    return same if len(same) > least else {}


def _coincident(start: Floats, labels: Any, earlier: Floats, others: Any, within: float) -> dict[int, int]:
    """Return the trials that begin with one of an earlier session, and have its label: trial → its."""
    order = np.argsort(earlier, kind="stable")
    place = np.searchsorted(earlier[order], start - within)
    near = order[np.minimum(place, len(order) - 1)]
    same = (np.abs(earlier[near] - start) <= within) & (others[near] == labels)
    return {int(index): int(near[index]) for index in np.flatnonzero(same)}


def _average(rates: Floats, seconds: Floats) -> Floats:
    """Return rates [R, T, U] averaged over the seconds [R, T] in which each unit was recorded, [R, 1, U]."""
    # A bin that the end of the window cuts short weighs less: one spike in its few milliseconds is a rate of hundreds.
    weights = seconds / np.fmax.reduce(seconds, axis=1)[:, None]
    weights[weights > 1 - 1e-6] = 1.0
    missing = np.isnan(rates)
    if not missing.any() and (weights == 1).all():
        return rates.mean(axis=1, keepdims=True)
    seen = np.where(missing, 0.0, weights[:, :, None])
    total, weight = (np.where(missing, 0.0, rates) * seen).sum(axis=1), seen.sum(axis=1)
    return np.divide(total, weight, out=np.full(total.shape, np.nan), where=weight > 0)[:, None]


def _unique(keys: list[str]) -> tuple[str, ...]:
    """Return the keys, repeated ones numbered in the canonical (time) order of the trials."""
    seen, result = Counter[str](), []
    for key in keys:
        seen[key] += 1
        result.append(key if seen[key] == 1 else f"{key}#{seen[key]}")
    return tuple(result)


def join_sessions(
    parts: list[SessionCounts],
    options: ReadingOptions,
    *,
    source: str,
    layout: str,
    notes: list[str],
    doubts: Sequence[str] = (),
) -> xr.Dataset:
    """Join the sessions' trials and units, block by block, in canonical order.

    ``source`` is what the user asked for, ``layout`` the name of the layout with how it was chosen, or "".
    """
    import xarray as xr

    # The order must not depend on that of the files: equal data then have equal content hashes.
    parts = sorted(parts, key=lambda part: (natural_key(part.subject), natural_key(part.session)))
    whole = Ledger()
    for part in parts:
        whole.add(part.ledger)
    doubts = [*doubts, *check_values(whole), *_doubtful_names(parts), *whole.doubts]
    measure = listing(sorted({part.measure for part in parts}), quoted=False)
    if measure != "spikes":
        doubts.append(f"responses are means over the window of {measure}, not spike counts")
    # A session without trials would add units that are missing in every row.
    everything, parts = parts, [part for part in parts if part.labels] or parts
    empty = [part for part in everything if not part.labels]
    lost = "no trial is left, so its {} units are left out"
    doubts += [f"session {part.session} of {part.subject}: {lost.format(len(part.unit_ids))}" for part in empty]
    trials, units = sum(len(part.labels) for part in parts), sum(len(part.unit_ids) for part in parts)
    if not trials or not units:
        what = "trial" if not trials else "unit"
        reasons = "; ".join(f"{rule} removed {number}" for rule, number in whole.removed.items() if number)
        raise DataError(f"No {what} remains of {source}: {reasons or 'the tables are empty'}.")
    overlapping, alike = np.sum([_overlaps(part) for part in parts], axis=0).tolist()
    if overlapping:
        doubts.append(
            f"the windows of {overlapping} of {trials} trials begin before that of an earlier one ends ({alike} of one "
            "with the same label): such trials share spikes, so their noise is not independent"
        )
    vocabulary = options.vocabulary or natural_vocabulary(row for part in parts for row in part.values)
    present = {label for part in parts for label in part.labels}
    doubts += label_doubts(whole.forms, vocabulary)
    doubts += divided_labels((part.subject, label) for part in parts for label in {*part.labels})
    if len(present) < 2:
        raise DataError(
            f"All {trials} trials of {source} that remain have the one condition {next(iter(present))!r} "
            f"({options.conditions}); comparing responses needs at least two, choose another column."
        )
    bins = max(part.counts.shape[1] for part in parts)
    # One block per session: its units were not recorded in other sessions' trials, so all else is missing, not zero.
    counts = np.full((trials, bins, units), np.nan, dtype=np.float32)
    duration = np.zeros((trials, bins))
    row = column = 0
    for part in parts:
        count, depth, width = part.counts.shape
        counts[row : row + count, :depth, column : column + width] = part.counts
        duration[row : row + count, :depth] = part.duration
        row, column = row + count, column + width
    edges = np.concatenate([part.edges for part in parts])
    coordinates: dict[str, Any] = {
        # Begin of each bin, s from the begin of the trial's window; one bin per window begins at 0.
        "time": ("time", np.arange(bins) * (options.bin or 0.0)),
        "stimulus": ("trial", [label for part in parts for label in part.labels]),
        "subject": ("trial", [part.subject for part in parts for _ in part.labels]),
        "session": ("trial", [part.session for part in parts for _ in part.labels]),
        "trial_id": ("trial", [name for part in parts for name in part.trial_ids]),
        "window_start": ("trial", edges[:, 0]),
        "window_stop": ("trial", edges[:, 1]),
        "unit_subject": ("unit", [part.subject for part in parts for _ in part.unit_ids]),
        "unit_session": ("unit", [part.session for part in parts for _ in part.unit_ids]),
        "unit_id": ("unit", [name for part in parts for name in part.unit_ids]),
        **{name: ("unit", np.concatenate([part.columns[name] for part in parts])) for name in UNIT_COLUMNS},
        **{
            name: ("trial", np.concatenate([p.covariates.get(name, np.full(len(p.labels), np.nan)) for p in parts]))
            for name in COVARIATES
            if any(name in p.covariates for p in parts)
        },
    }
    variables = {"counts": (("trial", "time", "unit"), counts), "duration": (("trial", "time"), duration)}
    dataset = xr.Dataset(variables, coordinates)
    recipes = {part.stimuli for part in everything}
    # What makes the data; all else (window, selection, file names) only says how they came about.
    names = [(part.subject, part.session, part.labels, part.trial_ids, part.unit_ids) for part in parts]
    content = [item for part, own in zip(parts, names, strict=True) for item in (part.counts, part.duration, own)]
    dataset.attrs = {
        "vocabulary": list(vocabulary),
        "conditions": str(options.conditions),
        "measure": measure,
        "layout": layout,
        "window": str(options.window),
        "bin": options.bin,
        "selection": {"name": options.selection.name, "rules": list(options.selection.lines())},
        "removed": whole.removed,
        "ledger": whole.stated(),
        "sessions": [_about(part) for part in everything],
        "notes": [*notes, *doubts, *whole.notes],
        "doubts": doubts,
        "overlap": alike / trials,
        "source": source,
        "synthetic": any(part.synthetic for part in everything),
        # The recipe that all sessions name; "" where they name none, or different ones.
        "stimuli": recipes.pop() if len(recipes) == 1 else "",
        "content_hash": content_hash(vocabulary, *content),
        # By which a part or an edited copy is known from the data that the hash names.
        "fingerprint": fingerprint(dataset),
    }
    dataset.attrs["missing"] = missing_labels(dataset)
    return dataset


def _doubtful_names(parts: list[SessionCounts]) -> Iterator[str]:
    """Say which animals may be one: every animal is taken for a sample of its own."""
    subjects = sorted({part.subject for part in parts}, key=natural_key)
    guessed = {part.subject for part in parts if part.guessed}
    if guessed and len(subjects) > 1:
        unnamed = listing(name for name in subjects if name in guessed)
        yield f"files that do not name their animal count as an animal each, after their own name: {unnamed}"
    folded: dict[str, list[str]] = {}
    for name in subjects:
        folded.setdefault("".join(name.lower().split()), []).append(name)
    for names in folded.values():
        if len(names) > 1:
            yield f"animals whose names differ only in case or blanks count as different ones: {listing(names)}"
    # Equal intervals are those of a fixed protocol; unequal ones at equal times are those of one session.
    uneven = [part for part in parts if len(part.labels) > 2 and np.ptp(np.diff(part.edges[:, 0])) > 0.01]
    for index, part in enumerate(uneven):
        for earlier in uneven[:index]:
            same = earlier.subject != part.subject and same_trials(
                part.edges[:, 0], np.array(part.labels), earlier.edges[:, 0], np.array(earlier.labels), clocks=False
            )
            if same:
                yield (
                    f"session {earlier.session} of {earlier.subject} and {part.session} of {part.subject} have the "
                    f"same labels at the same times in {len(same)} trials, as two probes or two copies of one session "
                    "have, and count as two animals"
                )


def _overlaps(part: SessionCounts) -> tuple[int, int]:
    """Count the trials whose window begins before that of an earlier trial ends, and before one of their label does."""

    def count(edges: NDArray[np.float64]) -> int:
        """Count the windows of edges [R, 2] (s) that begin before an earlier one ends."""
        begin, end = edges[np.argsort(edges[:, 0])].T
        return int((begin[1:] < np.maximum.accumulate(end)[:-1] - 1e-9).sum())

    labels = np.array(part.labels)
    return count(part.edges), sum(count(part.edges[labels == label]) for label in set(part.labels))


def _about(part: SessionCounts) -> dict[str, Any]:
    return {
        "subject": part.subject,
        "session": part.session,
        "source": part.source,
        "trials": len(part.labels),
        "trials_in_file": part.ledger.totals["trials"],
        "units": len(part.unit_ids),
        "units_in_file": part.ledger.totals["units"],
        "removed": part.ledger.removed,
        "synthetic": part.synthetic,
    }


_RUN, _MILLISECOND = 8, 1e-3
"""Intervals in a row, no two alike, by which spikes are known: so many that agree to a millisecond are no chance."""
_SKETCH = 64  # runs that are kept of a unit: those of the lowest codes, which copies of it have too


def _runs(times: Floats) -> tuple[list[int], bool]:
    """Return codes of runs of intervals of a unit, wherever they stand, and whether few are all it has."""
    steps = np.rint(np.diff(times) / _MILLISECOND).astype(np.uint64)
    number = max(len(steps) - _RUN + 1, 0)
    codes = np.zeros(number, np.uint64)
    for place in range(_RUN):
        # Each step mixes all bits, so that the lowest codes are a fair sample of all.
        codes = (codes ^ (codes >> np.uint64(31))) * np.uint64(0x9E3779B97F4A7C15) + steps[place : place + number]
    codes = (codes ^ (codes >> np.uint64(31))) * np.uint64(0x9E3779B97F4A7C15)
    # Equal intervals are those of a program, which spaces the spikes of a trial evenly: they recognise nobody alone.
    uneven = codes
    if number:
        uneven = codes[np.all(np.diff(np.sort(sliding_window_view(steps, _RUN)), axis=1) > 0, axis=1)]
    different = np.unique(uneven)
    regular = 2 * len(different) <= len(uneven)
    return (np.unique(codes) if regular else different)[:_SKETCH].tolist(), regular


@dataclass
class Copies:
    """Looks for spikes that were read before, on whatever clock, in whatever part and under whatever name."""

    seen: dict[int, list[tuple[str, int]]] = field(default_factory=dict)
    """Run of intervals → source and number of the units that have it."""
    lengths: dict[tuple[str, int], int] = field(default_factory=dict)
    """Unit that can be recognised → its runs."""
    sessions: dict[str, Session] = field(default_factory=dict)

    def compare(self, session: Session, spikes: Sequence[Floats]) -> str:
        """Take the units [U] of a session, and return a doubt where some were read before.

        Raises DataError where most of the units of one are among those of the other.
        """
        source, repeated, judged = session.source, Counter[str](), Counter(name for name, _ in self.lengths)
        for number, (runs, regular) in enumerate(map(_runs, spikes)):
            if not runs:
                continue
            shared = Counter(unit for run in runs for unit in self.seen.get(run, ()) if unit[0] != source)
            alike = {unit[0] for unit, same in shared.items() if 8 * same >= min(len(runs), self.lengths[unit])}
            # A regular train, as of a program, is like any other one unless the names agree too.
            repeated.update(name for name in alike if not regular or _may_be_one(self.sessions[name], session))
            self.lengths[source, number] = len(runs)
            for run in runs:
                self.seen.setdefault(run, []).append((source, number))
        self.sessions[source] = session
        if not repeated:
            return ""
        units = sum(name == source for name, _ in self.lengths)
        name = max(sorted(repeated), key=lambda key: repeated[key] / min(units, judged[key]))
        least = min(units, judged[name])
        what = f"{name} and {source} hold the same spikes ({repeated[name]} of {least} units)"
        if 2 * repeated[name] > least:
            raise DataError(f"{what}; they would count twice, so leave one of the files out.")
        return f"{what}, which count twice"


def _may_be_one(earlier: Session, session: Session) -> bool:
    names = (earlier.subject, earlier.session) == (session.subject, session.session)
    return names or (earlier.subject == session.subject and earlier.identifier == session.identifier != "")


def joined_probes(parts: Sequence[SessionCounts], doubts: list[str]) -> list[SessionCounts]:
    """Join the parts of equal names that have the same trials, as files of several probes do.

    Parts of one name with other trials are sessions of their own, which get their files' names and a doubt.
    """
    by_name: dict[tuple[str, str], list[SessionCounts]] = {}
    for part in parts:
        by_name.setdefault((part.subject, part.session), []).append(part)
    sessions = []
    for (subject, session), group in by_name.items():
        # The content alone decides, not the order of files.
        group.sort(
            key=lambda part: (part.edges[:1].tolist(), [natural_key(name) for name in part.unit_ids], part.source)
        )
        joined: list[SessionCounts] = []
        for part in group:
            for index, earlier in enumerate(joined):
                if (same := _same_trials(part, earlier)) is not None:
                    joined[index] = _joined(earlier, part, same)
                    break
            else:
                joined.append(part)
        if len(joined) > 1:
            names = [PurePath(part.source.partition(", ")[0]).stem for part in joined]
            joined = [replace(part, session=f"{session} ({name})") for part, name in zip(joined, names, strict=True)]
            doubts.append(
                f"{len(joined)} sessions of {subject} are called {session!r} and have different trials, so they count "
                f"as different ones: {listing(names, limit=4)}"
            )
        sessions += joined
    return sessions


def _same_trials(part: SessionCounts, earlier: SessionCounts) -> dict[int, int] | None:
    """Return the trials of a part that are those of an earlier one; None where fewer than half are."""
    if not part.labels or not earlier.labels:
        return {}
    sides = [(item.edges[:, 0], np.array(item.labels)) for item in (part, earlier)]
    return same_trials(*sides[0], *sides[1], clocks=False) or None


def _joined(first: SessionCounts, second: SessionCounts, same: dict[int, int]) -> SessionCounts:
    """Join two parts whose units were recorded at once: units side by side, missing in trials of the other alone."""
    more = [row for row in range(len(second.labels)) if row not in same]
    place = {row: len(first.labels) + index for index, row in enumerate(more)} | same
    trials, bins = len(first.labels) + len(more), max(first.counts.shape[1], second.counts.shape[1])
    widths = len(first.unit_ids), len(second.unit_ids)
    counts = np.full((trials, bins, sum(widths)), np.nan, dtype=np.float32)
    counts[: len(first.labels), : first.counts.shape[1], : widths[0]] = first.counts
    rows = [place[row] for row in range(len(second.labels))]
    duration = np.zeros((trials, bins))
    duration[: len(first.labels), : first.counts.shape[1]] = first.duration
    for row, target in enumerate(rows):
        counts[target, : second.counts.shape[1], widths[0] :] = second.counts[row]
        duration[target, : second.duration.shape[1]] = second.duration[row]
    edges = np.concatenate([first.edges, second.edges[more]])

    # Each file may list trials that the other lacks; rows without a start are one row in both.
    starts = [np.where(np.isnan(part.starts), -1e9, part.starts) for part in (first, second)]
    shared = _coincident(starts[1], second.table_labels, starts[0], first.table_labels, 1e-3)
    only = [row for row in range(len(second.starts)) if row not in shared]
    row_of = shared | {row: len(first.starts) + index for index, row in enumerate(only)}
    rows_in_table = np.array([*first.rows, *(row_of[int(second.rows[row])] for row in more)], dtype=np.int64)

    def both(name: str) -> tuple[Any, ...]:
        """Return a field's values of the first session, then those that only the second has."""
        return (*getattr(first, name), *(getattr(second, name)[row] for row in more))

    ids = both("trial_ids")
    order = np.array(sorted(range(trials), key=lambda row: (edges[row, 0], natural_key(ids[row]))), dtype=np.int64)
    names = [name for name in COVARIATES if name in first.covariates or name in second.covariates]
    covariates = {name: np.full(trials, np.nan) for name in names}
    for name, values in covariates.items():
        if name in second.covariates:
            values[rows] = second.covariates[name]
        if name in first.covariates:
            values[: len(first.labels)] = first.covariates[name]
    return replace(
        first,
        source=f"{first.source}, {second.source}",
        values=tuple(both("values")[row] for row in order),
        labels=tuple(both("labels")[row] for row in order),
        trial_ids=tuple(ids[row] for row in order),
        unit_ids=(*first.unit_ids, *second.unit_ids),
        edges=edges[order],
        counts=counts[order],
        duration=duration[order],
        columns={name: np.concatenate([first.columns[name], second.columns[name]]) for name in first.columns},
        covariates={name: values[order] for name, values in covariates.items()},
        rows=rows_in_table[order],
        starts=np.append(first.starts, second.starts[only]),
        table_labels=np.append(first.table_labels, second.table_labels[only]),
        ledger=_joined_ledger(first.ledger, second.ledger, rows_in_table, row_of),
    )


def _joined_ledger(first: Ledger, second: Ledger, read: NDArray[np.int64], row_of: Mapping[int, int]) -> Ledger:
    """Return the balance of both: all of either, but of the trials each row of a table that holds both ones' rows.

    ``read`` are the rows of the trials there, ``row_of`` those of the second one's rows.
    """
    ledger, begin = Ledger().add(first).add(second), first.totals["trials"]
    ledger.totals["trials"], ledger.read["trials"] = len({*range(begin), *row_of.values()}), len(read)
    ledger.left = [entry for entry in ledger.left if entry.kind != "trials"]
    left_out = {*range(ledger.totals["trials"])} - {*read.tolist()}
    # A trial that neither took is left out for the first one's reason.
    for part, rows in ((first, range(begin)), (second, [row_of[row] for row in range(second.totals["trials"])])):
        for entry in part.left:
            if entry.kind == "trials":
                places = [*{rows[row] for row in entry.rows} & left_out]
                ledger.left.append(replace(entry, number=len(places), rows=places))
        left_out -= {*rows}
    return ledger
