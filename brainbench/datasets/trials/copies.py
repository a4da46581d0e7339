"""Sessions that are one: the same spikes twice, and probes that were recorded at once.

Spikes and trials decide, and names never: copies have other names, and templates give one name to all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import PurePath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.contracts import natural_key
from brainbench.core.errors import DataError, listing
from brainbench.datasets.ledger import Ledger
from brainbench.datasets.sessions import Session
from brainbench.datasets.trials.counting import COVARIATES, SessionCounts

_FEWEST_SPIKES = 6
"""Spikes that a unit needs to be recognised."""
_COMPARED = 32
"""Intervals that are compared; so many that agree to a tenth of a millisecond are no chance."""
_EQUAL = 1e-4
"""Intervals (s) that differ by less are equal."""

Floats = NDArray[np.float64]


@dataclass
class Copies:
    """Looks for spikes that were read before, on whatever clock and under whatever name."""

    seen: dict[int, list[tuple[Floats, Session]]] = field(default_factory=dict)
    """Number of spikes → first intervals and session of each unit."""
    judged: dict[str, int] = field(default_factory=dict)
    """Source → its units that can be recognised."""

    def compare(self, session: Session, spikes: Sequence[Floats]) -> str:
        """Take the units [U] of a session, and return a doubt where some were read before.

        Raises DataError where most of the units of one are among those of the other.
        """
        source = session.source
        signatures = [(len(times), np.diff(times[: _COMPARED + 1])) for times in spikes if len(times) >= _FEWEST_SPIKES]
        repeated: dict[str, int] = {}
        for number, steps in signatures:
            alike = (earlier for before, earlier in self.seen.get(number, ()) if np.abs(before - steps).max() < _EQUAL)
            # A regular train, as of a program, is like any other one unless the names agree too.
            regular = np.ptp(steps) < _EQUAL
            for name in {earlier.source for earlier in alike if not regular or _may_be_one(earlier, session)}:
                repeated[name] = repeated.get(name, 0) + 1
        for number, steps in signatures:
            self.seen.setdefault(number, []).append((steps, session))
        self.judged[source] = len(signatures)
        if not repeated:
            return ""
        name = max(sorted(repeated), key=lambda key: repeated[key] / min(len(signatures), self.judged[key]))
        least = min(len(signatures), self.judged[name])
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
    from brainbench.datasets.trials.session_trials import same_trials

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

    def both(name: str) -> tuple[Any, ...]:
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
        ledger=_joined_ledger(first.ledger, second.ledger, trials, len(more)),
        found_labels=first.found_labels | second.found_labels,
        forms={key: {*first.forms.get(key, ()), *second.forms.get(key, ())} for key in {**first.forms, **second.forms}},
    )


def _joined_ledger(first: Ledger, second: Ledger, trials: int, more: int) -> Ledger:
    """Return the balance of both: all of either, but of the trials, which both have, those that neither took."""
    ledger = Ledger().add(first).add(second)
    ledger.totals["trials"], ledger.read["trials"] = first.totals["trials"], trials
    left = [entry for entry in ledger.left if entry.kind != "trials"]
    # Trials that only the second part kept were removed from the first by its last rules.
    for entry in reversed([entry for entry in first.left if entry.kind == "trials"]):
        back = min(more, entry.number)
        left.insert(0, replace(entry, number=entry.number - back))
        more -= back
    ledger.left = left
    return ledger
