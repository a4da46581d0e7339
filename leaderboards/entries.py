"""From records to the rows that people read: one entry per model, its seeds folded together.

Networks that differ only in the seed of their weights are one **entry**. Its value is the mean over seeds.
Its interval crosses animals and seeds: the half widths of the t intervals of each animal's mean over seeds and
of each seed's mean over animals, added in squares (a little too wide, since both hold the residual). The
spread over seeds stands beside it. Entries are ranked as records are (:mod:`leaderboards.ranking`): models that are
not told apart are tied, and ranks are ranges.
"""

from __future__ import annotations

import math
import statistics
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from brainbench.core.files import content_hash
from brainbench.core.records import Interval, ModelCard, Score, Status
from brainbench.core.statistics import is_finite, t_interval
from leaderboards.ranking import Board, Ranked, RankedRecord, animals_of, rank_ranges

_SEVERITY: tuple[Status, ...] = ("ok", "unreliable", "undefined")
UNTRAINED = "untrained"


@dataclass(frozen=True)
class Entry(Ranked):
    """One model on a board: a record, or several that differ in the seed of the weights."""

    rows: tuple[RankedRecord, ...]
    """Its records, by seed."""
    page: str
    """File name of its page on a site; it stays when a seed is added."""
    value: float
    interval: Interval | None
    status: Status
    spread: float
    """Standard deviation of the value over seeds; NaN for one."""
    first: int | None = None
    last: int | None = None
    notes: tuple[str, ...] = ()

    @property
    def score(self) -> Score:
        """The score of its first seed, which stands for what all share."""
        return self.rows[0].record.score

    @property
    def card(self) -> ModelCard:
        """The model card of its first seed."""
        return self.rows[0].record.card or ModelCard(self.score.name)

    @property
    def name(self) -> str:
        """Name of the model."""
        return self.score.name

    @property
    def seeds(self) -> int:
        """Number of records."""
        return len(self.rows)

    @property
    def trained(self) -> bool:
        """True for a model whose card names an objective that it was trained with."""
        return self.card.objective not in (None, UNTRAINED)

    @property
    def unranked_because(self) -> str:
        """Reason why it has no rank; empty when it has one."""
        return "" if self.first is not None else self.rows[0].unranked_because or "not every seed is ranked"

    @property
    def p(self) -> float:
        """The largest permutation p over seeds."""
        return max((p for row in self.rows if math.isfinite(p := row.record.score.p)), default=math.nan)

    @property
    def r(self) -> float:
        """Mean raw comparison over seeds."""
        return _mean([row.record.score.r for row in self.rows])

    @property
    def architecture(self) -> str:
        """Name of its untrained twin, which of an untrained network is its own."""
        return self.card.twin or self.name

    @property
    def masking(self) -> float:
        """Share of masked time steps in training; 0 where the card states none."""
        value = self.card.training.get("masking")
        return float(value) if isinstance(value, (int, float)) and not isinstance(value, bool) else 0.0


def entries_of(board: Board, remarks: Mapping[str, Sequence[str]] | None = None) -> list[Entry]:
    """Return a board's entries, best first; those that cannot be ranked follow.

    Args:
        board: The board.
        remarks: Doubts about records by identity (:func:`leaderboards.audit.remarks`), kept as notes.
    """
    groups: dict[tuple[object, ...], list[RankedRecord]] = defaultdict(list)
    taken: dict[tuple[object, ...], int] = defaultdict(int)
    # Of the same model and seed the newest is the entry's; older ones stay visible as entries of their own.
    by_age = sorted(board.rows, key=lambda row: (row.record.score.provenance.time, row.record.identity))
    for row in reversed(by_age):
        kind = _kind(row)
        seed = row.record.card.seed if row.record.card else None
        copy = taken[*kind, seed]
        taken[*kind, seed] += 1
        groups[*kind, copy].append(row)
    entries = [_entry(board, key, rows, remarks or {}) for key, rows in groups.items()]
    ranked, found = [], []
    for entry in entries:
        able = entry.interval and not any(row.unranked_because for row in entry.rows)
        (ranked if able else found).append(entry)
    intervals = [entry.interval for entry in ranked if entry.interval]
    ranges = rank_ranges(intervals, [_animals(entry) for entry in ranked], [_chance(entry) for entry in ranked])
    found += [replace(entry, first=first, last=last) for entry, (first, last) in zip(ranked, ranges, strict=True)]
    return sorted(found, key=lambda entry: (*entry.order(entry.value), entry.name, entry.page))


