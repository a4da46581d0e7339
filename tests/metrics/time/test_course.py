"""Scores over time: what is known to be there is found, when and at which lag, and nothing else."""

from __future__ import annotations

import math

import numpy as np
import pytest

from brainbench.core.errors import UsageError
from brainbench.metrics.time import animal_movie, score_over_time
from tests.factories.moving_geometry import BIN, lagged, make_layer, make_movie, make_path, make_session


def _study(rng, *, stimuli=12, animals=5, bins=12, lag=2, onset=4, related=True, layers=3):
    """The middle layer is what the animals follow, unless nothing is related."""
    paths = [make_path(rng, stimuli, bins) for _ in range(layers)]
    source = paths[layers // 2] if related else make_path(rng, stimuli, bins)
    path = lagged(source, lag, onset)
    movies = [make_movie(rng, path, str(index)) for index in range(animals)]
    return {f"layer{index}": make_layer(rng, one) for index, one in enumerate(paths)}, movies


def test_a_geometry_is_found_when_it_appears_and_at_its_lag():
    layers, animals = _study(np.random.default_rng(0))
    course = score_over_time(layers, animals, width=BIN, permutations=199)
    assert course.layer == "layer1"
    assert course.p == 1 / 200
    p = np.array([point.p for point in course.points])
    assert (p[4:] <= 0.05).all()
    assert not (p[:4] <= 0.05).any()
    found = {item.layer: item for item in course.latencies}
    assert found["layer1"].latency == pytest.approx(2 * BIN, abs=0.2 * BIN)
    assert found["layer1"].interval.high - found["layer1"].interval.low < BIN
    assert math.isnan(found["layer0"].latency)
    assert "permuted" in found["layer0"].reason


def test_the_score_is_corrected_for_noise_and_undefined_where_nobody_is_reliable():
    layers, animals = _study(np.random.default_rng(1))
    course = score_over_time(layers, animals, width=BIN, permutations=50)
    early, late = course.points[2], course.points[8]
    assert early.animals == 0
    assert math.isnan(early.value)
    assert math.isfinite(early.r)
    assert late.animals == 5
    assert late.value == pytest.approx(late.r / math.sqrt(0.9))
    assert late.interval.low < late.value < late.interval.high
    assert any("4 of 12 bins" in reason for reason in course.reasons)
    assert [point.time for point in course.points[:2]] == pytest.approx([BIN / 2, 3 * BIN / 2])


def test_unrelated_models_are_found_at_some_time_in_one_study_of_twenty():
    found, layers_found = [], []
    for seed in range(150):
        layers, animals = _study(np.random.default_rng([7, seed]), stimuli=7, animals=4, bins=6, related=False)
        course = score_over_time(layers, animals, width=BIN, permutations=59, seed=seed)
        found.append(min(point.p for point in course.points if math.isfinite(point.p)) <= 0.05)
        layers_found.append(min(item.p for item in course.latencies) <= 0.05)
    # 99.9 % limits of 150 draws at 5 %.
    assert 1 <= sum(found) <= 18
    assert 1 <= sum(layers_found) <= 18


def test_intervals_of_the_latency_hold_it():
    hits, widths = [], []
    for seed in range(40):
        layers, animals = _study(np.random.default_rng([8, seed]), stimuli=10, animals=5, bins=10, layers=1, onset=0)
        (item,) = score_over_time(layers, animals, width=BIN, permutations=39).latencies
        if item.interval is not None:
            hits.append(item.interval.low <= 2 * BIN <= item.interval.high)
            widths.append(item.interval.high - item.interval.low)
    assert len(hits) >= 36
    assert np.mean(hits) >= 0.85
    assert np.median(widths) < BIN


def test_neurons_may_lead_the_model():
    rng = np.random.default_rng(3)
    path = make_path(rng, 12, 12)
    animals = [make_movie(rng, path, str(index)) for index in range(5)]
    course = score_over_time({"late": make_layer(rng, lagged(path, 1))}, animals, width=BIN, permutations=59)
    assert course.latencies[0].latency == pytest.approx(-BIN, abs=0.2 * BIN)


def test_a_layer_without_time_has_a_score_but_no_latency():
    rng = np.random.default_rng(4)
    path = np.repeat(make_path(rng, 12, 1), 8, axis=0)
    animals = [make_movie(rng, path, str(index)) for index in range(4)]
    course = score_over_time({"static": make_layer(rng, path)[:1]}, animals, width=BIN, permutations=59)
    assert course.p <= 0.05
    assert math.isnan(course.latencies[0].latency)
    assert course.latencies[0].reason == "the layer has no time"


def test_few_animals_or_stimuli_are_said():
    layers, animals = _study(np.random.default_rng(5), stimuli=6, animals=1)
    course = score_over_time(layers, animals, width=BIN, permutations=19)
    assert any("there are 1 and 6" in reason for reason in course.reasons)
    assert all(point.interval is None for point in course.points)
    assert all(item.interval is None for item in course.latencies)


def test_animals_that_are_reliable_at_no_time_give_no_latency():
    rng = np.random.default_rng(10)
    path = make_path(rng, 10, 8)
    animals = [make_movie(rng, path, str(index), reliability=0.3) for index in range(4)]
    course = score_over_time({"layer": make_layer(rng, path)}, animals, width=BIN, permutations=39)
    assert math.isnan(course.latencies[0].latency)
    assert "reliable" in course.latencies[0].reason
    assert course.p <= 0.05


def test_the_order_of_stimuli_does_not_matter():
    layers, animals = _study(np.random.default_rng(6), stimuli=9)
    from dataclasses import replace

    from brainbench.metrics.rdms.pairs import permuted_pairs

    pairs = permuted_pairs(np.random.default_rng(0).permutation(9)[None])[0]
    moved = [replace(item, rdms=item.rdms[:, pairs]) for item in animals]
    one = score_over_time(layers, animals, width=BIN, permutations=99)
    two = score_over_time({name: movie[:, pairs] for name, movie in layers.items()}, moved, width=BIN, permutations=99)
    np.testing.assert_allclose([point.p for point in one.points], [point.p for point in two.points])
    np.testing.assert_allclose(
        [item.latency for item in one.latencies], [item.latency for item in two.latencies], atol=1e-9
    )


def test_trials_are_enough():
    rng = np.random.default_rng(9)
    path = make_path(rng, 10, 10)
    sessions = [make_session(rng, lagged(path, 1), noise=1.0) for _ in range(4)]
    animals = [animal_movie(str(i), [one], 10, splits=20) for i, one in enumerate(sessions)]
    course = score_over_time({"layer": make_layer(rng, path)}, animals, width=BIN, permutations=99)
    assert course.latencies[0].latency == pytest.approx(BIN, abs=0.3 * BIN)
    assert course.p <= 0.05


def test_misuse_is_told_in_a_sentence():
    layers, animals = _study(np.random.default_rng(0), bins=6, stimuli=6)
    with pytest.raises(UsageError, match="one layer and one animal"):
        score_over_time({}, animals, width=BIN)
    with pytest.raises(UsageError, match="whitened-cosine"):
        score_over_time(layers, animals, width=BIN, comparison="whitened-cosin")
    with pytest.raises(UsageError, match="'layer0'"):
        score_over_time({"layer0": np.ones((6, 10))}, animals, width=BIN)
    with pytest.raises(UsageError, match="received 0"):
        score_over_time(layers, animals, width=0.0)
    short, few = _study(np.random.default_rng(0), bins=2, lag=0, onset=0)
    with pytest.raises(UsageError, match="3 bins"):
        score_over_time(short, few, width=BIN)
