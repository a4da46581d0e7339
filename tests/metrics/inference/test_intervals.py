"""Intervals over animals and stimuli, and the differences of models that rest on them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from brainbench.core.records import Interval, Score
from brainbench.core.statistics import two_factor_error, two_factor_interval
from brainbench.metrics.inference.intervals import held_to_scale, interval_reasons
from brainbench.metrics.rdms.comparison import compare_all
from brainbench.metrics.rdms.dissimilarity import rdm
from brainbench.metrics.rdms.pairs import permuted_pairs


def _difference(rng, stimuli, animals, shares):
    """Two models that hold a share of what animals' features have in common: difference, its error and freedom."""
    shared = rng.normal(size=(stimuli, 6))
    brain, layers = [], []
    for _ in range(animals):
        tuning = shared @ rng.normal(size=(6, 40)) / math.sqrt(6)
        brain.append(rdm(tuning + rng.normal(size=tuning.shape), method="sqeuclidean"))
    for share in shares:
        weight = 1 / (1 + math.sqrt(1 / share**2 - 1)) if share else 0.0
        other = rng.normal(size=shared.shape)
        features = np.concatenate([math.sqrt(weight) * shared, math.sqrt(1 - weight) * other], axis=1)
        layers.append(rdm(features, method="sqeuclidean"))
    models, brain = np.stack(layers), np.stack(brain)
    values = compare_all(models, brain, method="whitened-cosine")
    without = []
    for stimulus in range(stimuli):
        kept = permuted_pairs(np.delete(np.arange(stimuli), stimulus)[None], stimuli)[0]
        without.append(compare_all(models[:, kept], brain[:, kept], method="whitened-cosine").mean(axis=1))
    each, left_out = values[0] - values[1], np.array(without)
    error, freedom = two_factor_error(each, left_out[:, 0] - left_out[:, 1])
    return each.mean(), float(error), float(freedom)


@pytest.mark.parametrize(("stimuli", "animals"), [(12, 4), (24, 8)])
def test_models_that_know_nothing_are_rarely_told_apart_and_a_better_one_mostly_is(stimuli, animals):
    rng = np.random.default_rng(stimuli)
    null = [_difference(rng, stimuli, animals, (0.0, 0.0)) for _ in range(150)]
    p = [2 * stats.t.sf(abs(mean) / error, freedom) for mean, error, freedom in null]
    # Three standard errors of 150 simulations at 5 %.
    assert np.mean(np.array(p) <= 0.05) <= 0.05 + 3 * math.sqrt(0.05 * 0.95 / 150)
    # The error is that of the difference over studies, or a little more.
    spread = np.std([mean for mean, _, _ in null], ddof=1)
    assert 0.9 * spread < np.sqrt(np.mean([error**2 for _, error, _ in null])) < 2.5 * spread
    if stimuli < 20:
        return
    found = [_difference(rng, stimuli, animals, (0.9, 0.4)) for _ in range(40)]
    power = np.mean([mean > 0 and 2 * stats.t.sf(mean / error, freedom) <= 0.05 for mean, error, freedom in found])
    assert power >= 0.8


def test_the_interval_is_students_where_stimuli_change_nothing_and_wider_where_they_do():
    values = np.random.default_rng(0).normal(0.5, 0.1, 8)
    narrow = two_factor_interval(values.mean(), values, np.full(20, values.mean()))
    low, high = stats.t.interval(0.95, 7, loc=values.mean(), scale=stats.sem(values))
    assert (narrow.low, narrow.high) == pytest.approx((low, high))
    wide = two_factor_interval(values.mean(), values, values.mean() + 0.02 * np.random.default_rng(1).normal(size=20))
    assert wide.low < narrow.low < narrow.high < wide.high
    assert two_factor_interval(0.5, [0.5], np.full(20, 0.5)) is None


def test_too_few_animals_or_stimuli_say_what_is_needed():
    assert interval_reasons(8, 20) == ()
    assert "1" not in interval_reasons(1, 20)[0]
    (told,) = interval_reasons(3, 20)
    assert "3 animals" in told
    assert "stimuli" not in told
    assert "6 stimuli" in interval_reasons(8, 6)[0]


def test_a_score_above_all_that_is_reliable_is_not_trusted():
    above = Score("x", 0.9, "ok", interval=Interval(0.88, 0.92), chance=0.5, attainable=0.8)
    held = held_to_scale(above)
    assert (held.status, "1.27" in held.reasons[0]) == ("unreliable", True)
    reaching = replace(above, interval=Interval(0.78, 1.02))
    assert held_to_scale(reaching) is reaching
