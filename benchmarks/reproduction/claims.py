"""The claims of the published study, each judged on a campaign by the rule of :func:`contrasts.judge`.

A verdict must pass three tests beyond its own interval. Claims that are judged together are corrected for their number
(false discovery rate of 5 %: the intervals that decide have the level of Benjamini and Yekutieli's selected intervals,
doi:10.1198/016214504000001907). It must be the same without each network that others could stand in for. And what
correlates over networks is compared within families, since families differ in much else.

What a claim compares stands in :mod:`comparisons` under the key that it has in ``published.json``, where its words,
direction, margin and published number are. The same comparisons made of the published accuracies give the published
effect.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import msgspec
import numpy as np

from benchmarks.reproduction import measures
from benchmarks.reproduction.campaign import Campaign, NetworkKey
from benchmarks.reproduction.comparisons import COMPARISONS, each
from benchmarks.reproduction.contrasts import Effect, Verdict, contrast, judge
from benchmarks.reproduction.measures import Measured
from brainbench.core.records import Interval
from brainbench.core.statistics import LEVEL, wilson_interval
from leaderboards.text import number

ERROR = 1 - LEVEL
"""Share of intervals that may miss the truth."""
_DECIDED = ("holds", "does not hold")
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

    def compare(self, measured: Measured, error: float = ERROR) -> Effect | None:
        """Return the effect of a claim that compares networks, or is about each of them; the interval errs so often."""
        comparisons, detail, level = COMPARISONS.get(self.key, each(None, None))(measured)
        level = 1 - error * (1 - level) / (1 - LEVEL)
        return contrast(comparisons, measured.networks.values(), paired=self.paired, level=level, detail=detail)

    def judge(self, effect: Effect | None) -> Verdict:
        """Return what the rule says of the claim."""
        return judge(effect, self.direction, margin=self.margin, neutral=self.neutral)


@dataclass(frozen=True)
class TestedClaim:
    """A claim, and the effect that a set of networks gives it."""

    claim: PublishedClaim
    effect: Callable[[Measured, float], Effect | None]
    """Of measured networks, and the share of intervals that may miss the truth."""
    measured: Measured
    published_effect: Effect | None = None

    def verdict(self, error: float) -> Verdict:
        """Return what the rule says at a level of error."""
        return self.claim.judge(self.effect(self.measured, error))

    def alone(self, error: float) -> tuple[str, str]:
        """Return what is left of the effect without its strongest network, and without one that the verdict rests on.

        It rests on one where it changes both by the interval of the rest and by that of all networks, moved: neither
        fewer comparisons nor the spread that the network itself makes is a reason. A network that a claim names, and
        without which there is nothing to compare, stands for itself.
        """
        whole = self.effect(self.measured, error)
        if whole is None:
            return "", ""
        verdict, span, left, rests = self.claim.judge(whole), whole.interval, [], ""
        above = math.copysign(1.0, whole.value - self.claim.neutral)
        for key in self.measured.networks:
            effect = self.effect(self._without(key), error)
            if effect is None or effect.value == whole.value:
                continue
            shift = effect.value - whole.value
            text = f"{number(effect.value)} without {key.name}"
            left.append((above * shift, text))
            moved = None if span is None else replace(span, low=span.low + shift, high=span.high + shift)
            verdicts = {self.claim.judge(effect), self.claim.judge(replace(effect, interval=moved))}
            if verdict in _DECIDED and verdict not in verdicts:
                rests = text
        return min(left, default=(0.0, ""))[1], rests

    def _without(self, key: NetworkKey) -> Measured:
        networks = {other: item for other, item in self.measured.networks.items() if other != key}
        return replace(self.measured, networks=networks)


def allowed_error(tests: Sequence[TestedClaim]) -> float:
    """Return the share of errors that each decided claim is allowed, so that 5 % of the decided ones are false.

    The step-up rule of Benjamini and Hochberg: the largest number of claims that are decided at that number's share.
    """
    count = wanted = len(tests)
    while wanted:
        error = ERROR * wanted / count
        decided = sum(test.verdict(error) in _DECIDED for test in tests)
        if decided >= wanted:
            return error
        wanted = decided  # a larger number cannot do: fewer are decided at a smaller error
    return ERROR / max(count, 1)


def judged(test: TestedClaim, error: float) -> Judgement:
    """Return a claim with its effect, its interval of 95 %, and the verdict that it keeps."""
    verdict, reason = test.verdict(error), ""
    text, rests = test.alone(error)
    if rests:
        verdict, reason = "undecided", rests
    elif verdict == "undecided" and test.verdict(ERROR) != verdict:
        reason = f"decided alone, not among all claims (intervals of {1 - error:.1%})"
    effect = test.effect(test.measured, ERROR)
    if effect is not None:
        effect = replace(effect, detail="; ".join(filter(None, (effect.detail, text))))
    return Judgement(test.claim, effect, verdict, verdict, reason, test.published_effect)


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


def judge_accuracy(campaign: Campaign, error: float | None = None) -> list[Judgement]:
    """Judge the claims on accuracy and training.

    ``error`` is what :func:`allowed_error` gives for more claims than these.
    """
    tests = {test.claim.key: test for test in accuracy_tests(campaign)}
    error = allowed_error(list(tests.values())) if error is None else error
    return [judged(tests[claim.key], error) for claim in published_claims() if claim.key in tests]


def accuracy_tests(campaign: Campaign) -> list[TestedClaim]:
    """Return the claims on accuracy and training with their effects."""
    ours, theirs = measures.accuracies(campaign), measures.published_accuracy()
    sizes = measures.parameters(campaign)
    tests = []
    for claim in published_claims():
        if claim.measure == "accuracy":
            tests.append(TestedClaim(claim, claim.compare, ours, claim.compare(theirs)))
        elif claim.measure == "parameters-accuracy":
            other = _correlate(measures.published_parameters(), theirs, "supervised")
            tests.append(
                TestedClaim(claim, lambda some, error: _correlate(sizes, some, "supervised", error), ours, other)
            )
        elif claim.measure == "divergence":
            tests.append(TestedClaim(claim, lambda _, error: _divergence(campaign, error), Measured({})))
    return tests


def judge_fit(campaign: Campaign, place: int, error: float | None = None) -> list[Judgement]:
    """Judge the claims on neural fit on one board; ``error`` as for :func:`judge_accuracy`."""
    board, tests = campaign.boards[place], fit_tests(campaign, place)
    error = allowed_error(tests) if error is None else error
    judgements = []
    for test in tests:
        judgement = judged(test, error)
        if judgement.effect is not None and board.lacks:
            judgement = replace(
                judgement, rule="undecided", verdict="undecided", reason=f"the rule needs {board.lacks}"
            )
        if judgement.effect is not None and board.synthetic:
            reason = "; ".join(filter(None, ("the animals are synthetic", judgement.reason)))
            judgement = replace(judgement, verdict=_UNTESTABLE, reason=reason)
        judgements.append(judgement)
    return judgements


def fit_tests(campaign: Campaign, place: int) -> list[TestedClaim]:
    """Return the claims on neural fit on one board with their effects."""
    fit, sizes = measures.fits(campaign, place), measures.parameters(campaign)
    accuracy = {key: item.value for key, item in measures.accuracies(campaign).networks.items()}
    of_networks = {
        "fit": fit,
        "layers": measures.layer_orders(campaign, place),
        "blocks": measures.layer_orders(campaign, place, "attender.block"),
    }
    tests = []
    for claim in published_claims():
        if claim.measure in of_networks:
            tests.append(TestedClaim(claim, claim.compare, of_networks[claim.measure]))
        elif claim.measure == "accuracy-fit":
            tests.append(TestedClaim(claim, lambda some, error: _correlate(accuracy, some, "supervised", error), fit))
        elif claim.measure == "parameters-fit":
            tests.append(TestedClaim(claim, lambda some, error: _correlate(sizes, some, None, error), fit))
    return tests


def seed_agreement(measured: Measured, *, family: str = "") -> list[tuple[int, int, int, float]]:
    """Return (seed, seed, networks, Kendall's τ) of the rankings of supervised networks by every two seeds.

    Seeds that share fewer than three networks are left out; so are all but those of a ``family``, if one is named.
    """
    from scipy.stats import kendalltau

    networks = measured.find(objective="supervised").items()
    items = [item.seeds for key, item in networks if len(item.seeds) > 1 and family in ("", key.family)]
    found = []
    for one, other in combinations(sorted({seed for seeds in items for seed in seeds}), 2):
        pairs = [(seeds[one], seeds[other]) for seeds in items if one in seeds and other in seeds]
        if len(pairs) > 2:
            found.append((one, other, len(pairs), float(np.array(kendalltau(*zip(*pairs, strict=True)))[0])))
    return found


def _correlate(
    x: Mapping[NetworkKey, float], measured: Measured, objective: str | None, error: float = ERROR
) -> Effect | None:
    """Return Pearson's r over networks within their families, with Fisher's interval; None of too few networks.

    A family is a kind of encoder, trained by one objective. The means of families are taken away, each of which costs
    a degree of freedom; the r of all networks together stands beside it.
    """
    from scipy.special import ndtri

    families: dict[tuple[str, str], list[tuple[float, float]]] = defaultdict(list)
    for key, item in measured.find(objective=objective).items():
        if key in x:
            families[key.family, key.objective].append((x[key], item.value))
    groups = [np.array(points) for points in families.values() if len(points) > 1]
    freedom = sum(map(len, groups)) - len(groups) - 2
    if freedom < 1:
        return None
    within = _pearson(np.concatenate([points - points.mean(axis=0) for points in groups]))
    if math.isnan(within):
        return None
    interval = None
    if abs(within) < 1:
        half = float(ndtri(1 - error / 2)) / math.sqrt(freedom)
        low, high = (math.tanh(math.atanh(within) + sign * half) for sign in (-1, 1))
        interval = Interval(low, high, 1 - error, "Fisher's z within families")
    together = [
        f"{number(_pearson(points), 2)} of {len(points)} {name[0]}" for name, points in _large(families, objective)
    ]
    whole = f"{number(_pearson(np.concatenate(groups)), 2)} of all {sum(map(len, groups))} networks together"
    return Effect(within, interval, sum(map(len, groups)), 0, "; ".join(["within families", *together, whole]))


def _large(
    families: Mapping[tuple[str, str], Sequence[tuple[float, float]]], objective: str | None
) -> list[tuple[tuple[str, str], np.ndarray]]:
    """Return the families of one objective that have an r of their own."""
    return [(name, np.array(points)) for name, points in families.items() if objective and len(points) > 3]


def _pearson(points: np.ndarray) -> float:
    """Return r of points [N, 2]; NaN where either is constant."""
    left, right = (points - points.mean(axis=0)).T
    norms = float((left @ left) * (right @ right))
    return float(left @ right) / math.sqrt(norms) if norms > 1e-24 else math.nan


def _divergence(campaign: Campaign, error: float) -> Effect | None:
    """Return the share of trainings with S4 that diverged."""
    lines = [item for item in campaign.trainings if item.objective != "untrained" and item.model.startswith("s4")]
    if not lines:
        return None
    count = sum(item.status == "diverged" for item in lines)
    interval = wilson_interval(count, len(lines), over="trainings", level=1 - error)
    return Effect(count / len(lines), interval, len(lines), count, f"{count} of {len(lines)} trainings")
