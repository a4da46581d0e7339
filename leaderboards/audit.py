"""Doubtful records of a set: stale ones, and those that contradict one another.

A record is **stale** when something newer exists than what made it: the default estimator, or the definition behind a
fidelity's name. A newer package alone makes none: what changes numbers raises the estimator's version. Two records
**conflict** when they state one identity (:class:`brainbench.core.identity.ScoreIdentity`) and different numbers.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Iterator
from itertools import islice
from typing import Any

from brainbench.core.identity import ScoreIdentity
from brainbench.core.records import ESTIMATOR_VERSION, ResultRecord
from leaderboards.store import StoredRecord

TOLERANCE = 1e-3
"""Two runs of one computation agree within this on every machine: float32 sums differ in their last digits."""
MOST_NAMED = 3
"""Most contradicting records that are named for one."""


def remarks(stored: Iterable[StoredRecord]) -> dict[str, tuple[str, ...]]:
    """Return for each doubtful record, by its identity, one sentence per doubt.

    Every sentence begins with ``stale:`` or ``conflict:``.
    """
    usable = [item.record for item in stored if item.record is not None]
    doubts: dict[str, list[str]] = defaultdict(list)
    newest = _newest_stimuli(usable)
    groups: dict[ScoreIdentity, list[ResultRecord]] = defaultdict(list)
    for record in usable:
        doubts[record.identity] += [f"stale: {reason}" for reason in _stale(record, newest)]
        groups[ScoreIdentity.of(record)].append(record)
    for group in groups.values():
        for record in group:
            # A few are enough to find out, and a set of many contradicting records stays readable.
            for rival in islice((rival for rival in group if not _agree(record, rival)), MOST_NAMED):
                doubts[record.identity].append(
                    f"conflict: the same computation gave {_value(record)} here and {_value(rival)} in the record "
                    f"{rival.identity}; find out which with: brainbench leaderboard verify"
                )
    return {identity: tuple(sentences) for identity, sentences in doubts.items() if sentences}


def conflicting(record: ResultRecord, others: Iterable[ResultRecord]) -> Iterator[ResultRecord]:
    """Yield those of ``others`` that state the same computation as ``record`` and other numbers."""
    key = ScoreIdentity.of(record)
    rivals = (rival for rival in others if not _agree(record, rival) and ScoreIdentity.of(rival) == key)
    return (rival for rival in rivals if rival.identity != record.identity)


def _stale(record: ResultRecord, newest: dict[tuple[Any, ...], tuple[str, str]]) -> list[str]:
    score, settings, reasons = record.score, record.score.provenance.settings, []
    estimator = settings.get("estimator_version")
    if score.estimator == "default" and isinstance(estimator, int) and estimator < ESTIMATOR_VERSION:
        reasons.append(f"version {estimator} of the default estimator, now {ESTIMATOR_VERSION}")
    latest = newest.get(_wording(record), ("", ""))[1]
    if latest and latest != score.provenance.stimuli_hash:
        reasons.append(
            f"its stimuli ({score.provenance.stimuli_hash}) were made by another engine or an earlier definition of "
            f"fidelity {settings.get('fidelity')!r} than the newest records' ({latest})"
        )
    return reasons


def _wording(record: ResultRecord) -> tuple[Any, ...]:
    """Return the words by which the stimuli were asked for: they may mean others in another version."""
    origin = record.score.provenance
    return (origin.stimuli_name, *(str(origin.settings.get(name)) for name in ("stimuli", "whiskers", "fidelity")))


def _newest_stimuli(records: list[ResultRecord]) -> dict[tuple[Any, ...], tuple[str, str]]:
    """Return for each wording of the stimuli the time and the hash of the newest record."""
    newest: dict[tuple[Any, ...], tuple[str, str]] = {}
    for record in records:
        origin = record.score.provenance
        if origin.stimuli_hash and origin.settings.get("fidelity"):
            key = _wording(record)
            newest[key] = max(newest.get(key, ("", "")), (origin.time, origin.stimuli_hash))
    return newest


def _agree(left: ResultRecord, right: ResultRecord) -> bool:
    a, b = left.score, right.score
    same = all(
        (math.isnan(x) and math.isnan(y)) or abs(x - y) <= TOLERANCE
        for x, y in ((a.value, b.value), (a.r, b.r), (a.reliability, b.reliability))
    )
    return same and a.status == b.status


def _value(record: ResultRecord) -> str:
    return "no number" if math.isnan(record.score.value) else f"{record.score.value:.4f}"
