"""Boards of comparable scores, and the ranks that their intervals leave open.

Scores are comparable only within a **board**: same recordings, same stimuli, same estimator, same
metric, same use of the time axis. Within a board only scores of status ``ok`` that carry an
interval are ranked. Models that are not told apart are tied, so every model has a range of ranks: from
one more than the number of models told apart above it, to the number of ranked models less those told
apart below.

Two models that were scored on at least five animals in common are told apart by a paired t test over
these animals, at a false discovery rate of 5 % over all pairs of the board (Benjamini & Hochberg 1995):
they share the animals, so their difference is known better than either. With fewer animals, where no such
test is to be trusted, they are told apart when their intervals do not overlap.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from brainbench.core.records import Interval, ResultRecord, Score
from brainbench.core.statistics import is_finite, t_interval
from leaderboards.text import number, span

if TYPE_CHECKING:
    from numpy.typing import NDArray

PAIRED_ANIMALS = 5
"""Fewest animals in common for a paired test; coverage of t intervals was verified from five up."""
FALSE_DISCOVERY_RATE = 0.05


class Ranked:
    """Base of a model on a board, which has a range of ranks."""

    first: int | None
    last: int | None

    @property
    def rank(self) -> str:
        """The rank in print: ``2``, ``2–5``, or a dash when not ranked."""
        if self.first is None:
            return "–"
        return str(self.first) if self.first == self.last else f"{self.first}–{self.last}"

    def order(self, value: float) -> tuple[int, float]:
        """Return a key that sorts ranked before unranked and undefined, and each by its value, the highest first."""
        place = 0 if self.first is not None else 2 if math.isnan(value) else 1
        return place, 0.0 if math.isnan(value) else -value


@dataclass(frozen=True)
class RankedRecord(Ranked):
    """One row of a board."""

    record: ResultRecord
    first: int | None = None
    """Best rank that the intervals allow, from 1; None when the score is not ranked."""
    last: int | None = None
    """Worst rank that the intervals allow."""
    unranked_because: str = ""
    notes: tuple[str, ...] = ()


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
    """Rule by which the time axis entered the RDMs; empty when not stated."""
    estimator: str
    metric: str
    synthetic: bool
    rows: tuple[RankedRecord, ...]
    baselines: tuple[Baseline, ...] = field(default=())
    ties: str = ""
    """By which rule its models are told apart, in words."""

    @property
    def comparable(self) -> bool:
        """False when the hash of the recordings is missing, so that nobody can know what was compared."""
        return self.recordings_hash is not None


def rank(records: Iterable[ResultRecord]) -> list[Board]:
    """Sort records into boards and rank each board; the largest board comes first."""
    groups: dict[tuple[Any, ...], list[ResultRecord]] = defaultdict(list)
    for record in records:
        score = record.score
        brain, shown = score.provenance.recordings_hash, score.provenance.stimuli_hash
        groups[brain, shown, score.stimuli, score.provenance.time_rule, score.estimator, score.metric].append(record)
    boards = [_board(key, group) for key, group in groups.items()]
    return sorted(boards, key=lambda board: (-len(board.rows), board.recordings, board.estimator, board.metric))


def rank_ranges(
    intervals: Sequence[Interval],
    animals: Sequence[Mapping[str, float]] | None = None,
    chance: Sequence[float] | None = None,
) -> list[tuple[int, int]]:
    """Return the best and the worst rank that each model may have among all of them.

    Args:
        intervals: One per model.
        animals: Score of each animal, per model; pairs with :data:`PAIRED_ANIMALS` in common are compared on them.
        chance: Variance of each model's score beside that of the animals (its seeds'); 0 if not given.

    >>> rank_ranges([Interval(0.7, 0.9), Interval(0.6, 0.8), Interval(0.1, 0.3)])
    [(1, 2), (1, 2), (3, 3)]
    """
    if not intervals:
        return []
    low = np.array([interval.low for interval in intervals])
    high = np.array([interval.high for interval in intervals])
    above = low[None, :] > high[:, None]  # [i, j]: j is told apart above i
    if animals is not None:
        _compare_pairs(above, animals, np.zeros(len(low)) if chance is None else np.array(chance))
    best, worst = 1 + above.sum(axis=1), len(low) - above.sum(axis=0)
    return [(int(first), int(last)) for first, last in zip(best, worst, strict=True)]


def animals_of(score: Score) -> dict[str, float]:
    """Return the score of each animal that has one."""
    return {item.subject: item.value for item in score.subjects if math.isfinite(item.value)}


def paired_difference(one: Score, other: Score, level: float = 0.95) -> tuple[float, Interval, int] | None:
    """Return the mean difference of two scores over the animals both could use, its t interval and their number.

    None with fewer than :data:`PAIRED_ANIMALS` of them.
    """
    first, second = ({item.subject: item.value for item in x.subjects if item.status == "ok"} for x in (one, other))
    difference = np.array([first[name] - second[name] for name in sorted(first.keys() & second.keys())])
    difference = difference[np.isfinite(difference)]
    interval = t_interval(difference, level, over="animals")
    if interval is None or len(difference) < PAIRED_ANIMALS:
        return None
    return float(difference.mean()), replace(interval, method=f"paired {interval.method}"), len(difference)


def comparisons(record: ResultRecord) -> list[str]:
    """Say how the score stands to each baseline: by the paired difference over animals, with few of them by overlap."""
    score = record.score
    others = list(record.baselines.items())
    if record.animal_to_animal is not None:
        others.append(("animal-to-animal", record.animal_to_animal))
    if score.status != "ok" or score.interval is None or not is_finite(score.interval):
        return []
    sentences = []
    for name, other in others:
        if other.status != "ok" or other.interval is None or not is_finite(other.interval):
            reason = "has no interval" if other.status == "ok" else f"is {other.status}"
            sentences.append(f"Cannot be compared with {name}, which {reason}.")
        elif (paired := paired_difference(score, other)) is not None:
            mean, interval, animals = paired
            verdict = "Above" if interval.low > 0 else "Below" if interval.high < 0 else "Not told apart from"
            sentences.append(
                f"{verdict} {name} ({number(other.value)}): difference {number(mean)} {span(interval)}, paired over "
                f"{animals} animals."
            )
        else:
            above, below = score.interval.low > other.interval.high, score.interval.high < other.interval.low
            verdict = "Above" if above else "Below" if below else "Not told apart from"
            how = "do not overlap" if above or below else "overlap"
            sentences.append(f"{verdict} {name} ({number(other.value)}): the intervals {how}.")
    if any("overlap" in sentence for sentence in sentences):
        sentences.append(f"With fewer than {PAIRED_ANIMALS} animals in common no paired test is trusted.")
    return sentences


def pairs_rule(animals: Sequence[Mapping[str, float]]) -> str:
    """Return by which rule models with these animals are told apart, in words."""
    most = max((len(set(one)) for one in animals), default=0)
    if most >= PAIRED_ANIMALS:
        return (
            "Models are tied unless a paired t test over the animals tells them apart, at a false discovery rate of "
            "5 % over all pairs."
        )
    return (
        f"Models whose intervals overlap are tied (with fewer than {PAIRED_ANIMALS} animals no paired test is trusted)."
    )


def _compare_pairs(
    above: NDArray[np.bool_], animals: Sequence[Mapping[str, float]], chance: NDArray[np.float64]
) -> None:
    """Overwrite ``above`` [N, N] for the pairs that a paired test can compare."""
    from scipy.special import stdtr
    from scipy.stats import false_discovery_control

    names = sorted({name for values in animals for name in values})
    table = np.array([[values.get(name, math.nan) for name in names] for values in animals]).reshape(len(animals), -1)
    p = np.full(above.shape, math.nan)
    higher = np.zeros_like(above)
    for i, row in enumerate(table):
        difference = table - row
        shared = np.isfinite(difference).sum(axis=1)
        tested = np.flatnonzero((shared >= PAIRED_ANIMALS) & (np.arange(len(table)) != i))
        if not len(tested):
            continue
        mean, spread = np.nanmean(difference[tested], axis=1), np.nanvar(difference[tested], axis=1, ddof=1)
        error = np.sqrt(spread / shared[tested] + chance[tested] + chance[i])
        t = np.divide(np.abs(mean), error, out=np.where(mean == 0, 0.0, math.inf), where=error > 0)
        p[i, tested] = 2 * stdtr(shared[tested] - 1.0, -t)
        higher[i, tested] = mean > 0
    known = np.isfinite(p)
    pairs = np.triu(known, 1)
    adjusted = np.ones_like(p)
    if pairs.any():
        adjusted[pairs] = false_discovery_control(p[pairs])
    adjusted = np.minimum(adjusted, adjusted.T)
    above[known] = ((adjusted <= FALSE_DISCOVERY_RATE) & higher)[known]


def _board(key: tuple[Any, ...], records: list[ResultRecord]) -> Board:
    recordings_hash, stimuli_hash, conditions, time, estimator, metric = key
    repeats = Counter(_model(record) for record in records)
    reasons = [_unranked(record, recordings_hash is not None) for record in records]
    ranked = [record for record, reason in zip(records, reasons, strict=True) if not reason]
    animals = [animals_of(record.score) for record in ranked]
    ranges = iter(rank_ranges([record.score.interval for record in ranked if record.score.interval], animals))
    rows = []
    for record, reason in zip(records, reasons, strict=True):
        first, last = (None, None) if reason else next(ranges)
        times = repeats[_model(record)]
        notes = (f"scored {times} times on this board; compare the versions",) if times > 1 else ()
        rows.append(RankedRecord(record, first, last, reason, notes))
    rows.sort(key=lambda row: (*row.order(row.record.score.value), row.record.score.name))
    return Board(
        recordings=_most_common(record.score.provenance.recordings_name for record in records),
        recordings_hash=recordings_hash,
        stimuli=_most_common(record.score.provenance.stimuli_name for record in records),
        stimuli_hash=stimuli_hash,
        conditions=conditions,
        time=time,
        estimator=estimator,
        metric=metric,
        synthetic=any(record.synthetic for record in records),
        rows=tuple(rows),
        baselines=tuple(_baselines([row.record for row in rows])),
        ties=pairs_rule(animals),
    )


def _unranked(record: ResultRecord, comparable: bool) -> str:
    score = record.score
    if score.status != "ok":
        return score.status
    if not is_finite(score.interval):
        return "no interval"
    return "" if comparable else "recordings not identified"


def _model(record: ResultRecord) -> tuple[object, ...]:
    card = record.card
    return (record.score.name, card.weights if card else None, card.seed if card else None)


def _outcome(score: Score) -> tuple[str, float | None]:
    """Status and value to nine digits: sums on other machines, or by more threads, end in other last digits."""
    return score.status, None if math.isnan(score.value) else round(score.value, 9)


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
        counts = Counter(map(_outcome, scores))
        usual = counts.most_common(1)[0][0]
        score = next(score for score in scores if _outcome(score) == usual)
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
