"""Noise correction against the published splits and against simulated truth."""

from __future__ import annotations

import math

import numpy as np
import pytest

from brainbench.core.contracts import Trials
from brainbench.core.errors import UsageError
from brainbench.metrics import compare, noise_ceiling, noise_corrected, rdm
from brainbench.metrics.rdms.comparison import COMPARISONS
from brainbench.metrics.reliability.noise_correction import (
    RELIABILITY_GATE,
    corrected_splits,
    correction_by,
    spearman_brown,
)
from brainbench.metrics.reliability.subject_rdm import subject_rdm
from tests.factories.animals import THEIRS, make_block, make_latent


@pytest.fixture(scope="module")
def published(reference):
    with np.load(reference / "rsa" / "thesis_model_input_rsa_plain.npz") as stored:
        return {name: stored[name] for name in stored.files}


@pytest.mark.shared
def test_the_published_split_ratios_are_reproduced(published):
    ratio = corrected_splits(published["r_xy"], published["r_yy"], published["r_xx"])
    np.testing.assert_array_equal(np.isnan(ratio), np.isnan(published["r_xy_n_sb"]))
    np.testing.assert_array_almost_equal_nulp(ratio[~np.isnan(ratio)], published["r_xy_n_sb"][~np.isnan(ratio)], 2)
    np.testing.assert_array_equal(spearman_brown(published["r_yy"]), published["r_yy_sb"])
    assert np.isnan(ratio).sum() == 286
    assert np.nanmean(ratio) == pytest.approx(0.59880, abs=5e-6)


@pytest.mark.shared
def test_the_published_input_score_is_the_unfiltered_median(published):
    result = noise_corrected(published["r_xy"], published["r_yy"], estimator="thesis-input")
    assert result.value == np.nanmedian(published["r_xy_n_sb"])
    assert result.value == pytest.approx(0.45774, abs=5e-6)
    assert result.splits == 1000 - 286


@pytest.mark.shared
def test_the_published_model_estimator_on_the_same_splits(published):
    result = noise_corrected(published["r_xy"], published["r_yy"], estimator="thesis")
    assert result.value == pytest.approx(0.32945, abs=5e-6)
    assert result.splits == 75
    assert result.r == pytest.approx(0.28345, abs=5e-6)


@pytest.mark.shared
def test_the_default_on_the_published_splits_is_reported_but_not_trusted(published):
    result = noise_corrected(published["r_xy"], published["r_yy"])
    assert result.value == pytest.approx(0.5705, abs=5e-5)
    assert result.status == "unreliable"
    assert result.reason.startswith("reliability 0.25 is below 0.5")


def test_spearman_brown_inverts_halving():
    whole = np.array([0.1, 0.5, 0.9, 1.0])
    np.testing.assert_allclose(spearman_brown(whole / (2 - whole)), whole, rtol=1e-15)
    assert np.isnan(spearman_brown(-1.0))


def test_a_noiseless_brain_is_not_corrected():
    result = noise_corrected(0.6, np.ones(10))
    assert (result.value, result.status, result.reliability) == (0.6, "ok", 1.0)


def test_one_and_both_sides_divide_by_the_root_of_each_reliability():
    half, other = 0.6, 0.8
    one = noise_corrected(0.5, [half])
    both = noise_corrected(0.5, [half], other_split_half_r=[other])
    assert one.value == pytest.approx(0.5 / math.sqrt(0.75))
    assert both.value == pytest.approx(0.5 / math.sqrt(0.75 * (2 * other / (1 + other))))


def test_splits_are_averaged_before_spearman_and_brown():
    halves = np.array([0.2, 0.9])
    assert noise_corrected(0.4, halves).value == pytest.approx(0.4 / math.sqrt(float(spearman_brown(0.55))))


def test_nothing_is_clamped():
    assert noise_corrected(0.9, [0.5]).value > 1
    assert noise_corrected(-0.9, [0.5]).value < -1


