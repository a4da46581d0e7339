"""Doubtful records of a set: stale ones, and those that contradict one another.

A record is **stale** when something newer exists than what made it: the package, the default estimator, or the
definition behind a fidelity's name. Two records **conflict** when they state the same computation (recordings, stimuli,
their pairing, weights, seeds, settings) and different numbers.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Iterator
from itertools import islice
from typing import Any

from packaging.version import InvalidVersion, Version

from brainbench.core.records import ESTIMATOR_VERSION, ResultRecord
from brainbench.core.version import __version__
from leaderboards.store import StoredRecord

TOLERANCE = 1e-3
"""Two runs of one computation agree within this on every machine: float32 sums differ in their last digits."""
MOST_NAMED = 3
"""Most contradicting records that are named for one."""
_SETTINGS = (
    "time", "seed", "layers", "layer", "units_reliability", "normalize", "whiskers", "estimator_version", "readout"
)  # fmt: skip


def remarks(stored: Iterable[StoredRecord]) -> dict[str, tuple[str, ...]]:
    """Return for each doubtful record, by its identity, one sentence per doubt.

    Every sentence begins with ``stale:`` or ``conflict:``.
    """
    usable = [item.record for item in stored if item.record is not None]
    found: dict[str, list[str]] = defaultdict(list)
    newest = _newest_stimuli(usable)
    groups: dict[tuple[Any, ...], list[ResultRecord]] = defaultdict(list)
    for record in usable:
        found[record.identity] += [f"stale: {reason}" for reason in _stale(record, newest)]
        groups[computation(record)].append(record)
    for group in groups.values():
        for one in group:
            # A few are enough to find out, and a set of many contradicting records stays readable.
            for other in islice((other for other in group if not _agree(one, other)), MOST_NAMED):
                found[one.identity].append(
                    f"conflict: the same computation gave {_value(one)} here and {_value(other)} in the record "
                    f"{other.identity}; find out which with: brainbench leaderboard verify"
                )
    return {identity: tuple(sentences) for identity, sentences in found.items() if sentences}


def conflicting(record: ResultRecord, others: Iterable[ResultRecord]) -> Iterator[ResultRecord]:
    """Yield those of ``others`` that state the same computation as ``record`` and other numbers."""
    key = computation(record)
    rivals = (other for other in others if not _agree(record, other) and computation(other) == key)
    return (other for other in rivals if other.identity != record.identity)


def computation(record: ResultRecord) -> tuple[Any, ...]:
    """Return what was computed from what, as a key: equal keys must have equal numbers."""
    score, card, origin = record.score, record.card, record.score.provenance
    inputs = (origin.recordings_hash, origin.stimuli_hash, score.stimuli, card.weights if card else None)
    return (
        *inputs,
        origin.pairing,
        *(score.estimator, score.metric, score.name, origin.version),
        *(str(origin.settings.get(name)) for name in _SETTINGS),
        *(str(origin.recordings.get(name)) for name in ("window", "selection")),
    )


def older(version: str, than: str) -> bool:
    """Tell whether a version is older; one that is none is not.

    >>> older("0.9.1", "0.10.0"), older("0.2", "0.2.0"), older("unknown", "0.2")
    (True, False, False)
    """
    try:
        return Version(version) < Version(than)
    except InvalidVersion:
        return False


def _stale(record: ResultRecord, newest: dict[tuple[Any, ...], tuple[str, str]]) -> list[str]:
    score, version = record.score, record.score.provenance.version
    settings = score.provenance.settings
    reasons = []
    if older(version, __version__):
        reasons.append(f"made by brainbench {version}, this is {__version__}")
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


def _agree(one: ResultRecord, other: ResultRecord) -> bool:
    a, b = one.score, other.score
    same = all(
        (math.isnan(x) and math.isnan(y)) or abs(x - y) <= TOLERANCE
        for x, y in ((a.value, b.value), (a.r, b.r), (a.reliability, b.reliability))
    )
    return same and a.status == b.status


def _value(record: ResultRecord) -> str:
    return "no number" if math.isnan(record.score.value) else f"{record.score.value:.4f}"
