"""Decoding of stimulus properties from stimuli left out."""

from __future__ import annotations

import numpy as np
import pytest

from brainbench.core.errors import UsageError
from brainbench.metrics.measures.classifier import decode, fit_softmax

SHAPES = ["convex"] * 3 + ["concave"] * 3
DISTANCES = ["close", "medium", "far"] * 2


def test_the_fit_is_that_of_scikit_learn():
    linear_model = pytest.importorskip("sklearn.linear_model")
    rng = np.random.default_rng(0)
    features, target = rng.normal(size=(40, 5)), rng.integers(0, 3, 40)
    weight, bias = fit_softmax(features, target, 3, penalty=0.7)
    expected = linear_model.LogisticRegression(C=0.7, tol=1e-8, max_iter=1000).fit(features, target)
    np.testing.assert_allclose(
        features @ weight + bias - (features @ weight + bias).mean(axis=1, keepdims=True),
        expected.decision_function(features),
        atol=1e-3,
    )


def test_a_code_for_shape_and_distance_is_decoded_for_stimuli_left_out():
    rng = np.random.default_rng(1)
    shape, distance = np.repeat(np.eye(2), 3, axis=0), np.tile(np.eye(3), (2, 1))
    axes = np.concatenate([shape, distance], axis=1) @ rng.normal(size=(5, 60))
    stimuli = np.repeat(np.arange(6), 8)
    trials = axes[stimuli] + 0.5 * rng.normal(size=(48, 60))
    for classes, chance in ((SHAPES, 0.5), (DISTANCES, 1 / 3)):
        found = decode(trials, stimuli, classes)
        assert found.accuracy > 0.95
        assert found.chance == pytest.approx(chance)
        assert len(found.correct) == 6


def test_without_information_leaving_one_out_falls_below_chance():
    rng = np.random.default_rng(2)
    values = [decode(rng.normal(size=(6, 50)), range(6), SHAPES) for _ in range(12)]
    assert np.mean([found.accuracy for found in values]) < 0.45
    assert np.mean([found.p for found in values]) > 0.4
    assert np.mean([found.accuracy for found in values]) == pytest.approx(
        np.mean([f.expected for f in values]), abs=0.1
    )


def test_all_orders_of_the_classes_are_tried_up_to_six_stimuli():
    trials = np.random.default_rng(5).normal(size=(8, 4))
    assert decode(trials[:6], range(6), SHAPES).count == 720
    assert decode(trials, range(8), [*SHAPES, "convex", "concave"]).count == 200


def test_many_units_cost_no_more_than_trials():
    rng = np.random.default_rng(3)
    wide = rng.normal(size=(6, 20_000))
    turned = wide @ np.linalg.svd(wide, full_matrices=False)[2].T
    # Scaling to unit mean square depends on the number of columns, so give the narrow one the same.
    assert (
        decode(wide, range(6), SHAPES).correct
        == decode(np.pad(turned, ((0, 0), (0, 19_994))), range(6), SHAPES).correct
    )


def test_misuse_is_told_in_a_sentence():
    rng = np.random.default_rng(4)
    with pytest.raises(UsageError, match="needs 2 stimuli"):
        decode(rng.normal(size=(6, 3)), range(6), ["a", "a", "a", "a", "a", "b"])
    with pytest.raises(UsageError, match="one stimulus 0 … 5"):
        decode(rng.normal(size=(5, 3)), range(5), SHAPES)
    with pytest.raises(UsageError, match="must be finite"):
        decode(np.full((6, 3), np.nan), range(6), SHAPES)
    for penalty in (0.0, -1.0, np.nan):
        with pytest.raises(UsageError, match=f"penalty .*{penalty}"):
            decode(rng.normal(size=(6, 3)), range(6), SHAPES, penalty=penalty)
