"""Tests of many models or layers at once, and of models against one another.

``p`` of a single model is the share of permutations of the stimuli that score as high. Among many models some do by
luck; the corrected p asks how often *the luckiest of them all* would, under the same permutations for
all (Westfall & Young 1993, step-down maximum statistic), which keeps the correlations between models.

Models are compared with one another on the same animals: the test flips the signs of the animals'
differences, so it generalises to animals and not to other stimuli.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from brainbench.core.errors import UsageError, unknown_name
from brainbench.core.records import Interval, Score
from brainbench.metrics.animals import gather
from brainbench.metrics.inference.intervals import t_interval
from brainbench.metrics.inference.permutation import SMALLEST_STIMULI, layer_p, permuted_values, tail_p
from brainbench.metrics.rdms.comparison import check_comparison
from brainbench.metrics.rdms.pairs import Floats, rdm_stack
from brainbench.metrics.reliability.subject_rdm import SubjectRDM, is_flat
from brainbench.metrics.score import score_with_test

CORRECTIONS = ("holm", "fdr", "none")
"""Corrections of the pairwise tests: Holm (family-wise), Benjamini & Hochberg (false discovery rate)."""

EXACT_ANIMALS = 14
"""Up to this many animals all 2^A signs are taken."""

_RANDOM_FLIPS = 10_000


@dataclass(frozen=True)
class ModelTest:
    """One model among those compared."""

    score: Score
    p_corrected: float
    """P(the best of all models under permuted stimuli scores as high), step-down; NaN where p is."""


@dataclass(frozen=True)
class PairTest:
    """Two models on the same animals."""

    first: str
    """Name of one model."""
    second: str
    """Name of the other model."""
    difference: float
    """Mean over animals of the first's value minus the second's."""
    interval: Interval | None
    """Interval of the difference, over animals."""
    p: float
    """Two-sided, by flipping the signs of the animals' differences."""
    p_corrected: float
    """Corrected for the number of pairs."""
    reason: str = ""
    """Reason for a missing p; empty otherwise."""


@dataclass(frozen=True)
class ModelComparison:
    """Models compared on the same animals."""

    models: tuple[ModelTest, ...]
    """In the order given."""
    pairs: tuple[PairTest, ...]
    correction: str
    method: str


def compare_models(
    models: Mapping[str, Mapping[str, ArrayLike]],
    subjects: Sequence[SubjectRDM],
    *,
    stimuli: Sequence[str],
    compare: str = "pearson",
    correction: str = "holm",
    seed: int = 0,
    device: Any = None,
) -> ModelComparison:
    """Score several models, correct their p for their number and compare them pairwise.

    Args:
        models: Name → RDM [P] of each layer. The choice of layer is part of every permutation.
        subjects: From :func:`subject_rdm`; the brain side is shared by all models.
        stimuli: Names of the K stimuli.
        compare: Comparison of RDMs.
        correction: ``holm``, ``fdr`` or ``none``, for the pairwise tests.
        seed: Seed of random permutations and sign flips.
        device: Torch device for the permutations; numpy by default.

    Raises:
        UsageError: no models or animals, RDMs that do not fit, unknown names.
    """
    check_correction(correction)
    if not models:
        raise UsageError("There are no models to compare; give the layers' RDMs of at least one.")
    found = {
        name: score_with_test(layers, subjects, name, stimuli, "default", compare, seed, device)
        for name, layers in models.items()
    }
    # All models met the same permutations, so the maximum over models keeps the correlations between them.
    tested = {name: test.null for name, (_, test) in found.items() if test is not None and math.isfinite(test.p)}
    corrected = dict(zip(tested, step_down(np.stack(list(tested.values()))), strict=True)) if tested else {}
    scores = {name: score for name, (score, _) in found.items()}
    pairs = [_pair(scores[a], scores[b], seed) for a, b in itertools.combinations(scores, 2)]
    adjusted = adjust([pair[3] for pair in pairs], correction)
    return ModelComparison(
        models=tuple(ModelTest(score, corrected.get(name, math.nan)) for name, score in scores.items()),
        pairs=tuple(
            PairTest(a, b, difference, interval, p, float(q), reason)
            for ((a, b), difference, interval, p, reason), q in zip(pairs, adjusted, strict=True)
        ),
        correction=correction,
        method=f"models: step-down maximum over {len(tested)} models, same permutations for all; "
        f"pairs: sign flips over animals, {correction}",
    )


@dataclass(frozen=True)
class LayerTest:
    """One layer among those of a model."""

    layer: str
    value: float
    """Mean noise-corrected comparison over the reliable animals."""
    p: float
    p_corrected: float
    """P(the largest of all layers under permuted stimuli reaches this layer's value)."""


