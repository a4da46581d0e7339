"""Boards of comparable scores, each with its entries in the order in which people read them, and what they show.

Scores are comparable only within a **board**: same recordings and units, same stimuli paired alike, same estimator,
same metric, same use of the time axis. Models that are not told apart (:mod:`leaderboards.ranking`) are tied, so a rank
is a range. Not ranked are scores that are not reliable, models that nobody here can run again, and whole boards with
too few animals or stimuli.

Means over benchmarks are over exactly those that the records name. Errors over animals and stimuli add up in squares
where benchmarks share no animal; where they do, and where a model has several seeds, which it has on every benchmark,
they add up as if they always erred alike: the interval is then too wide rather than too narrow.
"""

from __future__ import annotations

import math
import re
from bisect import bisect, insort
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from operator import itemgetter
from typing import Any

import numpy as np

from brainbench.core.contracts import natural_key
from brainbench.core.errors import listing, visible_name
from brainbench.core.files import content_hash
from brainbench.core.identity import unusual_settings
from brainbench.core.records import ESTIMATOR_VERSION, Interval, ResultRecord, Score
from brainbench.core.statistics import LEVEL
from leaderboards import ranking
from leaderboards.entries import TOLERANCE, Entry, fold_seeds, moment, same_computation
from leaderboards.ranking import DOUBTFUL, Sample, apart, differences, lacking, rank_in_print, rank_ranges, told_apart
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
    # The newest first, whatever folders they came from: of two values of a baseline that are as common it is shown.
    for record in sorted(records, key=lambda record: (moment(record), record.identity), reverse=True):
        score = record.score
        origin, estimator = score.provenance, score.estimator
        # Other units make other RDMs of the same recordings.
        if (least := origin.settings.get("units_reliability")) is not None:
            estimator += f", units of reliability {least} and more"
        version = origin.settings.get("estimator_version")
        if score.estimator == "default" and version not in (None, ESTIMATOR_VERSION):
            estimator += f", version {version}"
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
        close = (groups[place] for _, place in sorted(near, key=itemgetter(1)))
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


def _unranked(entry: Entry, lacks: str) -> str:
    """Return why an entry cannot be ranked, empty when it can."""
    if reason := entry.not_repeatable:
        return f"not repeatable here: {reason}"
    if entry.standing in DOUBTFUL:
        return entry.standing
    if lacks:
        return f"ranks need {lacks}"
    scaled = math.isfinite(entry.scaled) and len(entry.sample.without_stimulus)
    return entry.unranked_because or ("" if scaled else NO_SCALE)


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
        differ = len({status for status, _ in counts}) > 1 or np.ptp(values or [0.0]) > TOLERANCE
        span = f" from {min(values):.3f} to {max(values):.3f}" if values else ""
        note = f"the records disagree: {len(counts)} different values{span}; shown is that of {counts[common]} of "
        baselines.append(Baseline(name, score, kind, (f"{note}{len(scores)} records",) if differ else ()))
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
        passing = ranking.CHANCE_LEVEL * len(here)
        alone = f" Each is tested alone: about {passing:.0f} of as many unrelated ones pass." if passing >= 1 else ""
        sentences.append(f"Not told apart from chance: {chance} of {plural(len(here), 'model')}.{alone}")
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


@dataclass(frozen=True)
class Mean:
    """One model over all benchmarks."""

    name: str
    scores: Mapping[str, float]
    """Benchmark → score between chance (0) and all that is reliable (1); those that it was scored on."""
    value: float = math.nan
    """Mean over the benchmarks; NaN where it misses one."""
    interval: Interval | None = None
    first: int | None = None
    """Best rank that the tests leave open; None when it is not ranked."""
    last: int | None = None
    unranked_because: str = ""

    @property
    def rank(self) -> str:
        """The rank in print."""
        return rank_in_print(self.first, self.last)


_EDITION = ("benchmark", "recordings_hash", "metric", "estimator", "time", "conditions")
"""What one benchmark has in common, beside its stimuli."""


def means_over(boards: Iterable[Board]) -> tuple[tuple[str, ...], list[Mean]]:
    """Return the benchmarks of boards, and every model over them, the highest mean first; nothing for fewer than two.

    A model that misses a benchmark, or has no rank on one, is not ranked; nor is any where no two are told apart.
    """
    groups: dict[tuple[Any, ...], list[Board]] = defaultdict(list)
    for board in sorted((board for board in boards if board.benchmark), key=lambda board: board.stimuli_hash is None):
        edition = tuple(getattr(board, name) for name in _EDITION)
        # Features that were computed elsewhere have a board of their own, since they name no stimuli.
        stimuli = board.stimuli_hash or next((key[-1] for key in groups if key[:-1] == edition), None)
        groups[*edition, stimuli].append(board)
    groups = dict(sorted(groups.items(), key=lambda pair: natural_key(str(pair[0]))))
    names = _labels([*groups])
    if len(names) < 2:
        return (), []
    models: dict[tuple[str, str], dict[str, Entry]] = defaultdict(dict)
    for label, group in zip(names, groups.values(), strict=True):
        for entry in sorted((entry for board in group for entry in board.entries), key=_age):
            models[entry.name, str(unusual_settings(entry.score.provenance.settings))][label] = entry
    means = [_mean(name, entries, names) for (name, _), entries in models.items()]
    able = [pair for pair in zip(means, models.values(), strict=True) if not pair[0].unranked_because]
    ranks = _ranks([[entries[label] for label in names] for _, entries in able]) if able else []
    ranked = [replace(mean, first=first, last=last) for (mean, _), (first, last) in zip(able, ranks, strict=True)]
    rest = [mean for mean in means if mean.unranked_because]
    return names, sorted([*ranked, *rest], key=lambda mean: (math.isnan(mean.value), -mean.value, mean.name))


