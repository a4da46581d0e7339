"""Decoding of labels' properties, as a metric."""

from __future__ import annotations

import math

import numpy as np
import pytest

from brainbench.core.contracts import Trials
from brainbench.core.errors import UsageError
from brainbench.core.statistics import two_factor_interval
from brainbench.metrics import get_metric
from brainbench.metrics.measures.decoding import LabelDecoding, LabelledFeatures, decode, fit_softmax, label_properties

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


@pytest.mark.slow
def test_without_information_leaving_one_out_falls_below_chance():
    rng = np.random.default_rng(2)
    values = [decode(rng.normal(size=(6, 50)), range(6), SHAPES) for _ in range(12)]
    assert np.mean([found.accuracy for found in values]) < 0.45
    assert np.mean([found.p for found in values]) > 0.4
    assert np.mean([found.accuracy for found in values]) == pytest.approx(
        np.mean([f.expected for f in values]), abs=0.1
    )


def test_classes_of_stimuli_with_more_trials_are_not_decoded_from_noise():
    # Where nothing is known, the class of most trials was told: right for all its stimuli, and for fewer in any other
    # order of the classes, so .45 of such data had p ≤ .05.
    rng, stimuli = np.random.default_rng(4), np.repeat(np.arange(8), [20] * 4 + [4] * 4)
    results = [decode(rng.normal(size=(96, 2)), stimuli, ["a"] * 4 + ["b"] * 4) for _ in range(16)]
    assert np.mean([result.p for result in results]) > 0.3
    assert sum(result.p <= 0.05 for result in results) <= 3


def test_trials_that_stand_several_times_for_each_stimulus_change_no_fit():
    rng = np.random.default_rng(6)
    features, target = rng.normal(size=(20, 4)), rng.integers(0, 3, 20)
    numbers = rng.integers(1, 5, 20)
    repeated = fit_softmax(np.repeat(features, numbers, axis=0), np.repeat(target, numbers), 3, penalty=0.7)
    counted = fit_softmax(features, target, 3, penalty=0.7, counts=numbers)
    np.testing.assert_allclose(features @ counted[0] + counted[1], features @ repeated[0] + repeated[1], atol=1e-3)


def test_all_orders_of_the_classes_are_tried_up_to_six_stimuli():
    trials = np.random.default_rng(5).normal(size=(8, 4))
    assert decode(trials[:6], range(6), SHAPES).count == 720
    assert decode(trials, range(8), [*SHAPES, "convex", "concave"]).count == 200


@pytest.mark.slow
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
    with pytest.raises(UsageError, match="one stimulus 0 … 5"):
        decode(rng.normal(size=(7, 3)), [0, 0.9, 1, 2, 3, 4, 5], SHAPES)
    with pytest.raises(UsageError, match="must be finite"):
        decode(np.full((6, 3), np.nan), range(6), SHAPES)
    for penalty in (0.0, -1.0, np.nan):
        with pytest.raises(UsageError, match=f"penalty .*{penalty}"):
            decode(rng.normal(size=(6, 3)), range(6), SHAPES, penalty=penalty)


LABELS = [f"{shape}-{place}" for shape in ("concave", "convex") for place in ("close", "far", "medium")]


def _make_axes(rng, units):
    shape, place = np.repeat(np.eye(2), 3, axis=0), np.tile(np.eye(3), (2, 1))
    return np.concatenate([shape, place], axis=1) @ rng.normal(size=(5, units))


def _make_animals(metric, number=4, noise=0.5, units=30):
    rng = np.random.default_rng(0)
    labels = np.repeat(np.arange(6), 8)
    trials = [_make_axes(rng, units)[labels] + noise * rng.normal(size=(48, units)) for _ in range(number)]
    return [metric.animal(f"m{i}", [Trials(block, labels)], 6) for i, block in enumerate(trials)]


def test_labels_name_their_properties_in_any_number_of_parts():
    assert list(label_properties(LABELS)) == ["concave/convex", "close/far/medium"]
    assert label_properties(["a-x", "b-x", "c-x"]) == {}
    assert label_properties(["a-1", "a-2", "b"]) == {}
    assert list(label_properties(["go", "go", "nogo", "nogo"])) == ["go/nogo"]
    # Sides of two things take the same values, and both count.
    sides = label_properties(["left-left", "left-right", "right-left", "right-right"])
    assert {name: codes.tolist() for name, codes in sides.items()} == {
        "left/right": [0, 0, 1, 1],
        "left/right (2)": [0, 1, 0, 1],
    }


