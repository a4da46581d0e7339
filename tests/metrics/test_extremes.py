"""Data at the edge: every one has a defined outcome, in a number or in words."""

from __future__ import annotations

import math
import resource
import sys

import numpy as np
import pytest

from brainbench.core.contracts import Trials
from brainbench.core.errors import DataError
from brainbench.metrics import compare, noise_corrected, rdm
from brainbench.metrics.measures.rsa import RSA, score_rdms
from brainbench.metrics.reliability.subject_rdm import subject_rdm
from tests.factories.animals import STIMULI, make_block, make_latent, make_rdm, make_subject

LABELS = np.repeat(np.arange(6), 8)


def _animal(responses, labels=LABELS, **options):
    return subject_rdm("a", [Trials(responses, labels)], 6, stimuli=STIMULI, splits=20, **options)


def _score(*animals, layer=None):
    layer = make_rdm(np.random.default_rng(0)) if layer is None else layer
    return score_rdms({"a": layer}, list(animals), name="x", stimuli=STIMULI)


def test_one_trial_per_stimulus_has_no_reliability_and_so_no_score():
    animal = _animal(np.random.default_rng(0).normal(size=(6, 5)), np.arange(6))
    assert "fewer than 2 trials of convex-close (1)" in animal.problem
    assert _score(animal).status == "undefined"


def test_no_spikes_at_all_have_no_geometry():
    animal = _animal(np.zeros((48, 5)))
    assert animal.problem.startswith("its RDM is undefined: the mean responses to a stimulus are constant")
    assert _score(animal).reasons[0] == "no animal can be used"
    flat = _animal(np.zeros((48, 5)), method="sqeuclidean")
    assert flat.problem == "its RDM is undefined: all pairs are equal"


def test_one_unit_has_squared_distances_but_no_correlation_distance():
    one = np.random.default_rng(1).normal(size=(48, 1)) + 3.0 * LABELS[:, None]
    assert "constant across units" in _animal(one).problem
    assert _animal(one, method="sqeuclidean").reliability > 0.9


def test_negative_and_vanishing_reliability_are_undefined_or_unreliable():
    assert noise_corrected(0.3, [-0.2, -0.1]).status == "undefined"
    almost = noise_corrected(0.3, [1e-6, 1e-6])
    assert (almost.status, almost.value > 100) == ("unreliable", True)
    assert noise_corrected(0.3, [0.0]).status == "undefined"
    score = _score(*(make_subject(f"m{i}", make_rdm(np.random.default_rng(i)), reliability=0.01) for i in range(3)))
    assert score.status == "unreliable"
    assert score.reasons[0] == "no animal is reliable"


def test_activations_that_are_nan_infinite_or_constant_are_never_chosen():
    rng = np.random.default_rng(2)
    broken = {
        "nan": np.full((6, 4), np.nan),
        "infinite": np.where(np.eye(6, 4) > 0, np.inf, 1.0),
        "constant": np.ones((6, 4)),
        "good": rng.normal(size=(6, 4)),
    }
    animals = [make_subject(f"m{i}", make_rdm(rng), seed=i) for i in range(3)]
    layers = {name: rdm(values) for name, values in broken.items()}
    score = score_rdms(layers, animals, name="x", stimuli=STIMULI)
    assert score.layer == "good"
    assert "layers without a value (constant or not finite), never chosen: nan, infinite, constant" in score.reasons


def test_infinite_trials_are_refused():
    with pytest.raises(DataError, match="infinite"):
        _animal(np.full((48, 3), np.inf))


@pytest.mark.parametrize("method", ["correlation", "sqeuclidean", "mahalanobis", "crossnobis"])
def test_a_huge_common_offset_costs_no_digits_that_were_there(method):
    rng = np.random.default_rng(3)
    # Multiples of 2⁻³⁰ stay exact when 1e8 is added.
    small = np.round(rng.normal(size=(6, 9))[LABELS] * 2**20 + rng.normal(size=(48, 9)) * 2**18) * 2.0**-26
    plain, moved = _animal(small, method=method), _animal(small + 1e8, method=method)
    np.testing.assert_allclose(moved.rdm, plain.rdm, rtol=1e-6, atol=1e-9)
    assert moved.reliability == pytest.approx(plain.reliability, abs=0.05)


def test_float32_agrees_with_float64_to_its_own_precision():
    rng = np.random.default_rng(4)
    values = rng.normal(size=(6, 5000)) + 100
    np.testing.assert_allclose(
        rdm(values.astype(np.float32)), rdm(values.astype(np.float32).astype(np.float64)), atol=1e-12
    )
    np.testing.assert_allclose(rdm(values.astype(np.float32)), rdm(values), atol=1e-4)


def test_a_hundred_thousand_units_are_an_animal():
    rng = np.random.default_rng(5)
    labels = np.repeat(np.arange(6), 4)
    responses = (rng.normal(size=(6, 100_000))[labels] + rng.normal(size=(24, 100_000))).astype(np.float32)
    animal = _animal(responses, labels)
    assert animal.units == 100_000
    assert animal.patterns.shape == (6, 100_000)
    assert math.isfinite(animal.reliability)


def test_two_stimuli_are_undefined_in_words():
    latent = make_latent(0, stimuli=2)
    animals = [subject_rdm(f"m{i}", [make_block(latent, seed=i)], 2, splits=5) for i in range(2)]
    score = score_rdms({"a": [0.4]}, animals, name="x", stimuli=["a", "b"])
    assert score.status == RSA().score_animals(animals, stimuli=["a", "b"]).status == "undefined"
    assert score.reasons[0].startswith("2 stimuli are too few")


@pytest.mark.slow
def test_two_thousand_stimuli_are_compared_and_tested():
    rng = np.random.default_rng(6)
    shared = rng.normal(size=(2000, 30))
    model, brain = rdm(shared), np.stack([rdm(shared + rng.normal(size=shared.shape)) for _ in range(2)])
    assert model.shape == (1_999_000,)
    for method in ("pearson", "spearman", "tau-a", "cosine", "whitened-pearson"):
        assert (compare(model, brain, method=method) > 0.1).all()


@pytest.mark.slow
def test_two_thousand_stimuli_and_a_hundred_thousand_units_fit_in_two_gigabytes():
    responses = np.empty((2000, 100_000), dtype=np.float32)
    generator = np.random.default_rng(7)
    for row in responses:
        generator.standard_normal(out=row, dtype=np.float32)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    found = rdm(responses)
    unit = 1 if sys.platform == "darwin" else 1024
    assert (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * unit < 2 * 2**30
    assert found.mean() == pytest.approx(1, abs=1e-3)


def test_an_animal_lacking_a_stimulus_is_named_and_one_animal_has_no_interval():
    latent = make_latent(8)
    lacking = subject_rdm("b", [make_block(latent, gap=(4,))], 6, stimuli=STIMULI)
    whole = subject_rdm("a", [make_block(latent)], 6, stimuli=STIMULI, splits=50)
    score = _score(whole, lacking)
    assert score.interval is None
    assert "animal b left out: no trials of 'concave-medium'" in score.reasons
    assert RSA(comparison="pearson").score_animals([whole, lacking], stimuli=STIMULI).status == "undefined"
