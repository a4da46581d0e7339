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

from benchmarks.reproduction import measures
from benchmarks.reproduction.campaign import Campaign, NetworkKey
from benchmarks.reproduction.comparisons import COMPARISONS, each
from benchmarks.reproduction.contrasts import Effect, Verdict, contrast, judge
from benchmarks.reproduction.measures import Measured
from brainbench.core.statistics import wilson_interval
from leaderboards.figures.charts import regression

_UNTESTABLE: Verdict = "cannot be tested here"


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

    def compare(self, measured: Measured) -> Effect | None:
        """Return the effect of a claim that compares networks, or is about each of them."""
        comparisons, detail, level = COMPARISONS.get(self.key, each(None, None))(measured)
        return contrast(comparisons, measured.networks.values(), paired=self.paired, level=level, detail=detail)

    def judge(self, effect: Effect | None) -> Verdict:
        """Return what the rule says of the claim."""
        return judge(effect, self.direction, margin=self.margin, neutral=self.neutral)


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
            effect, other = claim.compare(ours), claim.compare(theirs)
        elif claim.measure == "parameters-accuracy":
            effect = _correlate(measures.parameters(campaign), ours, "supervised")
            other = _correlate(measures.published_parameters(), theirs, "supervised")
        elif claim.measure == "divergence":
            effect = _divergence(campaign)
        elif claim.measure != "none":
            continue
        verdict = _UNTESTABLE if claim.measure == "none" else claim.judge(effect)
        found.append(Judgement(claim, effect, verdict, verdict, claim.reason, other))
    return found


def judge_fit(campaign: Campaign, place: int) -> list[Judgement]:
    """Judge the claims on neural fit on one board."""
    board, fit = campaign.boards[place], measures.fits(campaign, place)
    accuracy = {key: item.value for key, item in measures.accuracies(campaign).networks.items()}
    measured: dict[str, Callable[[PublishedClaim], Effect | None]] = {
        "fit": lambda claim: claim.compare(fit),
        "accuracy-fit": lambda _: _correlate(accuracy, fit, "supervised"),
        "parameters-fit": lambda _: _correlate(measures.parameters(campaign), fit, None),
        "layers": lambda claim: claim.compare(measures.layer_orders(campaign, place)),
        "blocks": lambda claim: claim.compare(measures.layer_orders(campaign, place, "attender.block")),
    }
    found = []
    for claim in (claim for claim in published_claims() if claim.measure in measured):
        effect = measured[claim.measure](claim)
        rule, reason = claim.judge(effect), ""
        if board.lacks and effect is not None:
            rule, reason = "undecided", f"the rule needs {board.lacks}"
        verdict = rule
        if board.synthetic and effect is not None:
            verdict, reason = _UNTESTABLE, "; ".join(filter(None, ("the animals are synthetic", reason)))
        found.append(Judgement(claim, effect, verdict, rule, reason))
    return found


def seed_agreement(measured: Measured) -> list[tuple[int, int, int, float]]:
    """Return (seed, seed, networks, Kendall's τ) of the rankings of supervised networks by every two seeds.

    Seeds that share fewer than three networks are left out.
    """
    from scipy.stats import kendalltau

    items = [item.seeds for item in measured.find(objective="supervised").values() if len(item.seeds) > 1]
    found = []
    for one, other in combinations(sorted({seed for seeds in items for seed in seeds}), 2):
        pairs = [(seeds[one], seeds[other]) for seeds in items if one in seeds and other in seeds]
        if len(pairs) > 2:
            found.append((one, other, len(pairs), float(np.array(kendalltau(*zip(*pairs, strict=True)))[0])))
    return found


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