@pytest.mark.parametrize("half", [0.0, -0.2])
def test_a_reliability_that_is_not_positive_is_undefined(half):
    result = noise_corrected(0.5, [half])
    assert math.isnan(result.value)
    assert result.status == "undefined"
    assert "not positive" in result.reason


def test_two_negative_reliabilities_do_not_pass_as_one_positive():
    assert noise_corrected(0.5, [-0.3], other_split_half_r=[-0.3]).status == "undefined"
    assert np.isfinite(corrected_splits(0.5, [-0.3], [-0.3])).all(), "the published fault"


def test_the_gate_lies_between_reliable_and_unreliable():
    half = RELIABILITY_GATE / (2 - RELIABILITY_GATE)
    assert noise_corrected(0.3, [half + 1e-9]).status == "ok"
    assert noise_corrected(0.3, [half - 1e-9]).status == "unreliable"


def test_an_undefined_comparison_is_undefined_whatever_the_reliability():
    for estimator in ("default", "thesis", "thesis-input"):
        result = noise_corrected(math.nan, [0.9, 0.8], estimator=estimator)
        assert result.status == "undefined"
        assert "comparison of the RDMs is undefined" in result.reason


def test_a_filter_that_keeps_no_split_is_undefined():
    result = noise_corrected(0.5, [0.4, 0.3], estimator="thesis")
    assert (result.status, result.splits) == ("undefined", 0)
    assert "at least 0.5" in result.reason


def test_misuse_is_told_in_a_sentence():
    with pytest.raises(UsageError, match="did you mean 'thesis'"):
        noise_corrected(0.5, [0.5], estimator="thesis-")
    with pytest.raises(UsageError, match="received 3, 2"):
        noise_corrected([0.1, 0.2, 0.3], [0.5, 0.6])


def _simulated_errors(count, noise, seed, true_r=None):
    """Corrected minus true r for animals of one noise level, with their estimated reliabilities."""
    rng = np.random.default_rng(seed)
    errors, reliabilities = [], []
    for animal in range(count):
        latent = make_latent(rng.integers(1 << 31))
        model_rdm = rdm(latent + 0.15 * rng.normal(size=latent.shape))
        clean = make_block(latent, seed=animal, units=60, repeats=2, noise=0.0)
        found = subject_rdm("a", [make_block(latent, seed=animal, units=60, repeats=20, noise=noise)], 6, splits=100)
        truth = float(compare(model_rdm, rdm(clean.responses, clean.labels)))
        errors.append(noise_corrected(float(compare(model_rdm, found.rdm)), found.split_half_r).value - truth)
        reliabilities.append(found.reliability)
    return np.array(errors), np.array(reliabilities)


def test_truth_is_recovered_at_high_signal_and_flagged_at_low_signal():
    errors, reliabilities = _simulated_errors(60, noise=3.0, seed=1)
    assert reliabilities.min() > 0.8
    assert abs(errors.mean()) < 0.01
    _, reliabilities = _simulated_errors(20, noise=40.0, seed=2)
    assert (reliabilities < RELIABILITY_GATE).mean() > 0.9


def test_products_of_halves_tell_the_noise_of_unbiased_distances_where_spearman_and_brown_do_not():
    rng, unbiased, lengthened = np.random.default_rng(5), [], []
    stimuli, trials = 30, 7
    labels = np.repeat(np.arange(stimuli), trials)
    for animal in range(40):
        patterns = rng.normal(size=(stimuli, 8)) @ rng.normal(size=(8, 60)) / math.sqrt(8)
        responses = patterns[labels] + 3.4 * rng.normal(size=(len(labels), 60))
        keys = [f"{animal}/{trial}" for trial in range(len(labels))]
        how = {"method": "crossnobis", "comparison": "whitened-cosine", "noise": "none", "splits": 40}
        subject = subject_rdm("a", [Trials(responses, labels, keys)], stimuli, **how)
        r = float(compare(rdm(patterns, method="sqeuclidean"), subject.rdm, method="whitened-cosine"))
        unbiased.append(r * correction_by(subject.reliability).value)
        lengthened.append(noise_corrected(r, subject.split_half_r).value)
        assert subject.reliability == pytest.approx(float(subject.signal.mean()))
    # A perfect model has the value 1.
    assert np.mean(unbiased) == pytest.approx(1.0, abs=0.02)
    assert np.mean(lengthened) > 1.05


