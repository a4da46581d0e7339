"""A board of groups of units: one score for each group, ranks, and the one that is told apart above all others.

Every group is scored like the whole recordings, with the same stimuli, layers and permutations, and each chooses its
layer for itself. Scores are corrected for the noise of their units, so groups of different sizes can be compared. Two
groups are tested by the differences of the animals that have both, and by stimuli, as two models are
(:func:`brainbench.core.statistics.compare_scores`). All p are corrected for the number of groups or pairs (Holm 1979).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from brainbench.core.errors import listing
from brainbench.core.files import to_plain
from brainbench.core.progress import Progress, track
from brainbench.core.records import Interval, Score
from brainbench.core.statistics import PairTest, compare_scores
from brainbench.metrics.inference.multiple import adjust
from brainbench.scoring.scores import ScoreInputs, doubted

LEVEL = 0.05  # largest corrected p of a group that is named, against chance and against each other group


@dataclass(frozen=True)
class GroupScore:
    """One group of units."""

    group: str
    scaled: float
    """Score on the scale of all metrics: 0 is chance, 1 all that is reliable."""
    interval: Interval | None
    p: float
    p_corrected: float
    """Corrected for the number of groups."""
    status: str
    reasons: tuple[str, ...]
    layer: str | None
    units: int
    animals: int
    rank: str
    """Best and worst rank that the tests leave open; empty for a group that is not ranked."""


@dataclass(frozen=True)
class GroupBoard:
    """The groups of one column, the best score first."""

    by: str
    groups: tuple[GroupScore, ...]
    pairs: tuple[PairTest, ...]
    best: str
    """Group told apart above chance and above every other that can be judged; empty where none is."""
    reason: str
    """Reason why it is, or why none is."""


def score_groups(
    metric: Any,
    features: Mapping[str, Any],
    animals: Mapping[str, Sequence[Any]],
    *,
    by: str,
    stimuli: Sequence[str],
    doubts: Sequence[str] = (),
    **options: Any,
) -> GroupBoard:
    """Score the layers of a model against each group of units, and rank the groups.

    ``features`` are [K, F] by layer, ``animals`` what :meth:`Metric.animal` made of each group's units, by group;
    options are those of :meth:`Metric.score`. With ``doubts`` of the recordings no group can be judged.
    """
    scores = {
        name: doubted(metric.score(features, members, name=name, stimuli=stimuli, **options), *doubts)
        for name, members in animals.items()
    }
    order = sorted(scores, key=lambda name: -scores[name].scaled if math.isfinite(scores[name].scaled) else math.inf)
    judged = [name for name in order if scores[name].status == "ok" and math.isfinite(scores[name].scaled)]
    pairs = [compare_scores(scores[left], scores[right]) for left, right in itertools.combinations(judged, 2)]
    corrected = adjust([pair.p for pair in pairs], "holm").tolist()
    pairs = [replace(pair, p_corrected=p) for pair, p in zip(pairs, corrected, strict=True)]
    p_of = dict(zip(order, adjust([scores[name].p for name in order], "holm").tolist(), strict=True))
    above = [(pair.first, pair.second) for pair in pairs if pair.p_corrected <= LEVEL and pair.difference > 0]
    above += [(pair.second, pair.first) for pair in pairs if pair.p_corrected <= LEVEL and pair.difference < 0]
    groups = []
    for name in order:
        score = scores[name]
        better, worse = (sum(pair[side] == name for pair in above) for side in (1, 0))
        units = sum(item.units for item in score.subjects)
        number = sum(item.status != "undefined" for item in score.subjects)
        ranks = dict.fromkeys((1 + better, len(judged) - worse)) if name in judged else ()
        stated = (score.scaled, score.scaled_interval, score.p, p_of[name], score.status, score.reasons, score.layer)
        groups.append(GroupScore(name, *stated, units, number, "–".join(map(str, ranks))))
    best, reason = _best(by, judged, order, p_of, pairs, above, scores)
    return GroupBoard(by, tuple(groups), tuple(pairs), best, reason)


def _best(
    by: str,
    judged: Sequence[str],
    order: Sequence[str],
    p_of: Mapping[str, float],
    pairs: Sequence[PairTest],
    above: Sequence[tuple[str, str]],
    scores: Mapping[str, Score],
) -> tuple[str, str]:
    """Return the group that is told apart above chance and all others, and the reason in words."""
    doubtful = [name for name in order if name not in judged]
    beside = f"; {listing(doubtful, limit=4)} cannot be judged" if doubtful else ""
    if not judged:
        return "", f"no {by} can be judged: {'; '.join(scores[order[0]].reasons[:1]) if order else 'none has units'}"
    first, *others = judged
    if not p_of[first] <= LEVEL:
        return "", f"no {by} is told apart from chance{beside}"
    equal = [name for name in others if (first, name) not in above]
    if equal:
        untested = [pair.reason for pair in pairs if first in (pair.first, pair.second) and pair.reason]
        why = f" ({untested[0]})" if untested else ""
        return "", f"{first} scores best, and is not told apart from {listing(equal, limit=4)}{why}{beside}"
    if not others:
        return first, f"{first} alone can be judged, and is told apart from chance{beside}"
    return first, f"{first} is told apart above {listing(others, limit=4)} and above chance{beside}"


def add_groups(inputs: ScoreInputs, *, progress: Progress | None = None) -> dict[str, Any]:
    """Return what ``--by`` adds to the statistics of a record."""
    options, parts = inputs.options, inputs.brain.groups(str(inputs.options.by))
    animals = {}
    for name in track(list(parts), "groups of units", progress):
        animals[name] = parts[name].animals(inputs.labels, inputs.metric, options)
    how: dict[str, Any] = {"estimator": options.estimator, "seed": options.seed, "layer": inputs.network.card.layer}
    how |= {"by": str(options.by).partition("=")[0], "stimuli": inputs.labels, "doubts": inputs.doubts}
    board = score_groups(inputs.metric, inputs.features, animals, **how)
    values = inputs.brain.dataset[how["by"]].values.astype(str)
    if (unknown := int((values == "").sum())) and "=" not in str(options.by):
        reason = f"{board.reason}; {unknown} of {len(values)} units state no {board.by} and are in none"
        board = replace(board, reason=reason)
    return {"groups": to_plain(board)}
