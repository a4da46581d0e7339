"""Tests of many models at once, and of models against one another.

``p`` of a single model is the share of permutations of the stimuli that score as high. Among many models some do by
luck; the corrected p asks how often *the luckiest of them all* would, under the same permutations for
all (Westfall & Young 1993, step-down maximum statistic), which keeps the correlations between models.

Models are compared with one another on the same animals and stimuli, on the scale that all metrics share. The
standard error of a difference holds its spread over animals and over stimuli, so a test generalises to others of both.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from brainbench.core.errors import UsageError, check_name
from brainbench.core.records import Score
from brainbench.core.statistics import PairTest, compare_scores
from brainbench.metrics.arrays import Floats
from brainbench.metrics.inference.permutation import tail_p
from brainbench.metrics.measures.rsa import RSA, check_layers
from brainbench.metrics.rdms.comparison import check_comparison
from brainbench.metrics.reliability.subject_rdm import SubjectRDM
from brainbench.metrics.score import score_layers

CORRECTIONS = ("holm", "fdr", "none")
"""Corrections of the pairwise tests: Holm (family-wise), Benjamini & Hochberg (false discovery rate)."""


@dataclass(frozen=True)
class ModelTest:
    """One model among those compared."""

    score: Score
    p_corrected: float
    """P(the best of all models under permuted stimuli scores as high), step-down; NaN where p is."""


@dataclass(frozen=True)
class ModelComparison:
    """Models compared on the same animals and stimuli."""

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
    correction: str = "fdr",
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
        seed: Seed of random permutations.
        device: Torch device for the permutations; numpy by default.
    """
    check_name("correction for multiple tests", correction, CORRECTIONS)
    if not models:
        raise UsageError("There are no models to compare; give the layers' RDMs of at least one.")
    check_comparison(compare)
    metric, options = RSA(comparison=compare), {"stimuli": stimuli, "seed": seed, "device": device}
    checked = {name: check_layers(layers, stimuli) for name, layers in models.items()}
    results = {name: score_layers(metric, rdms, subjects, name=name, **options) for name, rdms in checked.items()}
    # All models met the same permutations, so the maximum over models keeps the correlations between them.
    tested = {name: test.null for name, (_, test) in results.items() if test is not None and math.isfinite(test.p)}
    corrected = dict(zip(tested, step_down(np.stack(list(tested.values()))), strict=True)) if tested else {}
    scores = {name: score for name, (score, _) in results.items()}
    pairs = [compare_scores(scores[a], scores[b]) for a, b in itertools.combinations(scores, 2)]
    adjusted = adjust([pair.p for pair in pairs], correction)
    return ModelComparison(
        models=tuple(ModelTest(score, corrected.get(name, math.nan)) for name, score in scores.items()),
        pairs=tuple(replace(pair, p_corrected=float(q)) for pair, q in zip(pairs, adjusted, strict=True)),
        correction=correction,
        method=f"models: step-down maximum over {len(tested)} models, same permutations for all; "
        f"pairs: t over animals and stimuli, {correction}",
    )


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

    >>> adjust([0.01, 0.04, 0.03], "holm").round(3).tolist()
    [0.03, 0.06, 0.06]
    >>> adjust([0.01, 0.04, 0.03], "fdr").round(3).tolist()
    [0.03, 0.04, 0.04]
    """
    check_name("correction for multiple tests", correction, CORRECTIONS)
    result = np.array(p, dtype=np.float64)
    finite = np.isfinite(result)
    # Benjamini and Hochberg's step-up procedure, which controls the share of false discoveries.
    if correction == "fdr" and finite.any():
        from scipy.stats import false_discovery_control

        result[finite] = false_discovery_control(result[finite])
    elif correction == "holm":
        # Holm 1979: the i-th smallest of n is multiplied by n − i + 1, and none may fall below its predecessor.
        order = np.flatnonzero(finite)[np.argsort(result[finite], kind="stable")]
        scaled = np.maximum.accumulate(result[order] * np.arange(len(order), 0, -1))
        result[order] = np.minimum(scaled, 1.0)
    return result