@pytest.mark.slow
def test_a_model_with_axes_is_decoded_and_one_without_is_not():
    metric = get_metric("decoding")
    rng = np.random.default_rng(1)
    animals = _make_animals(metric)
    layers = {"noise": rng.normal(size=(6, 200)), "axes": _make_axes(rng, 40)}
    score = metric.score(layers, animals, name="x", stimuli=LABELS)
    assert (score.status, score.value, score.layer) == ("ok", 1.0, "axes")
    # Both properties are decoded by chance in few of the 720 orders.
    assert score.p < 0.02
    tests = {item["layer"]: item for item in score.provenance["statistics"]["layer_tests"]}
    assert tests["axes"]["p"] <= tests["axes"]["p_corrected"] == score.p
    assert tests["noise"]["p_corrected"] > 0.2
    shape, place = score.provenance["statistics"]["decoding"]
    assert (shape["chance"], place["chance"]) == (0.5, pytest.approx(1 / 3))
    assert shape["expected"] < 0.5
    by_hand = decode(layers["axes"], range(6), [label.split("-")[0] for label in LABELS])
    assert (shape["accuracy"], shape["p"], shape["expected"]) == (
        by_hand.accuracy,
        pytest.approx(by_hand.p),
        pytest.approx(by_hand.expected),
    )


@pytest.mark.slow
def test_animals_are_decoded_each_by_itself(monkeypatch):
    metric = get_metric("decoding")
    monkeypatch.setattr(LabelDecoding, "orders_between", 59)
    score = metric.score_animals(_make_animals(metric), stimuli=LABELS)
    assert score.value > 0.9
    assert [subject.subject for subject in score.subjects] == ["m0", "m1", "m2", "m3"]
    assert score.interval.low > 0.7
    # Orders are those of each animal by itself, and few of them leave all classes together.
    assert score.p == pytest.approx(1 / 60)


def test_labels_without_a_shared_property_are_undefined_in_words():
    metric = get_metric("decoding")
    stimuli = list("abcdef")
    score = metric.score({"l": np.eye(6)}, _make_animals(metric), name="x", stimuli=stimuli)
    assert (score.status, math.isnan(score.value)) == ("undefined", True)
    assert "as 'convex-far' and 'convex-close' do: a, b, c, d" in score.reasons[0]
    assert metric.score_animals(_make_animals(metric), stimuli=stimuli).status == "undefined"
    broken = metric.score({"l": np.full((6, 2), np.nan)}, _make_animals(metric), name="x", stimuli=LABELS)
    assert broken.reasons[0] == "activations of every layer are constant or not finite"


def test_a_layer_without_values_for_a_whole_class_is_not_decoded():
    labels = [f"{shape}-{place}-{side}" for shape in ("convex", "concave") for place in "ab" for side in "xy"]
    metric, rng = get_metric("decoding"), np.random.default_rng(0)
    animals = [
        metric.animal(name, [Trials(rng.normal(size=(16, 4)), np.arange(16) % 8)], 8, splits=3) for name in ("m1", "m2")
    ]
    features = np.concatenate([rng.normal(size=(4, 3)), np.full((4, 3), np.nan)])
    score = metric.score({"l": features}, animals, name="x", stimuli=labels)
    # Of one class every guess is right: the mean over properties had a part of 1.
    assert (score.status, math.isnan(score.value)) == ("undefined", True)
    # A class that is left out of three has no number that could be guessed.
    classes = metric.take(LabelledFeatures(np.eye(6), {"p": np.array([0, 0, 1, 1, 2, 2])}), np.arange(2, 6)).classes
    assert classes["p"].tolist() == [0, 0, 1, 1]


@pytest.mark.slow
def test_intervals_over_stimuli_hold_the_mean_accuracy_as_often_as_they_say():
    shape, place = np.repeat([0, 1], 6), np.tile([0, 1], 6)
    metric, rng, values, intervals = get_metric("decoding"), np.random.default_rng(0), [], []
    for _ in range(150):
        features = (
            rng.normal(size=(12, 12)) + 1.6 * np.outer(shape, np.eye(12)[0]) + 1.6 * np.outer(place, np.eye(12)[1])
        )
        layer = LabelledFeatures(features, {"shape": shape, "place": place})
        values.append(layer.right(np.arange(12)).mean())
        without = metric.compare_without([layer], [None])[:, 0, 0]
        intervals.append(two_factor_interval(values[-1], [values[-1]] * 2, without))
    mean = np.mean(values)
    # 83 to 89 % before the correction.
    assert np.mean([one.low <= mean <= one.high for one in intervals]) > 0.91
    widths = [one.high - one.low for one in intervals]
    assert np.mean(widths) < 1.4 * 3.92 * np.std(values)
