"""Means over benchmarks: what a model scores on all benchmarks of a set of boards, with interval and rank.

The benchmarks are those that the records name, and the mean is over exactly these. Errors over animals and stimuli add
up in squares where benchmarks share no animal; where they do, and where a model has several seeds, which it has on
every benchmark, they add up as if they always erred alike: the interval is then too wide rather than too narrow.
"""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from brainbench.core.contracts import natural_key
from brainbench.core.files import content_hash
from brainbench.core.identity import unusual_settings
from brainbench.core.records import Interval
from brainbench.core.statistics import LEVEL
from leaderboards.boards import Board
from leaderboards.entries import Entry
from leaderboards.ranking import apart, differences, rank_in_print, rank_ranges
from leaderboards.text import number, plural, span


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
