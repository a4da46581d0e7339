"""The rows that people read: one entry per model, the seeds of its weights folded together.

Networks that differ only in the seed of their weights are one **entry**: the mean over seeds, an interval over animals,
stimuli and seeds (:class:`leaderboards.ranking.Sample`), and the spread over seeds beside it.
"""

from __future__ import annotations

import math
import statistics
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cached_property

import numpy as np

from brainbench.core.errors import visible_name
from brainbench.core.files import content_hash
from brainbench.core.identity import unusual_settings
from brainbench.core.records import Interval, ModelCard, ResultRecord, Score
from brainbench.core.statistics import is_finite
from leaderboards.ranking import CHANCE_LEVEL, STANDINGS, Sample, Standing, not_repeatable, rank_in_print, standing_of

UNTRAINED = "untrained"
TOLERANCE = 1e-3
"""Two runs of one computation agree within this on every machine, distances in shares of the largest of their RDM:
processors differ in the last digits of single precision, which move scores by 1e-5."""
_SAME = 1e-6  # largest difference of values, and of RDMs scaled to length 1, of one computation (float32 sums differ)


@dataclass(frozen=True)
class Entry:
    """One model on a board: a record, or several that differ in the seed of the weights."""

    records: tuple[ResultRecord, ...]
    """Its records, by seed."""
    page: str
    """File name of its page on a site; it stays when a seed is added. Empty for none."""
    notes: tuple[str, ...] = ()
    first: int | None = None
    """Best rank that the tests leave open, from 1; None when it is not ranked."""
    last: int | None = None
    """Worst rank that the tests leave open."""
    unranked_because: str = ""
    same_as: str = ""
    """Name of the entry whose chosen layer is the same computation; empty for none."""
    above_raw: bool = False
    """True when it is told apart above the raw input."""
    below_leader: bool = False
    """True when it is told apart below the entry with the highest score."""
    sample: Sample = field(default=None, repr=False, compare=False)  # type: ignore[assignment] - folded below

    def __post_init__(self) -> None:
        """Fold the seeds; a copy with other ranks or notes has the same sample."""
        object.__setattr__(self, "sample", self.sample or Sample.of([record.score for record in self.records]))

    @property
    def rank(self) -> str:
        """The rank in print."""
        return rank_in_print(self.first, self.last)

    @property
    def score(self) -> Score:
        """The score of its first seed, which stands for what all share."""
        return self.records[0].score

    @property
    def card(self) -> ModelCard:
        """The model card of its first seed."""
        return self.records[0].card or ModelCard(self.score.name)

    @property
    def name(self) -> str:
        """Name of the model."""
        return visible_name(self.score.name)

    @property
    def seeds(self) -> int:
        """Number of records."""
        return len(self.records)

    @property
    def value(self) -> float:
        """Mean over seeds of the metric's own value."""
        return self._mean("value")

    @property
    def scaled(self) -> float:
        """Mean over seeds of the score between chance (0) and all that is reliable (1)."""
        return self._mean("scaled")

    @property
    def unique(self) -> float:
        """Mean over seeds of the part that raw input and contacts do not explain; NaN where a seed states none."""
        parts = [record.score.provenance.unique for record in self.records]
        return float(np.mean([math.nan if part is None or part.status != "ok" else part.unique for part in parts]))

    @property
    def r(self) -> float:
        """Mean raw comparison over seeds."""
        return self._mean("r")

    @cached_property
    def interval(self) -> Interval | None:
        """Interval of :attr:`scaled`."""
        interval = self.score.scaled_interval if self.seeds == 1 else self.sample.interval
        return interval if is_finite(interval) else None

    @property
    def spread(self) -> float:
        """Standard deviation of :attr:`scaled` over seeds; NaN for one."""
        return statistics.stdev(self.sample.seeds) if self.seeds > 1 else math.nan

    @property
    def p(self) -> float:
        """The largest permutation p over seeds; NaN when a seed states none."""
        return float(np.max([record.score.p for record in self.records]))

    @property
    def above_chance(self) -> bool:
        """True when the permutation test tells every seed apart from chance."""
        return self.p <= CHANCE_LEVEL

    @property
    def standing(self) -> Standing:
        """Strongest statement about it; of several seeds the least."""
        standings = [standing_of(record.score, above_raw=self.above_raw) for record in self.records]
        return STANDINGS[max(map(STANDINGS.index, standings))]

    @property
    def not_repeatable(self) -> str:
        """Reason why nobody here can compute it again; empty when everybody can."""
        return next(filter(None, map(not_repeatable, self.records)), "")

    @property
    def layer(self) -> str:
        """The layers that its seeds were scored at, each named once; empty when none is stated."""
        return ", ".join(dict.fromkeys(filter(None, (record.score.layer for record in self.records))))

    @property
    def trained(self) -> bool:
        """True for a model whose card names an objective that it was trained with."""
        return self.card.objective not in (None, UNTRAINED)

    @property
    def architecture(self) -> str:
        """Name of its untrained twin, which of an untrained network is its own."""
        return self.card.twin or self.name

    @property
    def masking(self) -> float:
        """Share of masked time steps in training; 0 where the card states none."""
        value = self.card.training.get("masking")
        return float(value) if isinstance(value, (int, float)) and not isinstance(value, bool) else 0.0

    @property
    def order(self) -> tuple[bool, int, float, str, str]:
        """Key that sorts a board: what stands apart last, then by standing, then the highest score first."""
        # Chance is a matter of the test; above it the score alone gives the order.
        place = max(STANDINGS.index(self.standing), 1)
        value = self.scaled if math.isfinite(self.scaled) else self.value
        return bool(self.not_repeatable), place, math.inf if math.isnan(value) else -value, self.name, self.page

    def _mean(self, name: str) -> float:
        values = [value for record in self.records if math.isfinite(value := getattr(record.score, name))]
        return math.fsum(values) / len(values) if values else math.nan