def twins(entries: Sequence[Entry]) -> dict[str, Entry]:
    """Return the untrained entries by the architecture's name."""
    return {entry.architecture: entry for entry in reversed(entries) if not entry.trained}


def _animals(entry: Entry) -> dict[str, float]:
    """Return each animal's mean over seeds, of the animals that every seed was scored on."""
    found = [animals_of(row.record.score) for row in entry.rows]
    return {name: _mean([one[name] for one in found]) for name in found[0] if all(name in one for one in found)}


def _chance(entry: Entry) -> float:
    """Return the variance of the mean over seeds."""
    return entry.spread**2 / entry.seeds if entry.seeds > 1 and math.isfinite(entry.spread) else 0.0


def _kind(row: RankedRecord) -> tuple[object, ...]:
    card = row.record.card
    if card is None or card.seed is None:  # nobody can know what else differs
        return (row.record.score.name, card.weights if card else None, row.record.identity if card is None else None)
    masking = card.training.get("masking")
    return (row.record.score.name, card.objective, card.augmentation, str(masking))


def _entry(
    board: Board, key: tuple[object, ...], rows: list[RankedRecord], remarks: Mapping[str, Sequence[str]]
) -> Entry:
    rows = sorted(rows, key=lambda row: ((row.record.card and row.record.card.seed) or 0, row.record.identity))
    scores = [row.record.score for row in rows]
    values = [score.value for score in scores if math.isfinite(score.value)]
    where = (board.recordings_hash, board.stimuli_hash, board.conditions, board.time, board.estimator, board.metric)
    slug = rows[0].record.file_name.rpartition("--")[0]
    notes = list(dict.fromkeys(note for row in rows for note in (*remarks.get(row.record.identity, ()),)))
    if key[-1]:
        notes.append("an earlier record of a model that stands above or below once more")
    return Entry(
        rows=tuple(rows),
        page=f"{slug}--{content_hash([str(part) for part in (*where, *key)], length=10)}.html",
        value=_mean(values) if values else math.nan,
        interval=_interval(scores),
        status=_SEVERITY[max(_SEVERITY.index(score.status) for score in scores)],
        spread=statistics.stdev(values) if len(values) > 1 else math.nan,
        notes=tuple(notes),
    )


def _interval(scores: Sequence[Score]) -> Interval | None:
    if len(scores) == 1:
        return scores[0].interval if is_finite(scores[0].interval) else None
    animals: dict[str, list[float]] = defaultdict(list)
    for score in scores:
        for subject in score.subjects:
            if math.isfinite(subject.value):
                animals[subject.subject].append(subject.value)
    means = [_mean(values) for values in animals.values() if len(values) == len(scores)]
    if len(means) < 2:
        return None
    seeds = [score.value for score in scores]
    if not all(map(math.isfinite, seeds)):
        return None
    half = math.hypot(*((span.high - span.low) / 2 for span in map(t_interval, (means, seeds)) if span))
    middle = _mean(seeds)
    text = f"t over {len(means)} animals and {len(scores)} seeds, added in squares"
    return Interval(middle - half, middle + half, 0.95, text)


def _mean(values: Sequence[float]) -> float:
    finite = [value for value in values if math.isfinite(value)]
    return math.fsum(finite) / len(finite) if finite else math.nan
