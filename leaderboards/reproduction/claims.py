"""The claims of the published study, each judged on a campaign by the rule of :func:`contrasts.judge`.

What a claim compares stands in :mod:`comparisons` under the key that it has in ``published.json``, where its words,
direction, margin and published number are. The same comparisons made of the published accuracies give the published
effect.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import combinations

import msgspec
import numpy as np

from brainbench.core.statistics import wilson_interval
from leaderboards.boards import Board
from leaderboards.figures.scatter import regression
from leaderboards.ranking import lacking
from leaderboards.reproduction import measures
from leaderboards.reproduction.campaign import Campaign, NetworkKey
from leaderboards.reproduction.comparisons import COMPARISONS, each
from leaderboards.reproduction.contrasts import Effect, Verdict, contrast, judge
from leaderboards.reproduction.measures import Measured

SYNTHETIC_REASON = "the animals are synthetic"
FIT_MEASURES = ("fit", "accuracy-fit", "parameters-fit", "layers", "blocks")
GOAL = 0.8
"""Kendall's τ that the rankings of two seeds should reach."""


@dataclass(frozen=True)
class PublishedClaim:
    """One claim of the study, as ``published.json`` states it."""

    key: str
    claim: str
    measure: str
    """``accuracy``, ``fit``, or the name of a measure that one claim alone uses; ``none`` where records cannot say."""
    direction: int
    """1 and −1: the effect lies above or below the neutral value; 0: it is within the margin."""
    published: str
    source: str
    margin: float = 0.0
    neutral: float = 0.0
    paired: bool = False
    """Differences are taken seed by seed: both networks begin from the same initial state."""
    reason: str = ""
    """Why records cannot test it; empty where they can."""


@dataclass(frozen=True)
class Judgement:
    """A claim with what a campaign says of it."""

    claim: PublishedClaim
    effect: Effect | None
    verdict: Verdict
    rule: Verdict
    """Verdict of the rule, which differs from ``verdict`` where the animals are synthetic."""
    reason: str = ""
    published_effect: Effect | None = None


def published_claims() -> list[PublishedClaim]:
    """Return the claims in the order of the study."""
    return msgspec.convert(measures.published()["claims"], list[PublishedClaim])


def judge_accuracy(campaign: Campaign) -> list[Judgement]:
    """Judge the claims on accuracy and training, and those that no record can test."""
    ours, theirs = measures.accuracies(campaign), measures.published_accuracy()
    found = []
    for claim in published_claims():
        effect = other = None
        if claim.measure == "accuracy":
            effect, other = _compare(claim, ours), _compare(claim, theirs)
        elif claim.measure == "parameters-accuracy":
            effect = _correlate(measures.parameters(campaign), ours, "supervised")
            other = _correlate(measures.published_parameters(), theirs, "supervised")
        elif claim.measure == "divergence":
            effect = _divergence(campaign)
        elif claim.measure != "none":
            continue
        verdict = _untestable if claim.measure == "none" else _judged(claim, effect)
        found.append(Judgement(claim, effect, verdict, verdict, claim.reason or _unknown(effect), other))
    return found


def judge_fit(campaign: Campaign, place: int) -> list[Judgement]:
    """Judge the claims on neural fit on one board; without any board all are of networks not trained yet."""
    claims = [claim for claim in published_claims() if claim.measure in FIT_MEASURES]
    if not campaign.boards:
        return [Judgement(claim, None, "not trained yet", "not trained yet") for claim in claims]
    board, fit = campaign.boards[place], measures.fits(campaign, place)
    lacks = lacks_of(board)
    accuracy = {key: item.value for key, item in measures.accuracies(campaign).networks.items()}
    measured: dict[str, Callable[[PublishedClaim], Effect | None]] = {
        "fit": lambda claim: _compare(claim, fit),
        "accuracy-fit": lambda claim: _correlate(accuracy, fit, "supervised"),
        "parameters-fit": lambda claim: _correlate(measures.parameters(campaign, place), fit, None),
        "layers": lambda claim: _compare(claim, measures.layer_orders(campaign, place)),
        "blocks": lambda claim: _compare(claim, measures.layer_orders(campaign, place, "attender.block")),
    }
    found = []
    for claim in claims:
        effect = measured[claim.measure](claim)
        rule, reason = _judged(claim, effect), _unknown(effect)
        if lacks and effect is not None:
            rule, reason = "undecided", f"the rule needs {lacks}"
        verdict = rule
        if board.synthetic and effect is not None:
            verdict, reason = _untestable, "; ".join(filter(None, (SYNTHETIC_REASON, reason)))
        found.append(Judgement(claim, effect, verdict, rule, reason))
    return found


def lacks_of(board: Board) -> str:
    """Return what a board lacks for the rule to decide anything, in words; empty when nothing."""
    return lacking(max((len(entry.score.subjects) for entry in board.entries), default=0), len(board.conditions))


_untestable: Verdict = "cannot be tested here"


def _judged(claim: PublishedClaim, effect: Effect | None) -> Verdict:
    return judge(effect, claim.direction, margin=claim.margin, neutral=claim.neutral)


def seed_agreement(measured: Measured, objective: str | None = None) -> list[tuple[int, int, int, float]]:
    """Return (seed, seed, networks, Kendall's τ) of the rankings by every two seeds that share three networks."""
    from scipy.stats import kendalltau

    items = [item.seeds for item in measured.find(objective=objective).values() if len(item.seeds) > 1]
    found = []
    for one, other in combinations(sorted({seed for seeds in items for seed in seeds}), 2):
        pairs = [(seeds[one], seeds[other]) for seeds in items if one in seeds and other in seeds]
        if len(pairs) > 2:
            found.append((one, other, len(pairs), float(np.array(kendalltau(*zip(*pairs, strict=True)))[0])))
    return found


def _unknown(effect: Effect | None) -> str:
    if effect is None or effect.interval is not None:
        return ""
    return "no interval, with fewer than three comparisons and one seed of each network"


def _compare(claim: PublishedClaim, measured: Measured) -> Effect | None:
    """Return the effect of a claim that compares networks, or is about each of them."""
    comparisons, detail, level = COMPARISONS.get(claim.key, each(None, None))(measured)
    return contrast(comparisons, measured.networks.values(), paired=claim.paired, level=level, detail=detail)


def _correlate(x: Mapping[NetworkKey, float], measured: Measured, objective: str | None) -> Effect | None:
    """Return Pearson's r over networks with Fisher's interval; None below four networks or of constant values."""
    points = [(x[key], item.value) for key, item in measured.find(objective=objective).items() if key in x]
    if len(points) < 4:
        return None
    _, _, r, interval = regression(*(list(values) for values in zip(*points, strict=True)))
    return None if math.isnan(r) else Effect(r, interval, len(points), 0, f"{len(points)} networks")


def _divergence(campaign: Campaign) -> Effect | None:
    """Return the share of trainings with S4 that diverged."""
    lines = [item for item in campaign.trainings if item.objective != "untrained" and item.model.startswith("s4")]
    if not lines:
        return None
    count = sum(item.status == "diverged" for item in lines)
    interval = wilson_interval(count, len(lines), over="trainings")
    return Effect(count / len(lines), interval, len(lines), count, f"{count} of {len(lines)} trainings")
