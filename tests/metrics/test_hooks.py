"""What every metric has unless it says otherwise."""

from __future__ import annotations

import numpy as np
import pytest

from brainbench.core.errors import UsageError
from brainbench.metrics.hooks import MetricHooks, usable_features
from tests.factories.animals import make_rdm, make_subject


class _Counts(MetricHooks):
    """Compares nothing but how many stimuli there are, and their sum."""

    name = "counts"
    title = "number of stimuli"

    def compare_layers(self, layers, animals, chunks, device=None):
        for orders in chunks:
            yield np.array([[[layer[order].sum() for _ in animals] for layer in layers] for order in orders])


@pytest.mark.parametrize("scale", [1e-200, 1.0, 1e200])
def test_features_are_rescaled_by_powers_of_two_where_squares_would_overflow(scale):
    features = np.random.default_rng(0).normal(size=(5, 4)) * scale
    found = usable_features(features)
    exponent = np.log2(found / features)
    assert np.isfinite(found**2).all()
    assert (found**2 > 0).all()
    assert np.ptp(exponent) == pytest.approx(0, abs=1e-9)
    assert exponent.flat[0] == pytest.approx(round(exponent.flat[0]), abs=1e-9)
    if scale == 1:
        np.testing.assert_array_equal(found, features)


def test_a_stimulus_with_a_value_that_is_not_finite_has_none():
    features = np.arange(12.0).reshape(4, 3)
    features[1, 2], features[3, 0] = np.inf, np.nan
    metric = _Counts()
    layer = metric.layer(features)
    assert metric.defined(layer).tolist() == [True, False, True, False]
    np.testing.assert_array_equal(layer[[0, 2]], features[[0, 2]])
    assert metric.varies(layer[[0, 2]])
    assert not metric.varies(layer[[0, 0]])


def test_each_stimulus_is_left_out_in_turn_of_more_than_three():
    animals = [make_subject(f"m{i}", make_rdm(np.random.default_rng(i)), seed=i) for i in range(2)]
    count = animals[0].count
    layer = np.arange(1.0, count + 1)[:, None]
    values = _Counts().compare_without([layer], animals)
    assert values.shape == (count, 1, 2)
    np.testing.assert_array_equal(values[:, 0, 0], layer.sum() - layer[:, 0])
    few = [animal.take(np.arange(3)) for animal in animals]
    assert np.isnan(_Counts().compare_without([layer[:3]], few)).all()


def test_a_metric_without_a_comparison_says_so():
    with pytest.raises(UsageError, match="does not define a comparison"):
        next(iter(MetricHooks().compare_layers([], [], [])))
    assert _Counts().describe([]) == "counts: number of stimuli"