def layer_tests(
    layer_rdms: Mapping[str, ArrayLike],
    subjects: Sequence[SubjectRDM],
    *,
    compare: str = "pearson",
    seed: int = 0,
    device: Any = None,
) -> tuple[LayerTest, ...]:
    """Test every layer, corrected for their number by the maximum statistic (Nichols & Holmes 2002).

    Layers without a usable RDM have NaN throughout and do not count. With fewer than four stimuli or
    no usable animal every p is NaN.

    Raises:
        UsageError: no layers or animals, RDMs that do not fit, unknown comparison.
    """
    check_comparison(compare)
    if not layer_rdms:
        raise UsageError("There are no layers to test; give the RDM of at least one layer.")
    rdms = rdm_stack(list(layer_rdms.values()), "layer_rdms")
    animals = gather(subjects, estimator="default", comparison=compare, pairs=rdms.shape[1])
    nothing = [LayerTest(name, math.nan, math.nan, math.nan) for name in layer_rdms]
    usable = np.flatnonzero(~is_flat(rdms))
    if not len(usable) or not animals.scored or rdms.shape[1] < SMALLEST_STIMULI * (SMALLEST_STIMULI - 1) // 2:
        return tuple(nothing)
    factors = animals.factors(animals.scored)
    # Every permutation is corrected by the same factors as the data, so p belongs to the values that are reported.
    values = permuted_values(
        rdms[usable],
        animals.rdms(animals.scored),
        lambda r: (r * factors).mean(axis=-1),
        method=compare,
        seed=seed,
        device=device,
    )
    found = zip(usable.tolist(), values[0].tolist(), *(p.tolist() for p in layer_p(values)), strict=True)
    for index, observed, p, corrected in found:
        nothing[index] = LayerTest(nothing[index].layer, observed, p, corrected)
    return tuple(nothing)


def step_down(null: Floats) -> Floats:
    """Return corrected p [M] of tests with joint null statistics [M, N], the observed ones first (maximum statistic).

    Statistics must be on one scale, as scores are: the test with the largest is judged against the maximum
    over all, the next against the maximum over the rest.
    """
    order = np.argsort(-null[:, 0], kind="stable")
    result, largest = np.empty(len(null)), np.full(null.shape[1], -np.inf)
    # From the least test up, each is judged against the best of itself and those below it.
    for index in order[::-1]:
        largest = np.maximum(largest, null[index])
        result[index] = tail_p(largest, null[index, 0])
    # A larger statistic may not have the larger p (step-down of Westfall & Young 1993).
    result[order] = np.maximum.accumulate(result[order])
    return result


def adjust(p: ArrayLike, correction: str) -> Floats:
    """Return p-values [N] corrected for their number; NaN entries stay NaN and do not count.

    Raises:
        UsageError: unknown correction.

    >>> adjust([0.01, 0.04, 0.03], "holm").round(3).tolist()
    [0.03, 0.06, 0.06]
    >>> adjust([0.01, 0.04, 0.03], "fdr").round(3).tolist()
    [0.03, 0.04, 0.04]
    """
    check_correction(correction)
    result = np.array(p, dtype=np.float64)
    known = np.isfinite(result)
    # Benjamini and Hochberg's step-up procedure, which controls the share of false discoveries.
    if correction == "fdr" and known.any():
        from scipy.stats import false_discovery_control

        result[known] = false_discovery_control(result[known])
    elif correction == "holm":
        # Holm 1979: the i-th smallest of n is multiplied by n − i + 1, and none may fall below its predecessor.
        order = np.flatnonzero(known)[np.argsort(result[known], kind="stable")]
        scaled = np.maximum.accumulate(result[order] * np.arange(len(order), 0, -1))
        result[order] = np.minimum(scaled, 1.0)
    return result


def check_correction(correction: str) -> None:
    """Raise UsageError with the nearest name unless ``correction`` is known."""
    if correction not in CORRECTIONS:
        raise unknown_name("correction for multiple tests", correction, CORRECTIONS)


def sign_flip_p(differences: ArrayLike, *, seed: int = 0) -> float:
    """Return the two-sided p of a mean difference over animals [A] when its signs are flipped.

    All 2^A signs up to 14 animals, else 10,000 random ones, (b+1)/(n+1). Exact when differences are
    symmetric about zero. The smallest possible p is 2/2^A.
    """
    d = np.asarray(differences, dtype=np.float64)
    if not d.size or not np.isfinite(d).all():
        return math.nan
    # Sums do not depend on the order of animals up to rounding, which the tie absorbs.
    d = np.sort(d)
    # Under symmetry about zero all 2^A signs are equally likely; the bits of 0 … 2^A − 1 list them, all plus first.
    if len(d) <= EXACT_ANIMALS:
        signs = 1.0 - 2.0 * ((np.arange(2 ** len(d))[:, None] >> np.arange(len(d))) & 1)
    else:
        signs = np.random.default_rng(seed).choice([-1.0, 1.0], (_RANDOM_FLIPS + 1, len(d)))
        signs[0] = 1.0
    sums = np.abs(signs @ d)
    return float(tail_p(sums))


def paired_values(first: Score, second: Score) -> tuple[Floats, Floats]:
    """Return the values [A] of two scores on the animals that both could use with status ``ok`` (else any value)."""
    pairs = []
    for wanted in (("ok",), ("ok", "unreliable")):
        one, two = ({s.subject: s.value for s in x.subjects if s.status in wanted} for x in (first, second))
        pairs = [
            (one[name], two[name])
            for name in sorted(one.keys() & two.keys())
            if math.isfinite(one[name]) and math.isfinite(two[name])
        ]
        if pairs:
            break
    array = np.array(pairs, dtype=np.float64).reshape(-1, 2)
    return array[:, 0], array[:, 1]


def _pair(first: Score, second: Score, seed: int) -> tuple[tuple[str, str], float, Interval | None, float, str]:
    one, two = paired_values(first, second)
    names = first.name, second.name
    if len(one) < 2:
        why = "fewer than two animals have a value for both models"
        return names, float((one - two).mean()) if len(one) else math.nan, None, math.nan, why
    return names, float((one - two).mean()), t_interval(one - two), sign_flip_p(one - two, seed=seed), ""
