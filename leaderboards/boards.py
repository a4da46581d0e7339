"""Boards of comparable scores, each with its entries in the order in which people read them, and what they show.

Scores are comparable only within a **board**: same recordings and units, same stimuli paired alike, same estimator,
same metric, same use of the time axis. Models that are not told apart (:mod:`leaderboards.ranking`) are tied, so a rank
is a range. Not ranked are scores that are not reliable, models that nobody here can run again, and whole boards with
too few animals or stimuli.
"""

from __future__ import annotations

import math
from bisect import bisect, insort
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from operator import itemgetter
from typing import Any

from brainbench.core.errors import listing, visible_name
from brainbench.core.records import ResultRecord, Score
from leaderboards.entries import Entry, fold_seeds, same_computation
from leaderboards.ranking import DOUBTFUL, Sample, lacking, rank_ranges, told_apart
from leaderboards.text import number, plural, span

RAW_INPUT = "raw input"  # name of the baseline that a model must be told apart from
MOST_CITED = 8  # works that a board names; anyone may write records
NO_SCALE = "its record states neither chance nor the scores without single stimuli; score the model again"


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
    truth: str
    """Name of the network that made synthetic recordings; empty where none is stated."""
    entries: tuple[Entry, ...]
    baselines: tuple[Baseline, ...] = field(default=())
    benchmark: str = ""
    """Name of the benchmark that most of its records state; empty where none does."""
    citations: tuple[str, ...] = ()
    """Works that recordings and benchmark ask to cite."""
    lacks: str = ""
    """Lack that forbids ranks, in words; empty when models can be told apart."""

    @property
    def ranked(self) -> tuple[Entry, ...]:
        """Entries with a rank; none where no two models are told apart."""
        return tuple(entry for entry in self.entries if entry.first is not None)

    @property
    def leader(self) -> Entry | None:
        """The entry with the highest score among those above chance that can be computed again."""
        able = [entry for entry in self.entries if entry.above_chance and not entry.unranked_because]
        return max(able, key=lambda entry: entry.scaled, default=None)


def rank(records: Iterable[ResultRecord], remarks: Mapping[str, Sequence[str]] | None = None) -> list[Board]:
    """Sort records into boards and rank the entries of each; the largest board comes first.

    Remarks are doubts about records by identity (:func:`leaderboards.audit.remarks`), kept as notes of entries.
    """
    groups: dict[tuple[Any, ...], list[ResultRecord]] = defaultdict(list)
    for record in records:
        score = record.score
        origin, estimator = score.provenance, score.estimator
        # Other units make other RDMs of the same recordings.
        if (least := origin.settings.get("units_reliability")) is not None:
            estimator += f", units of reliability {least} and more"
        if origin.pairing:
            estimator += f", labels paired otherwise ({origin.pairing})"
        brain, stimuli = origin.recordings_hash, origin.stimuli_hash
        groups[brain, stimuli, score.stimuli, origin.time_rule, estimator, score.metric].append(record)
    boards = [_board(key, group, remarks or {}) for key, group in groups.items()]
    return sorted(boards, key=lambda board: (-len(board.entries), board.recordings, board.estimator, board.metric))


def _board(key: tuple[Any, ...], records: list[ResultRecord], remarks: Mapping[str, Sequence[str]]) -> Board:
    recordings_hash, stimuli_hash, conditions, time, estimator, metric = key
    baselines = tuple(_baselines(records))
    # Tests take reliable animals alone; without enough of them nothing is tested, which is not "not told apart".
    animals = max(sum(item.status == "ok" for item in record.score.subjects) for record in records)
    lacks = "records that say which recordings they used" if recordings_hash is None else ""
    lacks = lacks or lacking(animals, len(conditions))
    entries = _rank(fold_seeds(records, key, remarks), baselines, lacks)
    origins = [record.score.provenance for record in records]
    stated = [origin.benchmark_name for origin in origins if origin.benchmark_name]
    truths = [record.score.provenance.recordings.get("truth") for record in records]
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
        truth=next((truth for truth in truths if isinstance(truth, str)), ""),
        entries=tuple(sorted(entries, key=lambda entry: entry.order)),
        baselines=baselines,
        benchmark=visible_name(_most_common(stated)) if stated else "",
        citations=tuple(dict.fromkeys(work for origin in origins for work in origin.citations))[:MOST_CITED],
        lacks=lacks,
    )


def _rank(entries: list[Entry], baselines: Sequence[Baseline], lacks: str) -> list[Entry]:
    """Return the entries with their ranks, those of one computation with one rank."""
    candidates = [replace(entry, unranked_because=_unranked(entry, lacks)) for entry in entries]
    able = [entry for entry in candidates if not entry.unranked_because]
    groups: list[list[Entry]] = []
    places: list[tuple[float, int]] = []
    # The shortest name stands for a computation: an encoder before its variants with an attender.
    for entry in sorted(able, key=lambda entry: (len(entry.name), entry.name)):
        value, reach = entry.value, 1e-5 + 1e-8 * abs(entry.value)
        near = places[bisect(places, (value - reach, -1)) : bisect(places, (value + reach, len(groups)))]
        close = (groups[place] for number, place in sorted(near, key=itemgetter(1)) if _is_close(number, value))
        same = next((group for group in close if same_computation(group[0], entry)), None)
        if same is None:
            insort(places, (value, len(groups)))
            groups.append([entry])
        else:
            same.append(entry)
    samples = [group[0].sample for group in groups]
    raw = next((item.score for item in baselines if item.name == RAW_INPUT and math.isfinite(item.score.scaled)), None)
    above = told_apart([*samples, *([Sample.of([raw])] if raw is not None else [])])
    for place, group in enumerate(groups):
        above[:, place] &= group[0].above_chance
    count = len(groups)
    models = above[:count, :count]
    ranges: list[Any] = rank_ranges(models) if models.any() else [(None, None)] * count
    best = max(range(count), key=lambda i: (groups[i][0].above_chance, samples[i].value), default=0)
    ranked = [entry for entry in candidates if entry.unranked_because]
    for place, (group, (first, last)) in enumerate(zip(groups, ranges, strict=True)):
        flags = {"above_raw": raw is not None and bool(above[count, place]), "below_leader": bool(models[place, best])}
        for entry in group:
            copied = "" if entry is group[0] else group[0].name
            ranked.append(replace(entry, first=first, last=last, same_as=copied, **flags))
    return ranked


