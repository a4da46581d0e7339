"""Join of the sessions that were counted: one recordings data set in canonical order."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import DataError, listing
from brainbench.core.files import content_hash
from brainbench.datasets.sessions import natural_key
from brainbench.datasets.trials.conditions import natural_vocabulary
from brainbench.datasets.trials.counting import UNIT_COLUMNS, ReadingOptions, SessionCounts
from brainbench.datasets.trials.covariates import COVARIATES
from brainbench.datasets.trials.selection import check_values
from brainbench.datasets.trials.session_trials import fingerprint, missing_labels, same_trials

if TYPE_CHECKING:
    import xarray as xr


def join_sessions(
    parts: list[SessionCounts], options: ReadingOptions, *, source: str, layout: str, notes: list[str]
) -> xr.Dataset:
    """Join the sessions' trials and units, block by block, in canonical order.

    ``source`` is what the user asked for, ``layout`` the name of the layout with how it was chosen, or "".
    """
    import xarray as xr

    # The order must not depend on that of the files: equal data then have equal content hashes.
    parts = sorted(parts, key=lambda part: (natural_key(part.subject), natural_key(part.session)))
    doubts = [*check_values(part.tally for part in parts), *_doubtful_names(parts)]
    removed: Counter[str] = Counter()
    for part in parts:
        removed.update(part.tally.removed)
    # A session without trials would add units that are missing in every row.
    everything, parts = parts, [part for part in parts if part.labels] or parts
    empty = [part for part in everything if not part.labels]
    lost = "no trial is left, so its {} units are left out"
    doubts += [f"session {part.session} of {part.subject}: {lost.format(len(part.unit_ids))}" for part in empty]
    trials, units = sum(len(part.labels) for part in parts), sum(len(part.unit_ids) for part in parts)
    if not trials or not units:
        what = "trial" if not trials else "unit"
        reasons = "; ".join(f"{rule} removed {number}" for rule, number in removed.items() if number)
        raise DataError(f"No {what} remains of {source}: {reasons or 'the tables are empty'}.")
    overlapping, alike = np.sum([_overlaps(part) for part in parts], axis=0).tolist()
    if overlapping:
        doubts.append(
            f"the windows of {overlapping} of {trials} trials begin before that of an earlier one ends ({alike} of one "
            "with the same label): such trials share spikes, so their noise is not independent"
        )
    vocabulary = options.vocabulary or natural_vocabulary(row for part in parts for row in part.values)
    present = {label for part in parts for label in part.labels}
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
        **{name: ("trial", _covariate(parts, name)) for name in COVARIATES if any(name in p.covariates for p in parts)},
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
        "layout": layout,
        "window": str(options.window),
        "bin": options.bin,
        "selection": {"name": options.selection.name, "rules": list(options.selection.lines())},
        "removed": dict(removed),
        "sessions": [_about(part) for part in everything],
        "notes": [*notes, *doubts, *(note for part in everything for note in part.tally.notes)],
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
        named = listing(name for name in subjects if name in guessed)
        yield f"files that do not name their animal count as an animal each, after their own name: {named}"
    folded: dict[str, list[str]] = {}
    for name in subjects:
        folded.setdefault("".join(name.lower().split()), []).append(name)
    for names in folded.values():
        if len(names) > 1:
            yield f"animals whose names differ only in case or blanks count as different ones: {listing(names)}"
    # Equal intervals are those of a fixed protocol; unequal ones at equal times are those of one session.
    uneven = [part for part in parts if len(part.labels) > 2 and np.ptp(np.diff(part.edges[:, 0])) > 0.01]
    for index, part in enumerate(uneven):
        for other in uneven[:index]:
            same = other.subject != part.subject and same_trials(
                part.edges[:, 0], np.array(part.labels), other.edges[:, 0], np.array(other.labels), clocks=False
            )
            if same:
                yield (
                    f"session {other.session} of {other.subject} and {part.session} of {part.subject} have the same "
                    f"labels at the same times in {len(same)} trials, as two probes or two copies of one session have, "
                    "and count as two animals"
                )


def _overlaps(part: SessionCounts) -> tuple[int, int]:
    """Count the trials whose window begins before that of an earlier trial ends, and before one of their label does."""

    def count(edges: NDArray[np.float64]) -> int:
        begin, end = edges[np.argsort(edges[:, 0])].T
        return int((begin[1:] < np.maximum.accumulate(end)[:-1] - 1e-9).sum())

    labels = np.array(part.labels)
    return count(part.edges), sum(count(part.edges[labels == label]) for label in set(part.labels))


def _covariate(parts: list[SessionCounts], name: str) -> NDArray[np.float64]:
    """Return one covariate of all trials; NaN in sessions that do not tell it."""
    return np.concatenate([part.covariates.get(name, np.full(len(part.labels), np.nan)) for part in parts])


def _about(part: SessionCounts) -> dict[str, Any]:
    return {
        "subject": part.subject,
        "session": part.session,
        "source": part.source,
        "trials": len(part.labels),
        "trials_in_file": part.trials,
        "units": len(part.unit_ids),
        "units_in_file": part.units,
        "removed": dict(part.tally.removed),
        "synthetic": part.synthetic,
    }
