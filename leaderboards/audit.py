"""What is doubtful about a set of records: stale ones, and those that contradict one another.

A record is **stale** when something newer exists than what made it: the layout, the package, the default
estimator, or the definition behind a fidelity's name. Two records **conflict** when they state the same
computation (recordings, stimuli, weights, seeds, settings) and different numbers.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable
from typing import Any

from brainbench import __version__
from brainbench.core.records import ESTIMATOR_VERSION, RECORD_SCHEMA, ResultRecord
from leaderboards import provenance
from leaderboards.store import StoredRecord

TOLERANCE = 1e-3
"""Two runs of one computation agree within this on every machine: float32 sums differ in their last digits."""


def remarks(stored: Iterable[StoredRecord]) -> dict[str, tuple[str, ...]]:
    """Return for each doubtful record, by its identity, one sentence per doubt.

    Every sentence begins with ``stale:`` or ``conflict:``.
    """
    usable = [item for item in stored if item.record is not None]
    found: dict[str, list[str]] = defaultdict(list)
    newest = _newest_stimuli(usable)
    for item in usable:
        if item.record is not None:
            found[item.record.identity] += [f"stale: {reason}" for reason in _stale(item.record, item.schema, newest)]
    for first, second in _conflicts([item.record for item in usable if item.record is not None]):
        for one, other in ((first, second), (second, first)):
            found[one.identity].append(
                f"conflict: the same computation gave {_value(one)} here and {_value(other)} in the record "
                f"{other.identity}; find out which with: brainbench leaderboard verify"
            )
    return {identity: tuple(sentences) for identity, sentences in found.items() if sentences}


def conflicting(record: ResultRecord, others: Iterable[ResultRecord]) -> list[ResultRecord]:
    """Return those of ``others`` that state the same computation as ``record`` and other numbers."""
    key = computation(record)
    return [
        other
        for other in others
        if other.identity != record.identity and computation(other) == key and not _agree(record, other)
    ]


def computation(record: ResultRecord) -> tuple[Any, ...]:
    """Return what was computed from what, as a key: equal keys must have equal numbers."""
    score, card = record.score, record.card
    settings = provenance.settings(score)
    return (
        provenance.recordings_hash(score),
        provenance.stimuli_hash(score),
        score.stimuli,
        score.estimator,
        score.metric,
        score.name,
        card.weights if card else None,
        provenance.version(score),
        *(str(settings.get(name)) for name in ("time", "seed", "layers", "normalize", "whiskers", "estimator_version")),
        *(str(provenance.recordings_part(score, name)) for name in ("window", "selection")),
    )


def older(version: str, than: str) -> bool:
    """Tell whether a version is older, comparing numbers as numbers; one that is none is not.

    >>> older("0.9.1", "0.10.0"), older("0.2", "0.2.0"), older("unknown", "0.2")
    (True, False, False)
    """
    one, other = _numbers(version), _numbers(than)
    if one is None or other is None:
        return False
    length = max(len(one), len(other))
    return one + (0,) * (length - len(one)) < other + (0,) * (length - len(other))


def _numbers(version: str) -> tuple[int, ...] | None:
    parts = version.split("+", maxsplit=1)[0].split(".")
    return tuple(map(int, parts)) if all(part.isdigit() for part in parts) else None


def _stale(record: ResultRecord, schema: int, newest: dict[tuple[Any, ...], tuple[str, str]]) -> list[str]:
    score = record.score
    settings = provenance.settings(score)
    reasons = []
    if schema < RECORD_SCHEMA:
        reasons.append(f"the file has the layout of version {schema}, now {RECORD_SCHEMA}")
    version = provenance.version(score)
    if older(version, __version__):
        reasons.append(f"made by brainbench {version}, this is {__version__}")
    estimator = settings.get("estimator_version")
    if score.estimator == "default" and isinstance(estimator, int) and estimator < ESTIMATOR_VERSION:
        reasons.append(f"version {estimator} of the default estimator, now {ESTIMATOR_VERSION}")
    latest = newest.get(_shown(record), ("", ""))[1]
    if latest and latest != provenance.stimuli_hash(score):
        reasons.append(
            f"its stimuli ({provenance.stimuli_hash(score)}) were made by another engine or an earlier definition of "
            f"fidelity {settings.get('fidelity')!r} than the newest records' ({latest})"
        )
    return reasons


def _shown(record: ResultRecord) -> tuple[Any, ...]:
    """Return by which words the stimuli were asked for: the same words may mean others in another version."""
    settings = provenance.settings(record.score)
    named = tuple(str(settings.get(name)) for name in ("stimuli", "whiskers", "fidelity"))
    return (provenance.stimuli_name(record.score), *named)


def _newest_stimuli(stored: list[StoredRecord]) -> dict[tuple[Any, ...], tuple[str, str]]:
    """Return for each wording of the stimuli the time and the hash of the newest record."""
    newest: dict[tuple[Any, ...], tuple[str, str]] = {}
    for item in stored:
        if item.record is None or not (shown := provenance.stimuli_hash(item.record.score)):
            continue
        if not provenance.settings(item.record.score).get("fidelity"):
            continue
        key = _shown(item.record)
        newest[key] = max(newest.get(key, ("", "")), (provenance.made_at(item.record.score), shown))
    return newest


def _conflicts(records: list[ResultRecord]) -> list[tuple[ResultRecord, ResultRecord]]:
    groups: dict[tuple[Any, ...], list[ResultRecord]] = defaultdict(list)
    for record in records:
        groups[computation(record)].append(record)
    return [
        (group[i], group[j])
        for group in groups.values()
        for i in range(len(group))
        for j in range(i + 1, len(group))
        if not _agree(group[i], group[j])
    ]


def _agree(one: ResultRecord, other: ResultRecord) -> bool:
    a, b = one.score, other.score
    same = all(
        (math.isnan(x) and math.isnan(y)) or abs(x - y) <= TOLERANCE
        for x, y in ((a.value, b.value), (a.r, b.r), (a.reliability, b.reliability))
    )
    return same and a.status == b.status


def _value(record: ResultRecord) -> str:
    return "no number" if math.isnan(record.score.value) else f"{record.score.value:.4f}"