def _is_close(left: float, right: float) -> bool:
    return math.isclose(left, right, abs_tol=1e-5)


def _unranked(entry: Entry, lacks: str) -> str:
    """Return why an entry cannot be ranked, empty when it can."""
    if reason := entry.not_repeatable:
        return f"not repeatable here: {reason}"
    if entry.standing in DOUBTFUL:
        return entry.standing
    if lacks:
        return f"ranks need {lacks}"
    return "" if math.isfinite(entry.scaled) and len(entry.sample.without_stimulus) else NO_SCALE


def _outcome(score: Score) -> tuple[str, float | None]:
    """Status and value to nine digits: sums on other machines, or by more threads, end in other last digits."""
    return score.status, None if math.isnan(score.value) else round(score.value, 9)


def _baselines(records: list[ResultRecord]) -> list[Baseline]:
    """Take each baseline once; records of one board should agree on it, and a note says when they do not."""
    stated: dict[tuple[str, str], list[Score]] = defaultdict(list)
    for record in records:
        if record.animal_to_animal is not None:
            stated["animals", "animal-to-animal"].append(record.animal_to_animal)
        for name, score in record.baselines.items():
            stated["baseline", name].append(score)
    baselines = []
    for (kind, name), scores in stated.items():
        counts = Counter(map(_outcome, scores))
        common = counts.most_common(1)[0][0]
        score = next(score for score in scores if _outcome(score) == common)
        values = [value for _, value in counts if value is not None]
        span = f" from {min(values):.3f} to {max(values):.3f}" if values else ""
        note = f"the records disagree: {len(counts)} different values{span}; shown is that of {counts[common]} of "
        baselines.append(Baseline(name, score, kind, (f"{note}{len(scores)} records",) if len(counts) > 1 else ()))
    return baselines


def _most_common(names: Iterable[str]) -> str:
    return Counter(names).most_common(1)[0][0]


def conclusions(board: Board) -> list[str]:
    """Return one sentence or two per conclusion, the most important first."""
    here = [entry for entry in board.entries if not entry.not_repeatable]
    tested = [entry for entry in here if not entry.unranked_because]
    sentences = _leader(board, tested)
    if board.truth:
        sentences.append(_truth(board, tested))
    if tested and any(item.name == RAW_INPUT for item in board.baselines):
        above = [entry for entry in tested if entry.above_raw]
        who = f": {_names(above)}" if above else ""
        sentences.append(f"Told apart above {RAW_INPUT}: {len(above)} of {plural(len(tested), 'model')}{who}.")
    if chance := sum(entry.standing == "not told apart from chance" for entry in here):
        sentences.append(f"Not told apart from chance: {chance} of {plural(len(here), 'model')}.")
    if apart := len(board.entries) - len(here):
        sentences.append(
            f"Standing apart because nobody here can compute them again: {plural(apart, 'entry', 'entries')}."
        )
    return sentences


def _leader(board: Board, tested: Sequence[Entry]) -> list[str]:
    leader = board.leader
    if board.lacks:
        return [f"Models cannot be ranked on this board: ranks need {board.lacks}."]
    if leader is None:
        few = "no score is both reliable and told apart from chance" if tested else "no entry states what ranks need"
        return [f"No model leads this board: {few}."]
    others = [entry for entry in tested if _computation(entry) != _computation(leader)]
    level = [entry for entry in others if not entry.below_leader]
    text = f"Highest score: {leader.name}, {number(leader.scaled)} {span(leader.interval)}".rstrip() + "."
    if not others:
        return [text]
    if not level:
        return [f"{text} It is told apart from the {plural(len(others), 'other model')}."]
    if len(level) == len(others):
        return [f"{text} It is not told apart from any other model."]
    apart = len(others) - len(level)
    return [f"{text} It is told apart from {apart} of {len(others)} others, but not from {_names(level)}."]


def _truth(board: Board, tested: Sequence[Entry]) -> str:
    """Say whether the network that made the recordings is where it must be."""
    origin = f"These recordings were made by {board.truth}"
    hidden = next((entry for entry in tested if entry.name == board.truth), None)
    leader = board.leader
    if hidden is None or leader is None:
        listed = any(entry.name == board.truth for entry in board.entries)
        return f"{origin}, which is {'on this board without a rank' if listed else 'not on this board'}."
    if _computation(leader) == _computation(hidden):
        return f"{origin}: the hidden network was found, it has the highest score."
    if not hidden.below_leader:
        return f"{origin}: it is among those that are not told apart from the highest score."
    return f"{origin}: the hidden network was not found, its rank is {hidden.rank}."


def _computation(entry: Entry) -> str:
    """Return one name for all entries of a computation."""
    return entry.same_as or entry.name


def _names(entries: Sequence[Entry]) -> str:
    return listing((entry.name for entry in entries), limit=4, quoted=False)
