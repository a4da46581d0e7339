"""The claims of the published study, each judged on a campaign by the rule of :func:`contrasts.judge`.

What a claim compares stands here, under the key that it has in ``published.json``; its words, direction, margin and
published number stand there. The same comparisons made of the published accuracies give the published effect.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from itertools import combinations
from typing import Any

import numpy as np

from brainbench.core.statistics import LEVEL, wilson_interval
from leaderboards.figures.scatter import regression
from leaderboards.ranking import lacking
from leaderboards.reproduction.campaign import Campaign, NetworkKey
from leaderboards.reproduction.contrasts import Effect, Matched, Verdict, contrast, judge
from leaderboards.reproduction.measures import (
    ANIMALS,
    RANDOM_FEATURES,
    RAW_INPUT,
    Measured,
    accuracies,
    fits,
    layer_orders,
    parameters,
    published,
    published_accuracy,
)

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
    known = [item.name for item in fields(PublishedClaim)]
    return [PublishedClaim(**{name: told[name] for name in known if name in told}) for told in published()["claims"]]


def judge_accuracy(campaign: Campaign) -> list[Judgement]:
    """Judge the claims on accuracy and training, and those that no record can test."""
    ours, theirs = accuracies(campaign), published_accuracy()
    sizes, published_sizes = parameters(campaign), _published_parameters()
    found = []
    for claim in published_claims():
        if claim.measure == "accuracy":
            effect, other = _compare(claim, ours), _compare(claim, theirs)
        elif claim.measure == "parameters-accuracy":
            effect, other = (
                _sizes_against(sizes, ours, "supervised"),
                _sizes_against(published_sizes, theirs, "supervised"),
            )
        elif claim.measure == "divergence":
            effect, other = _divergence(campaign), None
        elif claim.measure == "none":
            verdict: Verdict = "cannot be tested here"
            found.append(Judgement(claim, None, verdict, verdict, claim.reason))
            continue
        else:
            continue
        verdict = judge(effect, claim.direction, margin=claim.margin, neutral=claim.neutral)
        found.append(Judgement(claim, effect, verdict, verdict, _unknown(effect), other))
    return found


def judge_fit(campaign: Campaign, place: int) -> list[Judgement]:
    """Judge the claims on neural fit on one board; without any board all are of networks not trained yet."""
    if not campaign.boards:
        claims = [claim for claim in published_claims() if claim.measure in FIT_MEASURES]
        return [Judgement(claim, None, "not trained yet", "not trained yet") for claim in claims]
    board, fit = campaign.boards[place], fits(campaign, place)
    lacks = lacking(
        max((len(entry.score.subjects) for entry in board.entries), default=0),
        len(board.conditions),
    )
    measured: dict[str, Callable[[PublishedClaim], Effect | None]] = {
        "fit": lambda claim: _compare(claim, fit),
        "accuracy-fit": lambda claim: _accuracy_fit(accuracies(campaign), fit),
        "parameters-fit": lambda claim: _sizes_against(parameters(campaign, place), fit, None),
        "layers": lambda claim: _each(layer_orders(campaign, place)),
        "blocks": lambda claim: _each(layer_orders(campaign, place, "attender.block")),
    }
    found = []
    for claim in published_claims():
        if claim.measure not in measured:
            continue
        effect = measured[claim.measure](claim)
        rule = judge(effect, claim.direction, margin=claim.margin, neutral=claim.neutral)
        reason = _unknown(effect)
        if lacks and effect is not None:
            rule, reason = "undecided", f"the rule needs {lacks}"
        verdict = rule
        if board.synthetic and effect is not None:
            verdict, reason = "cannot be tested here", "; ".join(filter(None, (SYNTHETIC_REASON, reason)))
        found.append(Judgement(claim, effect, verdict, rule, reason))
    return found


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
    """Return the effect of a claim that compares networks."""
    comparisons, detail, level = COMPARISONS[claim.key](measured)
    return contrast(comparisons, measured.networks.values(), paired=claim.paired, level=level, detail=detail)


_Chosen = tuple[list[Matched], str, float]


def _plain(comparisons: list[Matched]) -> _Chosen:
    return comparisons, "", LEVEL


def _recurrent(key: NetworkKey) -> bool:
    return key.encoder.startswith("zhuang") and "feedforward" not in key.encoder


def _encoders(one: Callable[[NetworkKey], bool], other: Callable[[NetworkKey], bool], objective: str | None) -> Any:
    """Return the choice of comparisons of two kinds of encoders, one comparison for each attender and objective."""

    def chosen(measured: Measured) -> _Chosen:
        found = measured.find(objective=objective)
        groups = sorted({(key.attender, key.objective) for key in found})
        comparisons = []
        for group in groups:
            inside = {key: item for key, item in found.items() if (key.attender, key.objective) == group}
            sides = [tuple(item for key, item in inside.items() if test(key)) for test in (one, other)]
            if all(sides):
                comparisons.append(Matched(*sides))
        return _plain(comparisons)

    return chosen


def _swap(change: Callable[[NetworkKey], NetworkKey | None], **chosen: Any) -> Any:
    """Return the choice that holds every chosen network against the one with something changed."""

    def matched(measured: Measured) -> _Chosen:
        found = measured.find(**chosen)
        pairs = [(item, measured.networks.get(other)) for key, item in found.items() if (other := change(key))]
        return _plain([Matched((item,), (other,)) for item, other in pairs if other is not None])

    return matched


def _variant(name: str, *, reverse: bool = False) -> Any:
    """Return the choice that holds the usual training by SimCLR against a variant, or the reverse."""

    def matched(measured: Measured) -> _Chosen:
        found = [
            (measured.networks.get(key._replace(variant="")), item)
            for key, item in measured.find(objective="simclr", variant=name).items()
        ]
        pairs = [(usual, other) for usual, other in found if usual is not None]
        return _plain([Matched((b,), (a,)) if reverse else Matched((a,), (b,)) for a, b in pairs])

    return matched


def _against(baseline: str, objective: str | None) -> Any:
    def matched(measured: Measured) -> _Chosen:
        base = measured.baselines.get(baseline)
        items = measured.find(objective=objective).values() if base else ()
        return _plain([Matched((item,), (base,)) for item in items if base])

    return matched


def _best(hero: NetworkKey, objective: str | None) -> Any:
    """Return the choice that holds a network against the highest of all others.

    The level of the interval is corrected for the choice of that one (Bonferroni).
    """

    def chosen(measured: Measured) -> _Chosen:
        found = measured.find(objective=objective)
        own = found.pop(hero, None)
        if own is None or not found:
            return _plain([])
        rival = max(found.values(), key=lambda item: item.value)
        return [Matched((own,), (rival,))], f"against {rival.name}", 1 - (1 - LEVEL) / len(found)

    return chosen


def _saturation(measured: Measured) -> _Chosen:
    """Hold the best network, corrected for being the best of many, against animals."""
    found, animals = measured.find(), measured.baselines.get(ANIMALS)
    if not found or animals is None:
        return _plain([])
    best = max(found.values(), key=lambda item: item.value)
    return [Matched((best,), (animals,))], f"{best.name}", 1 - (1 - LEVEL) / len(found)


def _untrained(measured: Measured) -> _Chosen:
    return _plain([Matched((item,)) for item in measured.find(objective="untrained").values()])


def _is(name: str) -> Callable[[NetworkKey], bool]:
    return lambda key: key.encoder == name


_INTERSECTION = "zhuang-intersection-ln"
_CELLS = ("zhuang-ugrnn", "zhuang-intersection", "zhuang-gru", "zhuang-lstm")


def _other_cell(key: NetworkKey) -> bool:
    return _recurrent(key) and not key.encoder.startswith("zhuang-intersection")


def _with_norm(key: NetworkKey) -> NetworkKey | None:
    return key._replace(encoder=key.encoder.removesuffix("-ln")) if key.encoder.removesuffix("-ln") in _CELLS else None


_simclr_for = {
    name: _swap(lambda key, name=name: key._replace(objective=name), objective="simclr")
    for name in ("supervised", "simsiam", "ae")
}
_to_untrained = _swap(lambda key: key._replace(objective="untrained"))
_without_attender = _swap(lambda key: key._replace(attender="none"), attender="gpt", objective="supervised")
_with_mamba = _swap(lambda key: key._replace(attender="mamba"), attender="gpt", objective="supervised")

COMPARISONS: dict[str, Callable[[Measured], _Chosen]] = {
    "best-accuracy": _best(NetworkKey("zhuang", "gpt"), "supervised"),
    "convrnn-resnet-accuracy": _encoders(_recurrent, _is("resnet18"), "supervised"),
    "convrnn-s4-accuracy": _encoders(_recurrent, _is("s4"), "supervised"),
    "intersection-accuracy": _encoders(_is(_INTERSECTION), _other_cell, "supervised"),
    "layer-norm-accuracy": _swap(
        lambda key: _with_norm(key) if key.encoder.endswith("-ln") else None, attender="none", objective="supervised"
    ),
    "gpt-accuracy": _without_attender,
    "gpt-mamba-accuracy": _with_mamba,
    "supervised-simclr-accuracy": _swap(lambda key: key._replace(objective="simclr"), objective="supervised"),
    "trained-accuracy": _to_untrained,
    "tactile-image-accuracy": _variant("image"),
    "masking-accuracy": _variant("masked", reverse=True),
    "raw-accuracy": _against(RAW_INPUT, "supervised"),
    "random-accuracy": _against(RANDOM_FEATURES, "supervised"),
    "best-fit": _best(NetworkKey(_INTERSECTION, "none", "simclr"), None),
    "saturation": _saturation,
    "raw-fit": _against(RAW_INPUT, None),
    "untrained-fit": _untrained,
    "trained-fit": _to_untrained,
    "convrnn-resnet-fit": _encoders(_recurrent, _is("resnet18"), None),
    "convrnn-s4-fit": _encoders(_recurrent, _is("s4"), None),
    "gpt-fit": _without_attender,
    "gpt-mamba-fit": _with_mamba,
    "simclr-supervised-fit": _simclr_for["supervised"],
    "simclr-simsiam-fit": _simclr_for["simsiam"],
    "simclr-ae-fit": _simclr_for["ae"],
    "tactile-image-fit": _variant("image"),
    "masking-fit": _variant("masked", reverse=True),
}
"""The choice of comparisons of each claim: networks, words beside the effect, and the level of its interval."""


def _each(measured: Measured) -> Effect | None:
    return contrast([Matched((item,)) for item in measured.find().values()], measured.networks.values())


def _correlation(points: Sequence[tuple[float, float]]) -> Effect | None:
    """Return Pearson's r over networks with Fisher's interval; None below four networks or of constant values."""
    if len(points) < 4:
        return None
    _, _, r, interval = regression(*(list(values) for values in zip(*points, strict=True)))
    return None if math.isnan(r) else Effect(r, interval, len(points), 0, f"{len(points)} networks")


def _accuracy_fit(accuracy: Measured, fit: Measured) -> Effect | None:
    found = accuracy.find(objective="supervised")
    return _correlation([(found[key].value, item.value) for key, item in fit.networks.items() if key in found])


def _sizes_against(sizes: dict[NetworkKey, int], measured: Measured, objective: str | None) -> Effect | None:
    found = measured.find(objective=objective)
    return _correlation([(float(np.log10(sizes[key])), item.value) for key, item in found.items() if key in sizes])


def _published_parameters() -> dict[NetworkKey, int]:
    runs = [run for run in published()["runs"] if run["parameters"]]
    return {NetworkKey.of(run["model"], run["objective"]): run["parameters"] for run in runs}


def _divergence(campaign: Campaign) -> Effect | None:
    """Return the share of trainings with S4 that diverged."""
    lines = [item for item in campaign.trainings if item.objective != "untrained" and item.model.startswith("s4")]
    if not lines:
        return None
    count = sum(item.status == "diverged" for item in lines)
    interval = wilson_interval(count, len(lines), over="trainings")
    return Effect(count / len(lines), interval, len(lines), count, f"{count} of {len(lines)} trainings")
