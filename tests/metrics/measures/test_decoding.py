"""Decoding of labels' properties, as a metric."""

from __future__ import annotations

import math

import numpy as np
import pytest

from brainbench.core.statistics import two_factor_interval
from brainbench.core.trials import Trials
from brainbench.metrics import get_metric
from brainbench.metrics.measures.classifier import decode
from brainbench.metrics.measures.decoding import LabelDecoding, LabelledFeatures, label_properties

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