@pytest.mark.slow
def test_bias_is_small_above_the_gate_and_errors_are_gross_below_it():
    errors, reliabilities = _simulated_errors(3000, noise=9.0, seed=3)
    more, further = _simulated_errors(2000, noise=16.0, seed=4)
    errors, reliabilities = np.concatenate([errors, more]), np.concatenate([reliabilities, further])
    above = (reliabilities >= RELIABILITY_GATE) & (reliabilities < RELIABILITY_GATE + 0.2)
    below = (reliabilities > 0) & (reliabilities < 0.2)
    assert above.sum() > 300
    assert abs(errors[above].mean()) < 0.05
    assert np.sqrt((errors[above] ** 2).mean()) < 0.25
    assert np.sqrt((errors[below] ** 2).mean()) > 0.4


@pytest.mark.parametrize(("r", "halves"), [(2.0, [0.9, 0.8]), (0.5, [1.9, 1.8])])
def test_what_is_no_correlation_is_refused(r, halves):
    with pytest.raises(UsageError, match="from -1 to 1"):
        noise_corrected(r, halves)


def _make_animals(count=7, seed=0):
    rng = np.random.default_rng(seed)
    return rng.gamma(3.0, size=15) + 0.5 * rng.gamma(2.0, size=(count, 15))


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("missing", [False, True])
@pytest.mark.parametrize("method", COMPARISONS)
def test_ceilings_equal_rsatoolbox(method, missing):
    rsa = pytest.importorskip("rsatoolbox.rdm")
    from rsatoolbox.inference.noise_ceiling import boot_noise_ceiling

    animals = _make_animals()
    if missing:
        animals[:, 4] = np.nan
    expected = boot_noise_ceiling(rsa.RDMs(animals), method=THEIRS[method])
    # With missing pairs rsatoolbox' whitening is the closed form of complete RDMs, an approximation.
    tolerance = 0.02 if missing and "whitened" in method else 1e-10
    np.testing.assert_allclose(noise_ceiling(animals, method=method), expected, atol=tolerance)


def test_a_pair_missing_in_one_animal_is_left_out_for_all():
    animals = _make_animals()
    everywhere = animals.copy()
    animals[2, 4] = np.nan
    everywhere[:, 4] = np.nan
    np.testing.assert_allclose(noise_ceiling(animals), noise_ceiling(everywhere), atol=1e-13)


def test_the_ceiling_brackets_the_true_geometry():
    rng = np.random.default_rng(1)
    inside = []
    for _ in range(60):
        truth = rng.normal(size=15)
        animals = truth + 0.7 * rng.normal(size=(8, 15))
        lower, upper = noise_ceiling(animals)
        r = np.mean([np.corrcoef(truth, animal)[0, 1] for animal in animals])
        inside.append((lower < r, r < upper))
    assert np.mean(inside, axis=0).min() > 0.9


def test_one_animal_has_no_ceiling_and_says_why():
    found = noise_ceiling(_make_animals(1))
    lower, upper = found
    assert np.isnan([lower, upper]).all()
    assert "at least two animals" in found.reason
    assert noise_ceiling(_make_animals(2)).reason == ""


def test_the_order_of_animals_is_irrelevant():
    animals = _make_animals()
    np.testing.assert_allclose(noise_ceiling(animals[::-1]), noise_ceiling(animals), atol=1e-13)


def test_ceilings_refuse_what_they_cannot_take():
    with pytest.raises(UsageError, match=r"all animals \[A, P\]"):
        noise_ceiling(np.ones(15))
    with pytest.raises(UsageError, match="Unknown RDM comparison"):
        noise_ceiling(_make_animals(), method="corr")
