"""The scale that all metrics share: chance is 0, and a model of all that is reliable is 1."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from brainbench.core.contracts import Trials
from brainbench.metrics import get_metric
from brainbench.metrics.measures.decoding import LabelDecoding
from brainbench.metrics.reliability.subject_rdm import denoised

METRICS = ("rsa", "rsa-correlation", "rsa-crossnobis", "rsa-partial", "cka", "procrustes", "ridge", "decoding")
PLACES, SHAPES = ("close", "far"), ("flat", "round")


@pytest.fixture(autouse=True)
def _few_orders(monkeypatch):
    """Decoding fits anew in every order; a few tell a status."""
    monkeypatch.setattr(LabelDecoding, "orders", 39)
    monkeypatch.setattr(LabelDecoding, "orders_between", 39)


def _make(stimuli, noise=2.0, animals=6, trials=14, units=50, dims=6, seed=0):
    """Features that labels and units follow, and trials of animals that turn these features and add noise."""
    rng = np.random.default_rng(seed)
    names = [f"{SHAPES[k % 2]}-{PLACES[k // 2 % 2]}-{k // 4}" for k in range(stimuli)]
    features = rng.normal(size=(stimuli, dims))
    # Two of the features separate what the labels name.
    features[:, 0] = np.arange(stimuli) % 2 * 4.0 - 2
    features[:, 1] = np.arange(stimuli) // 2 % 2 * 4.0 - 2
    labels = np.repeat(np.arange(stimuli), trials)
    blocks = []
    for animal in range(animals):
        turned = features @ np.linalg.qr(rng.normal(size=(units, dims)))[0].T * np.sqrt(units / dims)
        responses = turned[labels] + noise * rng.normal(size=(len(labels), units))
        keys = [f"{animal}/{trial}" for trial in range(len(labels))]
        blocks.append(Trials(responses, labels, keys, {"licks": rng.poisson(3, len(labels)) * 1.0}))
    return names, features, blocks


def _score(metric, names, blocks, layers, **options):
    animals = [metric.animal(f"m{i}", [b], len(names), stimuli=names, splits=100) for i, b in enumerate(blocks)]
    return metric.score(layers, animals, name="x", stimuli=names, **options)


@pytest.mark.parametrize("name", [*METRICS[:-1], pytest.param("decoding", marks=pytest.mark.slow)])
@pytest.mark.parametrize("noise", [2.0, 5.0])
def test_a_perfect_model_reaches_one_and_an_unrelated_one_zero(name, noise):
    metric = get_metric(name)
    if name == "decoding" and noise > 2:
        pytest.skip("the accuracy of the model does not depend on the animals' noise")
    names, features, blocks = _make(16 if name == "decoding" else 12, noise)
    perfect = _score(metric, names, blocks, {"a": features})
    low, high = perfect.scaled_interval.low, perfect.scaled_interval.high
    assert low - 0.05 <= 1 <= high + 0.05, (perfect.scaled, low, high)
    assert perfect.scaled == pytest.approx(1, abs=0.15)
    unrelated = [
        _score(metric, names, blocks[:3], {"a": np.random.default_rng(seed).normal(size=features.shape)}).scaled
        for seed in range(3 if name != "decoding" else 1)
    ]
    assert abs(np.mean(unrelated)) < (0.25 if name != "decoding" else 0.6), unrelated


@pytest.mark.slow
@pytest.mark.parametrize("name", METRICS[:-1])
def test_a_perfect_model_reaches_one_at_six_and_at_forty_stimuli(name):
    for stimuli in (8, 40):
        names, features, blocks = _make(stimuli, 3.0)
        perfect = _score(get_metric(name), names, blocks, {"a": features})
        assert perfect.scaled == pytest.approx(1, abs=0.15), stimuli


def test_denoised_patterns_have_the_products_of_the_truth():
    rng = np.random.default_rng(2)
    truth, found = rng.normal(size=(10, 3)) @ rng.normal(size=(3, 80)), []
    noise = rng.uniform(0.5, 2.0, size=truth.shape)
    for _ in range(60):
        patterns = denoised(truth + np.sqrt(noise) * rng.normal(size=truth.shape), noise)
        centred = patterns - patterns.mean(axis=0)
        found.append(np.trace(centred @ centred.T))
    centred = truth - truth.mean(axis=0)
    assert np.mean(found) == pytest.approx(np.trace(centred @ centred.T), rel=0.05)


def test_noise_adds_no_dimensions_to_denoised_patterns():
    """Eigenvalues that noise made would be predicted by nothing, and lower what a perfect encoder attains."""
    rng = np.random.default_rng(3)
    truth = rng.normal(size=(40, 5)) @ rng.normal(size=(5, 60))
    noise = np.full(truth.shape, 2.5)
    noisy = truth + np.sqrt(noise) * rng.normal(size=truth.shape)
    patterns = denoised(noisy, noise)
    real, spread, values = (np.linalg.eigvalsh(np.cov(part.T))[::-1] for part in (truth, noisy, patterns))
    assert spread[:5].sum() < 0.8 * spread.sum()
    assert values[:5].sum() > 0.95 * values.sum()
    np.testing.assert_allclose(values[:5], real[:5], rtol=0.2)
    units = rng.permutation(60)
    np.testing.assert_allclose(denoised(noisy[:, units], noise[:, units]), patterns[:, units], atol=1e-8)


@pytest.mark.parametrize("name", ["rsa", "rsa-correlation", "cka", "ridge", "procrustes"])
@pytest.mark.parametrize("scale", [1e300, 1e-300])
def test_the_scale_of_activations_changes_nothing(name, scale):
    names, features, blocks = _make(8)
    metric = get_metric(name)
    plain = _score(metric, names, blocks, {"a": features})
    scaled = _score(metric, names, blocks, {"a": scale * features})
    assert (scaled.status, scaled.value, scaled.p) == (plain.status, pytest.approx(plain.value, rel=1e-7), plain.p)


@pytest.mark.parametrize("name", ["rsa-correlation", "rsa", "ridge"])
def test_a_layer_without_a_value_for_a_stimulus_is_scored_on_the_others(name):
    names, features, blocks = _make(10)
    metric = get_metric(name)
    # A silent stimulus has no correlation distance; a stimulus that is not finite has no distance at all.
    broken = features.copy()
    broken[3] = 0.0 if name == "rsa-correlation" else np.nan
    found = _score(metric, names, blocks, {"whole": features, "part": broken})
    assert any("part (1 of 10)" in reason for reason in found.reasons)
    part = next(layer for layer in found.layers if layer.layer == "part")
    kept = [k for k in range(10) if k != 3]
    alone = [
        Trials(b.responses[b.labels != 3], np.searchsorted(kept, b.labels[b.labels != 3]), None, {}) for b in blocks
    ]
    rest = _score(metric, [names[k] for k in kept], alone, {"a": features[kept]})
    assert found.on_scale(part.value) == pytest.approx(rest.scaled, abs=0.05)
    only = _score(metric, names, blocks, {"part": broken})
    assert (only.status, only.layer) == ("ok", "part")
    assert len(only.without_stimulus) == 10
    # The animals' reliability without a stimulus is another one.
    assert only.without_stimulus[3] == pytest.approx(only.value, abs=0.005)
    assert only.p < 0.05


def test_a_committed_layer_is_scored_and_recorded_and_its_test_is_its_own():
    names, features, blocks = _make(8)
    rng = np.random.default_rng(3)
    layers = {"true": features, "weak": features + 3 * rng.normal(size=features.shape)}
    metric = get_metric("rsa")
    found = _score(metric, names, blocks, layers, layer="weak")
    assert (found.layer, found.layer_rule) == ("weak", "committed to beforehand")
    alone = _score(metric, names, blocks, {"weak": layers["weak"]})
    assert (found.value, found.p, found.chance) == (alone.value, alone.p, alone.chance)
    assert [layer.layer for layer in found.layers] == ["true", "weak"]
    with pytest.raises(ValueError, match="did you mean 'weak'"):
        _score(metric, names, blocks, layers, layer="waek")
    gone = _score(metric, names, blocks, layers | {"flat": np.ones((8, 2))}, layer="flat")
    assert gone.status == "undefined"
    assert "'flat'" in gone.reasons[0]


def test_folds_of_ridge_do_not_depend_on_the_order_of_stimuli():
    names, features, blocks = _make(13)
    order = np.random.default_rng(4).permutation(13)
    moved = [Trials(b.responses, np.argsort(order)[b.labels], b.keys) for b in blocks]
    metric = get_metric("ridge")
    first = _score(metric, names, blocks, {"a": features})
    second = _score(metric, [names[k] for k in order], moved, {"a": features[order]})
    assert (second.value, second.p) == (pytest.approx(first.value, abs=1e-9), first.p)
    assert second.attainable == pytest.approx(first.attainable, abs=1e-9)
    np.testing.assert_allclose(second.without_stimulus, np.array(first.without_stimulus)[order], atol=1e-9)


@pytest.mark.parametrize("name", ["cka", "procrustes", "ridge", "rsa-partial"])
def test_what_is_attainable_does_not_depend_on_the_order_of_units(name):
    names, features, blocks = _make(8)
    rng = np.random.default_rng(6)
    units = (rng.permutation(block.responses.shape[1]) for block in blocks)
    moved = [replace(block, responses=block.responses[:, order]) for block, order in zip(blocks, units, strict=True)]
    first, second = (_score(get_metric(name), names, each, {"a": features}) for each in (blocks, moved))
    assert second.attainable == pytest.approx(first.attainable, abs=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("name", METRICS)
def test_animals_of_noise_alone_are_no_ground_for_a_score(name):
    names, features, blocks = _make(8, animals=3)
    rng = np.random.default_rng(5)
    noise = [Trials(rng.normal(size=b.responses.shape), b.labels, b.keys, b.covariates) for b in blocks]
    assert _score(get_metric(name), names, noise, {"a": features}).status in ("unreliable", "undefined")


@pytest.mark.parametrize("name", METRICS)
def test_what_is_too_little_has_a_status_and_a_reason(name):
    metric = get_metric(name)
    names, features, blocks = _make(8, animals=2)
    alone = _score(metric, names, blocks[:1], {"a": features, "b": features[:, :2]})
    assert alone.interval is None
    assert any("one animal" in reason for reason in alone.reasons)
    equal = [Trials(np.ones_like(b.responses), b.labels, b.keys, b.covariates) for b in blocks]
    same = _score(metric, names, equal, {"a": features})
    assert (same.status, bool(same.reasons[0])) == ("undefined", True)
    two = [
        Trials(b.responses[b.labels < 2], b.labels[b.labels < 2], None, {"licks": b.covariates["licks"][b.labels < 2]})
        for b in blocks
    ]
    few = _score(metric, names[:2], two, {"a": features[:2]})
    assert few.status == "undefined"
    assert few.reasons[0]
