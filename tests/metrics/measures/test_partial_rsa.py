"""RSA without what contacts, licks and choices explain."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from brainbench.core.contracts import Trials
from brainbench.metrics import get_metric, rdm
from brainbench.metrics.measures.patterns import partial_correlations, variance_partition

STIMULI = list("abcdefg")
LABELS = np.tile(np.arange(7), 12)


TOUCHES = np.arange(7.0)
COUNTER = np.concatenate([TOUCHES[:, None] > TOUCHES[:-1], TOUCHES[:, None] <= TOUCHES[:-1]], axis=1) - 0.5
"""Units that count touches: their correlation distance is proportional to the difference in touches."""


def _make_blocks(latent, *, number=4, seed=0):
    """Animals of which some units follow a latent geometry and some count touches."""
    rng = np.random.default_rng(seed)
    blocks = []
    for _ in range(number):
        means = np.concatenate([latent @ rng.normal(size=(latent.shape[1], 60)), np.tile(4 * COUNTER, (1, 3))], axis=1)
        trials = means[LABELS] + 0.3 * rng.normal(size=(len(LABELS), means.shape[1]))
        blocks.append(Trials(trials, LABELS, None, {"contacts": TOUCHES[LABELS] + 0.1 * rng.normal(size=len(LABELS))}))
    return blocks


def _animals(name, blocks):
    return [get_metric(name).animal(f"m{i}", [block], 7, stimuli=STIMULI) for i, block in enumerate(blocks)]


def _score(metric, animals, features):
    return metric.score({"l": features}, animals, name="x", stimuli=STIMULI)


@pytest.mark.slow
def test_a_model_that_counts_touches_scores_by_rsa_and_not_beyond_touches():
    latent = np.random.default_rng(1).normal(size=(7, 3))
    blocks = _make_blocks(latent)
    metric = get_metric("rsa-partial")
    wide = latent @ np.random.default_rng(9).normal(size=(3, 300))
    scores = {
        name: [
            _score(get_metric(name), _animals(name, blocks), features)
            for features in (COUNTER + 1e-3 * wide[:, :12], wide)
        ]
        for name in ("rsa", "rsa-partial")
    }
    assert scores["rsa"][0].value > 0.5
    assert scores["rsa"][0].p < 0.05
    counter, true = scores["rsa-partial"]
    assert counter.p > 0.05 > true.p
    assert true.value > 0.7
    shares = true.provenance["statistics"]["variance_partition"]
    assert shares["nuisances"] == ["contacts"]
    assert shares["unique_model"] > shares["chance"]
    assert shares["total"] == pytest.approx(shares["unique_model"] + shares["unique_nuisance"] + shares["shared"])
    assert counter.provenance["statistics"]["variance_partition"]["unique_model"] < 0.1
    assert metric.score_animals(_animals("rsa-partial", blocks), stimuli=STIMULI).value > true.value


def test_one_model_and_one_animal_give_what_the_variance_partition_gives():
    rng = np.random.default_rng(2)
    animals = _animals("rsa-partial", _make_blocks(rng.normal(size=(7, 3)), number=1))
    features = rng.normal(size=(7, 20))
    score = _score(get_metric("rsa-partial"), animals, features)
    expected = variance_partition(rdm(features), animals[0].nuisances, rdm(animals[0].patterns))
    assert score.value == pytest.approx(expected.partial_r, abs=1e-12)


def test_partial_correlation_is_that_of_regression_residuals():
    rng = np.random.default_rng(3)
    model, rivals, brain = rng.normal(size=15), rng.normal(size=(2, 15)), rng.normal(size=15)
    design = np.column_stack([np.ones(15), rivals.T])

    def residual(y):
        return y - design @ np.linalg.lstsq(design, y, rcond=None)[0]

    expected = np.corrcoef(residual(model), residual(brain))[0, 1]
    assert partial_correlations(model[None], rivals, brain)[0] == pytest.approx(expected, abs=1e-12)
    assert np.isnan(partial_correlations(model[None], rivals, rivals[0])[0])
    assert np.isnan(partial_correlations(model[None, :3], rivals[:, :3], brain[:3])[0])


def test_recordings_without_covariates_are_undefined_in_words():
    metric = get_metric("rsa-partial")
    trials = np.random.default_rng(4).normal(size=(len(LABELS), 9))
    constant = {"licks": np.ones(len(LABELS)), "choice": np.full(len(LABELS), np.nan)}
    for seen, told in (({}, "differ between stimuli"), (constant, r"(licks, choice do not)")):
        animal = metric.animal("m", [Trials(trials, LABELS, None, seen)], 7)
        score = _score(metric, [animal], np.eye(7))
        assert score.status == "undefined"
        assert "no contacts, licks or choices" in score.reasons[-1]
        assert told in score.reasons[-1]


def test_contacts_of_a_session_that_is_left_out_do_not_count():
    (block,) = _make_blocks(np.random.default_rng(1).normal(size=(7, 3)), number=1)
    short = Trials(block.responses[7:], LABELS[7:], None, {"contacts": 100.0 * (LABELS[7:] == 3)}).take(LABELS[7:] != 6)
    one, two = (get_metric("rsa-partial").animal("m", given, 7, stimuli=STIMULI) for given in ([block], [block, short]))
    np.testing.assert_array_equal(two.rdm, one.rdm)
    np.testing.assert_array_equal(two.nuisances["contacts"], one.nuisances["contacts"])


def test_a_layer_that_the_nuisances_explain_wholly_is_not_called_constant():
    metric, latent = get_metric("rsa-partial"), np.random.default_rng(4).normal(size=(7, 3))
    animals = _animals("rsa-partial", _make_blocks(latent, number=3))
    animals = [replace(one, nuisances={"touches": rdm(COUNTER)}) for one in animals]
    score = _score(metric, animals, COUNTER)
    assert score.status == "undefined"
    assert "not comparable with every animal" in score.reasons[0]
    both = metric.score({"known": latent, "counter": COUNTER}, animals, name="x", stimuli=STIMULI)
    assert any("not comparable" in reason and "counter" in reason for reason in both.reasons)
