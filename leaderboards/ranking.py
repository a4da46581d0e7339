"""What may be compared with what, and which ranks the intervals leave open.

Scores are comparable only within a **board**: same recordings, same stimuli, same estimator, same
metric, same use of the time axis. Within a board only scores of status ``ok`` that carry an
interval are ranked. Two models whose intervals overlap are not told apart, so every model has a
range of ranks: from one more than the number of models whose interval lies wholly above its own, to
the number of ranked models less those whose interval lies wholly below. The rule is conservative
(the models share the animals, so a paired comparison could separate more of them) and needs nothing
that a record does not hold.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections import Counter, defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from brainbench.types import Interval, ResultRecord, Score
from leaderboards import _origin
from leaderboards._figures import known
from leaderboards.store import record_name


@dataclass(frozen=True)
class RankedRecord:
    """One row of a board."""

    record: ResultRecord
    file_name: str
    """Name of the record's file, which ends in its content hash (:func:`leaderboards.record_name`)."""
    first: int | None = None
    """Best rank that the intervals allow, from 1; None when the score is not ranked."""
    last: int | None = None
    """Worst rank that the intervals allow."""
    unranked_because: str = ""
    notes: tuple[str, ...] = ()

    @property
    def identity(self) -> str:
        """Content hash of the record."""
        return self.file_name.rpartition("--")[2].removesuffix(".json")

    @property
    def rank(self) -> str:
        """The rank in print: ``2``, ``2–5``, or a dash when not ranked."""
        if self.first is None:
            return "–"
        return str(self.first) if self.first == self.last else f"{self.first}–{self.last}"


@dataclass(frozen=True)
class Baseline:
    """A baseline of a board, taken from the records in it."""

    name: str
    score: Score
    kind: str
    """``baseline`` or ``animals`` (animal-to-animal)."""
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Board:
    """The records that may be compared with one another, best first."""

    recordings: str
    recordings_hash: str | None
    stimuli: str
    stimuli_hash: str | None
    """None when the features were computed elsewhere, from stimuli that the record cannot name."""
    conditions: tuple[str, ...]
    """Labels that were compared, in the order of the RDMs."""
    time: str
    """How the time axis entered the RDMs; empty when not stated."""
    estimator: str
    metric: str
    synthetic: bool
    rows: tuple[RankedRecord, ...]
    baselines: tuple[Baseline, ...] = field(default=())

    @property
    def comparable(self) -> bool:
        """False when the hash of the recordings is missing, so that nobody can know what was compared."""
        return self.recordings_hash is not None


def rank(records: Iterable[ResultRecord]) -> list[Board]:
    """Sort records into boards and rank each board; the largest board comes first."""
    groups: dict[tuple[Any, ...], list[ResultRecord]] = defaultdict(list)
    for record in records:
        score = record.score
        brain, shown = _origin.recordings_hash(score), _origin.stimuli_hash(score)
        groups[brain, shown, score.stimuli, _origin.time_rule(score), score.estimator, score.metric].append(record)
    boards = [_board(key, group) for key, group in groups.items()]
    return sorted(boards, key=lambda board: (-len(board.rows), board.recordings, board.estimator, board.metric))


def rank_ranges(intervals: list[Interval]) -> list[tuple[int, int]]:
    """Return the best and the worst rank that each interval allows among all of them.

    >>> rank_ranges([Interval(0.7, 0.9), Interval(0.6, 0.8), Interval(0.1, 0.3)])
    [(1, 2), (1, 2), (3, 3)]
    """
    lows = sorted(interval.low for interval in intervals)
    highs = sorted(interval.high for interval in intervals)
    count = len(intervals)
    return [
        (1 + count - bisect_right(lows, interval.high), count - bisect_left(highs, interval.low))
        for interval in intervals
    ]


def _board(key: tuple[Any, ...], records: list[ResultRecord]) -> Board:
    recordings_hash, stimuli_hash, conditions, time, estimator, metric = key
    repeats = Counter(_model(record) for record in records)
    reasons = [_unranked(record, recordings_hash is not None) for record in records]
    ranked = [record for record, reason in zip(records, reasons, strict=True) if not reason]
    ranges = iter(rank_ranges([record.score.interval for record in ranked if record.score.interval]))
    rows = []
    for record, reason in zip(records, reasons, strict=True):
        first, last = (None, None) if reason else next(ranges)
        times = repeats[_model(record)]
        notes = (f"scored {times} times on this board; compare the versions",) if times > 1 else ()
        rows.append(RankedRecord(record, record_name(record), first, last, reason, notes))
    rows.sort(key=_order)
    return Board(
        recordings=_most_common(_origin.recordings_name(record.score) for record in records),
        recordings_hash=recordings_hash,
        stimuli=_most_common(_origin.stimuli_name(record.score) for record in records),
        stimuli_hash=stimuli_hash,
        conditions=conditions,
        time=time,
        estimator=estimator,
        metric=metric,
        synthetic=any(record.synthetic for record in records),
        rows=tuple(rows),
        baselines=tuple(_baselines([row.record for row in rows])),
    )


def _unranked(record: ResultRecord, comparable: bool) -> str:
    score = record.score
    if score.status != "ok":
        return score.status
    if not known(score.interval):
        return "no interval"
    return "" if comparable else "recordings not identified"


def _order(row: RankedRecord) -> tuple[int, float, str]:
    value = row.record.score.value
    place = 0 if row.first is not None else 2 if math.isnan(value) else 1
    return place, 0.0 if math.isnan(value) else -value, row.record.score.name


def _model(record: ResultRecord) -> tuple[object, ...]:
    card = record.card
    return (record.score.name, card.weights if card else None, card.seed if card else None)


def _baselines(records: list[ResultRecord]) -> list[Baseline]:
    """Take each baseline once; records of one board should agree on it, and a note says when they do not."""
    found: dict[tuple[str, str], list[Score]] = defaultdict(list)
    for record in records:
        if record.animal_to_animal is not None:
            found["animals", "animal-to-animal"].append(record.animal_to_animal)
        for name, score in record.baselines.items():
            found["baseline", name].append(score)
    baselines = []
    for (kind, name), scores in found.items():
        counts = Counter((score.status, None if math.isnan(score.value) else score.value) for score in scores)
        usual = counts.most_common(1)[0][0]
        score = next(s for s in scores if (s.status, None if math.isnan(s.value) else s.value) == usual)
        notes: tuple[str, ...] = ()
        if len(counts) > 1:
            values = [value for _, value in counts if value is not None]
            notes = (
                f"the records disagree: {len(counts)} different values"
                + (f" from {min(values):.3f} to {max(values):.3f}" if values else "")
                + f"; shown is that of {counts[usual]} of {len(scores)} records",
            )
        baselines.append(Baseline(name, score, kind, notes))
    return baselines


def _most_common(names: Iterable[str]) -> str:
    return Counter(names).most_common(1)[0][0]
