"""What metrics of patterns share: which animals count, the orders of the stimuli, the layer, the words."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from brainbench.core.errors import UsageError
from brainbench.core.records import Status, SubjectScore
from brainbench.metrics.inference.intervals import VERIFIED_ANIMALS
from brainbench.metrics.inference.permutation import SMALLEST_STIMULI, TIE, label_orders
from brainbench.metrics.layers import choose_on_others, held_out
from brainbench.metrics.measures.animal_patterns import AnimalPatterns
from brainbench.metrics.rdms.pairs import Floats, Ints
from brainbench.metrics.reliability.noise_correction import RELIABILITY_GATE

ORDERS = 999
"""Random orders of the stimuli above six; up to six all are taken."""

_EXACT_STIMULI = 6


@dataclass(frozen=True)
class Gathered:
    """Animals by name, and the indices of those that are scored."""

    animals: tuple[AnimalPatterns, ...]
    scored: tuple[int, ...]
    reliable: bool
    reasons: tuple[str, ...]


def gather_patterns(animals: Sequence[AnimalPatterns], corrected: bool) -> Gathered:
    """Sort animals by name and decide which are scored: the reliable ones where values are corrected."""
    if not animals:
        raise UsageError("There are no animals to score against; give at least one.")
    ordered = tuple(sorted(animals, key=lambda animal: animal.subject))
    least = 0.0 if corrected else -math.inf
    usable = [i for i, animal in enumerate(ordered) if animal.problem is None and animal.reliability > least]
    good = [i for i in usable if ordered[i].reliability >= RELIABILITY_GATE]
    scored = good if good and corrected else usable
    reasons = []
    for index, animal in enumerate(ordered):
        if index not in scored:
            why = animal.problem or f"reliability {animal.reliability:.2f} is below {RELIABILITY_GATE}"
            reasons.append(f"{animal.subject} left out: {why}")
        reasons += [f"{animal.subject}: {note}" for note in animal.notes if index in scored]
    return Gathered(ordered, tuple(scored), bool(good) or not corrected, tuple(reasons))


def check_features(metric: str, features: Mapping[str, Any], stimuli: Sequence[str], estimator: str) -> None:
    """Raise UsageError for a published estimator, no layers, or features of another number of stimuli."""
    if estimator != "default":
        raise UsageError(f"The estimator {estimator!r} is one of RSA; the metric {metric!r} has 'default' only.")
    if not features:
        raise UsageError("There are no layers to score; give the features of at least one layer.")
    for layer, values in features.items():
        rows = len(stimuli) if values is None else len(np.asarray(values))
        if rows != len(stimuli):
            raise UsageError(f"The features of layer {layer!r} have {rows} rows; {len(stimuli)} stimuli are scored.")


def undefined_reasons(found: Gathered, usable: list[str], stimuli: int) -> tuple[str, ...]:
    """Say why there is no score."""
    if stimuli < SMALLEST_STIMULI:
        reason = few_stimuli(stimuli)
    elif not usable:
        reason = "activations of every layer are constant or not finite"
    else:
        reason = "no animal can be used"
    return (reason, *found.reasons)


def few_stimuli(stimuli: int) -> str:
    """Say that there are too few stimuli."""
    return f"{stimuli} stimuli are too few to leave one out; at least {SMALLEST_STIMULI} are needed"


def pattern_orders(stimuli: int, seed: int) -> Ints:
    """Return orders of the stimuli [N, K], the given one first: all, or ``ORDERS`` random ones."""
    if stimuli <= _EXACT_STIMULI:
        return np.concatenate(list(label_orders(stimuli, 1 << 20, seed)))
    random = np.random.default_rng(seed).permuted(np.tile(np.arange(stimuli), (ORDERS, 1)), axis=1)
    return np.concatenate([np.arange(stimuli)[None], random])


def chosen_layers(values: Floats) -> tuple[Ints, Floats, str]:
    """Return the layers [A] chosen, the values [N, A] held out under every order, and the rule in words."""
    if values.shape[1] == 1:
        return np.zeros(values.shape[2], dtype=np.int64), values[:, 0], "only layer"
    if values.shape[2] == 1:
        rule = "maximum over layers on the only animal (optimistic; the permutation takes the same maximum)"
        return np.argmax(values[0], axis=0), values.max(axis=1), rule
    rule = "chosen on the other animals, evaluated on the animal held out"
    return choose_on_others(values[0]), held_out(values), rule


def permutation_p(statistic: Floats) -> float:
    """Return P(statistic ≥ observed) from statistics [N], the observed one first."""
    return float((statistic >= statistic[0] - TIE * max(1.0, abs(statistic[0]))).mean())


def permutation_method(stimuli: int, orders: int, layers: int, statistic: Floats) -> str:
    """Describe the test in words."""
    how = f"all {orders} orders" if stimuli <= _EXACT_STIMULI else f"{orders - 1} random orders, (b+1)/(n+1)"
    choice = "one layer" if layers == 1 else "layer chosen anew in each"
    chance = round(float(np.nanmean(statistic)), 2) + 0.0
    return f"one-sided permutation of stimulus labels, {how}; {choice}; mean score under permutation {chance:.2f}"


def verdict(found: Gathered, scored: int, corrected: bool) -> tuple[Status, tuple[str, ...]]:
    """Return the status and its reasons."""
    reasons = list(found.reasons)
    if not found.reliable:
        reasons.insert(0, "no animal's responses are reliable")
    if not corrected:
        reasons.append("not corrected for noise: compare with the animal-to-animal value, not with 1")
    if scored == 1:
        reasons.append("one animal: no confidence interval, since nothing is known about other animals")
    elif scored < VERIFIED_ANIMALS:
        reasons.append(f"interval from {scored} animals is unreliable: coverage not verified below {VERIFIED_ANIMALS}")
    return "ok" if found.reliable else "unreliable", tuple(reasons)


def subject_scores(found: Gathered, values: Mapping[str, tuple[float, str | None]]) -> tuple[SubjectScore, ...]:
    """Return what each animal contributed: its value and layer, by name."""
    scores = []
    for animal in found.animals:
        value, layer = values.get(animal.subject, (math.nan, None))
        good = animal.subject in values
        status: Status = "undefined" if not good else "ok" if found.reliable else "unreliable"
        scores.append(
            SubjectScore(animal.subject, value, value, animal.reliability, status, animal.units, animal.trials, layer)
        )
    return tuple(scores)
