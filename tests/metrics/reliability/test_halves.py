"""Split halves: their definition, their independence of order, and what cannot be split."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from brainbench.core.contracts import Trials
from brainbench.core.errors import DataError, UsageError
from brainbench.metrics import compare, rdm
from brainbench.metrics.rdms.comparison import permuted_pairs
from brainbench.metrics.reliability.halves import (
    SplitRDMs,
    members,
    reliable_units,
    split_members,
    tuning_by_chance,
    unit_reliability,
)
from brainbench.metrics.reliability.noise_correction import spearman_brown
from brainbench.metrics.reliability.sessions import SortedTrials, draws, grouped_sessions, key_hashes
from brainbench.metrics.reliability.subject_rdm import drift_within, subject_rdm
from tests.factories.animals import STIMULI, make_block, make_latent


def _shuffled(block, rng, units=True, stimuli=None):
    rows = rng.permutation(len(block.labels))
    columns = rng.permutation(block.responses.shape[1]) if units else np.arange(block.responses.shape[1])
    labels = block.labels if stimuli is None else np.argsort(stimuli)[block.labels]
    keys = None if block.keys is None else [block.keys[row] for row in rows]
    return Trials(block.responses[np.ix_(rows, columns)], labels[rows], keys)


@pytest.mark.slow
def test_the_mean_over_random_splits_is_the_mean_over_all_splits():
    block = make_block(make_latent(1, stimuli=4), units=5, repeats=4, noise=2.0)
    halves = list(itertools.combinations(range(4), 2))
    rows = [np.flatnonzero(block.labels == k) for k in range(4)]
    every = []
    for choice in itertools.product(halves, repeat=4):
        first = np.concatenate([rows[k][list(half)] for k, half in enumerate(choice)])
        second = np.setdiff1d(np.arange(16), first)
        pair = [rdm(block.responses[half], block.labels[half]) for half in (first, second)]
        every.append(float(compare(*pair)))
    found = subject_rdm("a", [block], 4, splits=4000)
    assert found.split_half_r.mean() == pytest.approx(np.mean(every), abs=4 * np.std(every) / np.sqrt(4000))
    assert set(np.round(found.split_half_r, 9)) <= set(np.round(every, 9))
    assert found.reliability == pytest.approx(float(spearman_brown(found.split_half_r.mean())))


def test_halves_are_fair_disjoint_and_nearly_equal():
    random = draws(key_hashes([str(i) for i in range(7)]), np.arange(4000), seed=3)
    member = members(random)
    sizes = member.sum(axis=1)
    assert set(sizes) == {3.0, 4.0}
    assert abs((sizes == 4).mean() - 0.5) < 0.04
    np.testing.assert_allclose(member.mean(axis=0), 0.5, atol=0.04)
    together = np.mean([(member[:, i] == member[:, j]).mean() for i, j in itertools.combinations(range(7), 2)])
    assert together == pytest.approx((3 + 6) / 21, abs=0.02)


@settings(max_examples=25)
@given(st.integers(0, 2**32 - 1), st.booleans())
def test_the_order_of_trials_sessions_units_and_stimuli_is_irrelevant(seed, keys):
    rng = np.random.default_rng(seed)
    latent = make_latent(seed, stimuli=5)
    blocks = [make_block(latent, seed=seed % 97 + i, units=4 + i, repeats=3 + i, keys=keys) for i in range(3)]
    relabelled = rng.permutation(5)
    shuffled = [_shuffled(blocks[i], rng, stimuli=relabelled) for i in rng.permutation(3)]
    expected, found = subject_rdm("a", blocks, 5, splits=20), subject_rdm("a", shuffled, 5, splits=20)
    pairs = permuted_pairs(relabelled[None])[0]
    np.testing.assert_allclose(found.rdm, expected.rdm[pairs], atol=1e-12)
    np.testing.assert_allclose(found.split_half_r, expected.split_half_r, atol=1e-12)
    assert found.reliability == pytest.approx(expected.reliability, abs=1e-12)


@settings(max_examples=25)
@given(st.integers(0, 2**32 - 1))
def test_order_is_irrelevant_for_sparse_counts_whose_trials_hold_the_same_values(seed):
    rng = np.random.default_rng(seed)
    labels = np.repeat(np.arange(4), 6)
    block = Trials(rng.poisson(0.7, size=(24, 12)).astype(float) + np.eye(4, 12)[labels], labels)
    expected = subject_rdm("a", [block], 4, splits=20)
    found = subject_rdm("a", [_shuffled(block, rng, stimuli=rng.permutation(4))], 4, splits=20)
    np.testing.assert_allclose(np.sort(found.rdm), np.sort(expected.rdm), atol=1e-12)
    np.testing.assert_allclose(found.split_half_r, expected.split_half_r, atol=1e-12)


def test_seeds_give_other_splits_and_the_same_seed_the_same():
    block = make_block(make_latent(), noise=3.0)
    first, again, other = (subject_rdm("a", [block], 6, splits=50, seed=seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.split_half_r, again.split_half_r)
    assert not np.allclose(first.split_half_r, other.split_half_r)


def test_the_first_splits_do_not_depend_on_how_many_follow():
    block = make_block(make_latent(), noise=3.0)
    np.testing.assert_allclose(
        subject_rdm("a", [block], 6, splits=300).split_half_r[:40],
        subject_rdm("a", [block], 6, splits=40).split_half_r,
        atol=1e-12,
    )


def test_a_noiseless_animal_is_perfectly_reliable_whatever_the_trial_counts():
    latent = make_latent(3)
    clean = make_block(latent, noise=0.0, repeats=9)
    keep = np.r_[np.flatnonzero(clean.labels != 2), np.flatnonzero(clean.labels == 2)[:2]]
    fewer = Trials(clean.responses[keep], clean.labels[keep], [clean.keys[i] for i in keep])
    for block in (clean, fewer):
        found = subject_rdm("a", [block], 6, splits=50)
        assert found.reliability == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_allclose(
        subject_rdm("a", [fewer], 6, splits=2).rdm, subject_rdm("a", [clean], 6, splits=2).rdm, atol=1e-12
    )


def test_spearman_brown_predicts_the_agreement_with_an_independent_repetition():
    agreement, predicted = [], []
    for seed in range(40):
        latent = make_latent(seed)
        block = make_block(latent, seed=seed, units=40, repeats=24, noise=5.0)
        first = np.concatenate([np.flatnonzero(block.labels == k)[:12] for k in range(6)])
        second = np.setdiff1d(np.arange(144), first)
        parts = [Trials(block.responses[rows], block.labels[rows]) for rows in (first, second)]
        found = [subject_rdm("a", [part], 6, splits=100) for part in parts]
        agreement.append(float(compare(found[0].rdm, found[1].rdm)))
        predicted.append(np.mean([part.reliability for part in found]))
    assert np.mean(predicted) == pytest.approx(np.mean(agreement), abs=0.06)


@pytest.mark.parametrize("method", ["correlation", "sqeuclidean"])
@pytest.mark.parametrize("offset", [0.0, 30.0, 1e8])
def test_products_of_trials_and_half_means_give_the_same_halves(method, offset, monkeypatch):
    blocks = [make_block(make_latent(9), seed=i, units=15 + i, repeats=3 + i, noise=2.0) for i in range(3)]
    blocks = [Trials(block.responses + offset, block.labels, block.keys) for block in blocks]
    by_products = subject_rdm("a", blocks, 6, method=method, splits=40)
    monkeypatch.setattr(SplitRDMs, "_from_products", lambda *_: None)
    by_means = subject_rdm("a", blocks, 6, method=method, splits=40)
    np.testing.assert_allclose(by_products.halves, by_means.halves, rtol=1e-11 if offset < 1e6 else 1e-6)


def test_missing_entries_are_left_out_of_the_means_of_both_halves():
    block = make_block(make_latent(4), units=12, repeats=10, noise=0.0)
    rng = np.random.default_rng(0)
    holes = block.responses.copy()
    holes[rng.random(holes.shape) < 0.1] = np.nan
    found = subject_rdm("a", [Trials(holes, block.labels, block.keys)], 6, splits=30)
    np.testing.assert_allclose(found.rdm, subject_rdm("a", [block], 6, splits=2).rdm, atol=1e-12)
    assert found.reliability > 0.99


def test_units_that_cannot_be_split_are_left_out_and_counted():
    block = make_block(make_latent(5), units=9, repeats=4)
    holes = block.responses.copy()
    holes[np.flatnonzero(block.labels == 1)[:3], 2] = np.nan
    found = subject_rdm("a", [Trials(holes, block.labels, block.keys)], 6, splits=10)
    assert found.units == 8
    assert found.notes == ("1 units or bins left out: recorded in fewer than 2 trials of some stimulus",)
    without = Trials(np.delete(block.responses, 2, axis=1), block.labels, block.keys)
    np.testing.assert_allclose(found.split_half_r, subject_rdm("a", [without], 6, splits=10).split_half_r, atol=1e-12)


def test_silent_units_make_the_rdm_undefined_in_words():
    found = subject_rdm("a", [Trials(np.zeros((12, 5)), np.repeat(np.arange(6), 2))], 6, splits=5)
    assert "constant across units" in found.problem


def test_other_distances_split_too():
    block = make_block(make_latent(8), noise=1.0)
    counts = Trials(np.abs(block.responses), block.labels, block.keys)
    found = subject_rdm("a", [counts], 6, method="sqeuclidean", splits=20)
    np.testing.assert_allclose(found.rdm, rdm(counts.responses, counts.labels, method="sqeuclidean"), rtol=1e-11)
    assert found.reliability > 0.5


def test_misuse_is_told_in_a_sentence():
    block = make_block(make_latent())
    with pytest.raises(UsageError, match="did you mean 'crossnobis'"):
        subject_rdm("a", [block], 6, method="crosnobis")
    with pytest.raises(UsageError, match="Unknown noise covariance method"):
        subject_rdm("a", [block], 6, method="mahalanobis", noise="shrinkage")
    with pytest.raises(UsageError, match="keys repeat"):
        subject_rdm("a", [Trials(block.responses, block.labels, ["a"] * len(block.labels))], 6)
    with pytest.raises(UsageError, match="one key per trial"):
        subject_rdm("a", [Trials(block.responses, block.labels, ["a"])], 6)
    with pytest.raises(UsageError, match="received 0 to 5"):
        subject_rdm("a", [block], 5)
    with pytest.raises(UsageError, match="integers 0 … K−1"):
        subject_rdm("a", [Trials(block.responses, np.array(STIMULI)[block.labels])], 6)
    with pytest.raises(DataError, match="infinite"):
        subject_rdm("a", [Trials(np.full((12, 2), np.inf), np.repeat(np.arange(6), 2))], 6)
    with pytest.raises(dataclasses.FrozenInstanceError):
        block.keys = None


def _make_units(seed=0, trials=20):
    """Ten tuned units, ten of pure noise, one silent."""
    rng = np.random.default_rng(seed)
    labels = np.repeat(np.arange(6), trials)
    tuned = rng.normal(size=(6, 10))[labels] + rng.normal(size=(len(labels), 10))
    responses = np.concatenate([tuned, rng.normal(size=(len(labels), 10)), np.zeros((len(labels), 1))], axis=1)
    return Trials(responses, labels, [f"{seed}/{i}" for i in range(len(labels))])


def test_a_units_reliability_is_signal_over_signal_and_noise():
    values = np.concatenate([unit_reliability([_make_units(seed)], 6)[0][:10] for seed in range(12)])
    # Variance 1 of tuning, 1/20 of the mean's noise: near 20/21 for units whose six draws vary as expected.
    assert np.median(values) == pytest.approx(20 / 21, abs=0.03)


def test_the_filter_is_per_unit():
    (kept,), told = reliable_units([_make_units()], 6)
    assert kept.responses.shape[1] < 14
    np.testing.assert_array_equal(kept.responses[:, 0], _make_units().responses[:, 0])
    assert told.endswith("of 21 units left out: reliability of their tuning below 0.5")
    assert np.isnan(unit_reliability([_make_units()], 6)[0][-1])
    before, after = (subject_rdm("a", blocks, 6, splits=50) for blocks in ([_make_units()], [kept]))
    assert after.reliability > before.reliability


def test_units_of_pure_noise_pass_the_filter_by_chance_alone():
    labels, tuned = np.repeat(np.arange(6), 8), [_make_units(seed) for seed in range(6)]
    noise = [Trials(np.random.default_rng([7, seed]).normal(size=(48, 100)), labels) for seed in range(6)]
    # The filter makes noise reliable, which no reliability taken after it can show.
    how = {"method": "crossnobis", "comparison": "whitened-cosine", "noise": "none", "splits": 50}
    left = [subject_rdm("a", reliable_units([block], 6)[0], 6, **how).reliability for block in noise]
    assert np.mean(left) > 0.5 > np.mean([subject_rdm("a", [block], 6, **how).reliability for block in noise])
    assert tuning_by_chance(noise, 6) == pytest.approx(1, abs=0.35)
    assert tuning_by_chance(tuned, 6) < 0.1
    assert np.isnan(tuning_by_chance(noise, 6, least=1 - 1e-12))


def test_the_order_of_trials_and_units_is_irrelevant():
    block = _make_units()
    rng = np.random.default_rng(1)
    rows, columns = rng.permutation(120), rng.permutation(21)
    moved = Trials(block.responses[np.ix_(rows, columns)], block.labels[rows], [block.keys[row] for row in rows])
    np.testing.assert_allclose(unit_reliability([moved], 6)[0], unit_reliability([block], 6)[0][columns], atol=1e-12)
    assert tuning_by_chance([moved], 6) == pytest.approx(tuning_by_chance([block], 6))


def test_misuse_of_units_is_told_in_a_sentence():
    with pytest.raises(UsageError, match="at least 3; received 2"):
        unit_reliability([_make_units()], 2)


@pytest.mark.parametrize("method", ["crossnobis", "correlation"])
def test_units_that_are_recorded_in_some_trials_only_cost_no_reliability_and_make_none(method):
    comparison = "whitened-cosine" if method == "crossnobis" else "pearson"
    values, drifts = [], []
    for seed in range(12):
        random = np.random.default_rng(seed)
        # Two groups of units, the quieter one recorded in the earlier half of each stimulus' trials, the other later.
        latent = random.normal(size=(10, 20)) * np.repeat([0.5, 1.0], 10)
        labels = np.tile(np.arange(10), 16)
        responses = latent[labels] + random.normal(size=(160, 20))
        responses[:80, 10:] = responses[80:, :10] = np.nan
        block = Trials(responses, labels, times=np.arange(160.0))
        animal = subject_rdm("a", [block], 10, method=method, comparison=comparison, splits=100, noise="none")
        truth = rdm(latent, method="sqeuclidean" if method == "crossnobis" else method)
        values.append(float(compare(truth, animal.rdm, method=comparison)) / np.sqrt(animal.reliability))
        drift = drift_within([animal])
        drifts.append(drift is not None and drift.present)
    assert np.mean(values) == pytest.approx(1.0, abs=0.06)
    assert sum(drifts) <= 2


def test_trials_with_the_same_units_go_to_both_halves_alike():
    random = np.random.default_rng(0)
    responses, labels = random.normal(size=(42, 6)), np.repeat([0, 1], 21)
    units = np.array([[0, 1, 2, 3, 4, 5], [0, 1, 2, 3, 6, 6], [2, 3, 4, 5, 6, 6]])[np.arange(42) % 3]
    for trial, present in enumerate(units):
        responses[trial, np.setdiff1d(np.arange(6), present)] = np.nan
    hashes = key_hashes([str(trial) for trial in range(42)])
    (session,) = grouped_sessions([SortedTrials.sort(responses, labels, hashes)])
    first = split_members(session, np.arange(200), 0)
    for stimulus in (0, 1):
        inside = session.labels == stimulus
        assert set(first[:, inside].sum(axis=1)) == {10.0, 11.0}
        for units in np.unique(np.isfinite(session.responses), axis=0):
            rows = inside & (np.isfinite(session.responses) == units).all(axis=1)
            assert set(first[:, rows].sum(axis=1)) == {3.0, 4.0}
    np.testing.assert_allclose(first.mean(axis=0), 0.5, atol=0.12)


def test_probes_of_one_session_have_equal_halves_where_one_lacks_units_in_some_trials():
    random = np.random.default_rng(0)
    labels, hashes = np.repeat([0, 1], 20), key_hashes([str(trial) for trial in range(40)])
    first, second = random.normal(size=(2, 40, 5))
    first[::2, 2:] = np.nan
    sessions = [SortedTrials.sort(responses, labels, hashes) for responses in (first, second)]
    halves = [split_members(session, np.arange(100), 0) for session in grouped_sessions(sessions)]
    np.testing.assert_array_equal(*halves)
    whole = [split_members(session, np.arange(100), 0) for session in grouped_sessions(sessions[1:])]
    assert (whole[0] != halves[1]).any(), "by itself the second one is not split by the units of the first"