def fold_seeds(
    records: Iterable[ResultRecord], board: Sequence[object], remarks: Mapping[str, Sequence[str]]
) -> list[Entry]:
    """Return one entry per model of a board, in any order.

    The key of the board is for the addresses of pages; remarks are doubts about records by identity
    (:func:`leaderboards.audit.remarks`), kept as notes.
    """
    groups: dict[tuple[object, ...], list[ResultRecord]] = defaultdict(list)
    copies: dict[tuple[object, ...], int] = defaultdict(int)
    # Of the same model and seed the newest is the entry's; older ones stay visible, but push no other model back.
    for record in sorted(records, key=lambda record: (moment(record), record.identity), reverse=True):
        kind, seed = _kind(record), record.card.seed if record.card else None
        copy = copies[*kind, seed]
        copies[*kind, seed] += 1
        groups[*kind, copy].append(record)
    return [_entry(key, found, board, remarks) for key, found in groups.items()]


def moment(record: ResultRecord) -> datetime:
    """Return when a record was made: machines state it in zones of their own. What states no time is the oldest."""
    try:
        stated = datetime.fromisoformat(record.score.provenance.time)
        return stated.astimezone(UTC) if stated.tzinfo else stated.replace(tzinfo=UTC)
    except (ValueError, OverflowError):
        return datetime.min.replace(tzinfo=UTC)


def twins(entries: Sequence[Entry]) -> dict[str, Entry]:
    """Return the untrained entries by the architecture's name."""
    return {entry.architecture: entry for entry in reversed(entries) if not entry.trained}


def same_computation(left: Entry, right: Entry) -> bool:
    """Return whether the chosen layers of two entries are one computation, seed by seed.

    Their RDMs are equal up to a factor and every animal has the same score: variants that share an encoder, copies of
    a layer, activations in other units.
    """
    pairs = zip(left.records, right.records, strict=False)
    return left.seeds == right.seeds and all(_same_score(a.score, b.score) for a, b in pairs)


def _same_score(left: Score, right: Score) -> bool:
    values = ([item.value for item in score.subjects] for score in (left, right))
    rdms = [np.array(score.model_rdm, dtype=np.float64) for score in (left, right)]
    if not len(rdms[0]) or len(rdms[0]) != len(rdms[1]) or len(left.subjects) != len(right.subjects):
        return False
    scales = [float(np.linalg.norm(rdm[np.isfinite(rdm)])) or 1.0 for rdm in rdms]
    return all(
        np.allclose(a, b, rtol=0, atol=_SAME, equal_nan=True)
        for a, b in (tuple(values), [rdm / scale for rdm, scale in zip(rdms, scales, strict=True)])
    )


def _kind(record: ResultRecord) -> tuple[object, ...]:
    card = record.card
    if card is None or card.seed is None:  # nobody can know what else differs
        return (record.score.name, card.weights if card else None, record.identity if card is None else None)
    settings = unusual_settings(record.score.provenance.settings)
    rest = (str(settings),) if settings else ()
    # The name of somebody's file or folder says little: what stands there now may be another network.
    rest += (card.parameters,) if not_repeatable(record) else ()
    return (record.score.name, card.objective, card.augmentation, str(card.training.get("masking")), *rest)


def _entry(
    key: tuple[object, ...], records: list[ResultRecord], board: Sequence[object], remarks: Mapping[str, Sequence[str]]
) -> Entry:
    records = sorted(records, key=lambda record: ((record.card and record.card.seed) or 0, record.identity))
    page = f"{records[0].file_name.rpartition('--')[0]}--{content_hash([*map(str, (*board, *key))], length=10)}.html"
    notes = list(dict.fromkeys(note for record in records for note in remarks.get(record.identity, ())))
    if settings := unusual_settings(records[0].score.provenance.settings):
        notes.append(f"scored with {', '.join(f'{name} {value}' for name, value in settings.items())}")
    earlier = "an earlier record of a model, which its newest one stands for" if key[-1] else ""
    return Entry(tuple(records), page, tuple(notes), unranked_because=earlier)