def _labels(keys: Sequence[tuple[Any, ...]]) -> tuple[str, ...]:
    """Return a name for each benchmark; those of one name are told apart by all in which they differ."""
    labels = []
    for name, *rest in keys:
        columns = zip(*(rival[1:] for rival in keys if rival[0] == name), strict=True)
        parts = [_short(part) for part, column in zip(rest, columns, strict=True) if len({*column}) > 1]
        labels.append(f"{name} ({', '.join(parts)})" if parts else name)
    return tuple(labels)


def _short(part: Any) -> str:
    text = f"{len(part)} labels {content_hash(part)}" if isinstance(part, tuple) else part or "not stated"
    return re.sub(r"\b([0-9a-f]{6})[0-9a-f]{8,}\b", r"\1", text)


def _age(entry: Entry) -> tuple[bool, str]:
    """Return what sorts the entries of one model so that the one that counts is the last: repeatable, newest."""
    return not entry.unranked_because, max(record.score.provenance.time for record in entry.records)


def _mean(name: str, entries: dict[str, Entry], names: Sequence[str]) -> Mean:
    scores = {label: entries[label].scaled for label in names if label in entries}
    if missing := [label for label in names if not math.isfinite(scores.get(label, math.nan))]:
        return Mean(name, scores, unranked_because=f"no score on {', '.join(missing)}")
    from scipy.special import stdtrit

    row = [entries[label] for label in names]
    value = math.fsum(scores.values()) / len(names)
    error, freedom = (float(part) for part in _combined([entry.sample.error for entry in row], dependent(row)))
    reasons = (f"{label}: {reason}" for label, entry in entries.items() if (reason := entry.unranked_because))
    unranked = next(reasons, "")
    half = float(stdtrit(freedom, (1 + LEVEL) / 2) * error)
    method = f"t over animals and stimuli of {len(names)} benchmarks"
    interval = Interval(value - half, value + half, LEVEL, method) if math.isfinite(error) else None
    return Mean(name, scores, value, interval, unranked_because=unranked)


def dependent(entries: Sequence[Entry]) -> list[list[int]]:
    """Return the benchmarks, by place, in groups whose errors may be alike: of shared animals, or of several seeds."""
    groups: list[tuple[set[str], list[int]]] = []
    for place, entry in enumerate(entries):
        animals = {subject.subject for record in entry.records for subject in record.score.subjects}
        places, others = [place], []
        for group in groups:
            if group[0] & animals or entry.seeds > 1:
                animals |= group[0]
                places += group[1]
            else:
                others.append(group)
        groups = [*others, (animals, places)]
    return [places for _, places in groups]


def _combined(errors: Sequence[Sequence[Any]], groups: Sequence[Sequence[int]]) -> tuple[Any, Any]:
    """Return the standard error of a mean and its degrees of freedom (Welch and Satterthwaite)."""
    variances = [np.square(sum(errors[place][0] for place in group)) for group in groups]
    freedoms = [np.min([errors[place][1] for place in group], axis=0) for group in groups]
    total = sum(variances)
    with np.errstate(invalid="ignore", divide="ignore"):
        spent = sum(variance**2 / freedom for variance, freedom in zip(variances, freedoms, strict=True))
        freedom = np.where(np.asarray(total) > 0, np.square(total) / spent, np.nan)
    return np.sqrt(total) / len(errors), freedom


def _ranks(models: Sequence[Sequence[Entry]]) -> list[tuple[int | None, int | None]]:
    """Return the best and the worst rank of each model by paired tests over all benchmarks."""
    tests = [differences([entries[place].sample for entries in models]) for place in range(len(models[0]))]
    groups = min(map(dependent, models), key=len)

    def row(place: int) -> tuple[Any, Any, Any]:
        """Return means over benchmarks of the differences, their standard errors and degrees of freedom."""
        parts = [test(place) for test in tests]
        return np.mean([part[0] for part in parts], axis=0), *_combined([part[1:] for part in parts], groups)

    above = apart(len(models), row)
    for place, entries in enumerate(models):
        above[:, place] &= any(entry.above_chance for entry in entries)
    return [*rank_ranges(above)] if above.any() else [(None, None)] * len(models)


def table_of(names: Sequence[str], means: Sequence[Mean]) -> tuple[str, tuple[str, ...], tuple[tuple[str, ...], ...]]:
    """Return what a table of means shows, in words, its columns and its rows, as texts."""
    rows = [
        (
            mean.name, mean.rank, "–" if math.isnan(mean.value) else number(mean.value), span(mean.interval),
            *(number(mean.scores[name]) if name in mean.scores else "–" for name in names),
            f"not ranked: {mean.unranked_because or 'not told apart from any other'}" if mean.first is None else "",
        )
        for mean in means
    ]  # fmt: skip
    caption = (
        f"Mean over {plural(len(names), 'benchmark')}, between chance (0) and all that is reliable (1), with its 95 % "
        "interval over animals and stimuli. Models are told apart by paired tests over all of them; one that misses a "
        "benchmark is not ranked."
    )
    return caption, ("model", "rank", "mean", "interval", *names, "standing"), tuple(rows)
