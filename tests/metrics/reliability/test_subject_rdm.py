"""RDMs of an animal by every method: parity with rsatoolbox, and rules for what is missing."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from brainbench.core.contracts import Trials
from brainbench.core.errors import UsageError
from brainbench.metrics import noise_precision, rdm
from brainbench.metrics.reliability.halves import SplitRDMs, half_rdms, split_members
from brainbench.metrics.reliability.sessions import SortedTrials, key_hashes
from brainbench.metrics.reliability.subject_rdm import LEVEL, drift_between, drift_within, subject_rdm
from tests.factories.animals import make_block, make_latent


def _unbalanced(seed=0, units=12):
    rng = np.random.default_rng(seed)
    labels = np.repeat(np.arange(6), [5, 9, 12, 6, 4, 10])
    responses = rng.normal(size=(6, units))[labels] + rng.normal(size=(len(labels), units))
    return Trials(responses, labels, [f"{seed}/{i}" for i in range(len(labels))])


@pytest.mark.parametrize("noise", ["shrinkage_diag", "shrinkage_eye", "diag", "full"])
def test_mahalanobis_of_one_session_is_that_of_rdm(noise):
    block = _unbalanced()
    precision = noise_precision(block.responses, block.labels, method=noise)
    found = subject_rdm("a", [block], 6, method="mahalanobis", noise=noise, splits=5)
    expected = rdm(block.responses, block.labels, method="mahalanobis", precision=precision)
    np.testing.assert_allclose(found.rdm, expected, rtol=1e-10)


def test_crossnobis_with_unequal_trials_equals_rsatoolbox():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from rsatoolbox.data import Dataset
        from rsatoolbox.rdm import calc_rdm_unbalanced
    block = _unbalanced()
    data = Dataset(block.responses, obs_descriptors={"stimulus": block.labels, "trial": np.arange(len(block.labels))})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        expected = calc_rdm_unbalanced(
            data, method="crossnobis", descriptor="stimulus", cv_descriptor="trial"
        ).dissimilarities[0]
    found = subject_rdm("a", [block], 6, method="crossnobis", noise="none", splits=5)
    np.testing.assert_allclose(found.rdm, expected, atol=1e-10)


@pytest.mark.parametrize("method", ["correlation", "sqeuclidean", "crossnobis"])
def test_halves_by_products_and_by_patterns_are_the_same(method, monkeypatch):
    block = make_block(make_latent(), units=60, repeats=8)
    session = SortedTrials.sort(block.responses, block.labels, key_hashes(block.keys))
    index = np.arange(7)
    first, second = half_rdms([session], 6, method, index, seed=3)
    member = split_members(session, index, 3)
    monkeypatch.setattr("brainbench.metrics.reliability.halves.BY_PRODUCTS", ())
    for half, by_patterns in zip((first, second), SplitRDMs([session], 6, method).halves([member]), strict=True):
        np.testing.assert_allclose(half, by_patterns, atol=1e-11)


@pytest.mark.parametrize("noise", ["none", "diag", "shrinkage_diag", "full"])
def test_crossnobis_is_zero_on_average_where_stimuli_are_alike(noise):
    rng = np.random.default_rng(1)
    labels = np.repeat(np.arange(6), [4, 5, 6, 7, 8, 9])
    found = []
    for _ in range(40):
        block = Trials(rng.normal(size=(len(labels), 8)) * np.linspace(0.5, 2, 8), labels)
        found.append(subject_rdm("a", [block], 6, method="crossnobis", noise=noise, splits=1).rdm.mean())
    assert abs(np.mean(found)) < 4 * np.std(found) / np.sqrt(40)


@pytest.mark.slow
@pytest.mark.parametrize("noise", ["none", "diag", "full"])
def test_crossnobis_is_zero_on_average_in_two_thousand_simulations(noise):
    rng = np.random.default_rng(2)
    labels = np.repeat(np.arange(6), [4, 5, 6, 8, 10, 12])
    found, biased = [], []
    for _ in range(2000):
        block = Trials(rng.normal(size=(len(labels), 8)) * np.linspace(0.5, 2, 8), labels)
        found.append(subject_rdm("a", [block], 6, method="crossnobis", noise=noise, splits=1).rdm.mean())
        biased.append(subject_rdm("a", [block], 6, method="sqeuclidean", splits=1).rdm.mean())
    assert abs(np.mean(found)) < 3 * np.std(found) / np.sqrt(2000)
    assert np.mean(biased) > 0.2


@pytest.mark.parametrize("method", ["correlation", "sqeuclidean"])
def test_a_noiseless_rdm_does_not_depend_on_the_number_of_trials(method):
    patterns = np.random.default_rng(2).random(size=(6, 15))
    few, many = (np.repeat(np.arange(6), counts) for counts in ([4] * 6, [4, 9, 5, 12, 8, 6]))
    found = [subject_rdm("a", [Trials(patterns[x], x)], 6, method=method, splits=2).rdm for x in (few, many)]
    np.testing.assert_allclose(*found, atol=1e-12)


def test_units_that_were_not_recorded_in_every_trial_leave_the_full_covariance_but_not_the_diagonal():
    block = _unbalanced(units=8)
    responses = block.responses.copy()
    responses[0, 2] = np.nan
    responses[:, 5] = 3.0
    gap = Trials(responses, block.labels, block.keys)
    diagonal = subject_rdm("a", [gap], 6, method="mahalanobis", noise="diag", splits=5)
    full = subject_rdm("a", [gap], 6, method="mahalanobis", noise="full", splits=5)
    assert diagonal.units == 7
    assert full.units == 6
    assert "1 units or bins left out: without noise or not in every trial" in diagonal.notes
    assert "2 units or bins left out: without noise or not in every trial" in full.notes
    crossed = subject_rdm("a", [gap], 6, method="crossnobis", noise="diag", splits=5)
    assert np.isfinite(crossed.rdm).all()


def test_too_few_trials_for_a_covariance_are_a_problem_in_words():
    rng = np.random.default_rng(3)
    labels = np.repeat(np.arange(6), 4)
    wide = Trials(rng.normal(size=(24, 60)), labels)
    found = subject_rdm("a", [wide], 6, method="mahalanobis", noise="full")
    assert found.problem.startswith("no session has a noise covariance: The noise covariance of 60 units")
    still = Trials(np.repeat(rng.normal(size=(6, 5)), 4, axis=0), labels)
    assert "no unit has noise" in subject_rdm("a", [still], 6, method="crossnobis").problem


def test_crossnobis_needs_four_trials_of_each_stimulus():
    block = make_block(make_latent(), repeats=3)
    found = subject_rdm("a", [block], 6, method="crossnobis")
    assert "fewer than 4 trials of 0 (3)" in found.problem


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"splits": 0}, "splits .*0"), ({"splits": 2.5}, r"splits .*2\.5"), ({"seed": -1}, "seed .*-1"),
        ({"seed": 1.5}, r"seed .*1\.5"), ({"noise": "dag"}, "did you mean 'diag'"),
    ],
)  # fmt: skip
def test_options_of_an_animals_rdm_are_checked_whatever_its_method(options, told) -> None:
    trials = Trials(np.arange(24.0).reshape(12, 2) % 5, np.repeat(range(3), 4))
    with pytest.raises(UsageError, match=told):
        subject_rdm("m", [trials], 3, **options)


STIMULI, UNITS, REPEATS = 10, 24, 8


def _make_session(rng, name, *, change=0.0, start=0.0, gain=0.0):
    """Trials in random order whose tuning turns from one geometry to another, by ``change`` over the session."""
    before, after = (rng.normal(size=(STIMULI, 2)) @ rng.normal(size=(2, UNITS)) for _ in range(2))
    labels = rng.permutation(np.repeat(np.arange(STIMULI), REPEATS))
    time = np.linspace(0, 1, len(labels))
    angle = (np.pi / 2) * np.clip(start + change * time, 0, 1)[:, None]
    responses = np.cos(angle) * before[labels] + np.sin(angle) * after[labels] + gain * time[:, None]
    responses = responses + 1.5 * rng.normal(size=responses.shape)
    keys = [f"{name}/{trial}" for trial in range(len(labels))]
    return Trials(responses, labels, keys, times=60.0 * time, session=name)


def _make_animals(seed, count=3, method="crossnobis", comparison="whitened-cosine", **drift):
    rng = np.random.default_rng(seed)
    how = {"method": method, "comparison": comparison, "noise": "none", "splits": 100}
    return [
        subject_rdm(f"m{index}", [_make_session(rng, f"{seed}/{index}", **drift)], STIMULI, **how)
        for index in range(count)
    ]


def _make_geometries(seed, sessions, *, change):
    """An animal of sessions with units of their own, whose geometry turns from session to session."""
    rng = np.random.default_rng(seed)
    first, last = rng.normal(size=(2, STIMULI, 4))
    blocks = []
    for place in range(sessions):
        angle = (np.pi / 2) * change * place / (sessions - 1)
        latent = np.cos(angle) * first + np.sin(angle) * last
        labels = np.repeat(np.arange(STIMULI), REPEATS)
        responses = (latent @ rng.normal(size=(4, UNITS)))[labels] + rng.normal(size=(len(labels), UNITS))
        blocks.append(Trials(responses, labels, [f"{place}/{row}" for row in range(len(labels))], session=f"s{place}"))
    return blocks


@pytest.mark.parametrize(("method", "comparison"), [("crossnobis", "whitened-cosine"), ("correlation", "pearson")])
def test_tuning_that_changes_over_a_session_is_found(method, comparison):
    drift = drift_within(_make_animals(0, method=method, comparison=comparison, change=1.0))
    assert drift.present
    assert drift.by_time < drift.random - 0.15


def test_without_drift_p_is_that_of_two_tests_and_rates_that_drift_alike_are_none():
    drifts = [drift_within(_make_animals(seed, count=1, gain=3.0 * (seed % 2))) for seed in range(60)]
    still, moving = np.array([drift.p for drift in drifts]).reshape(30, 2).T
    # Twice the smaller of two p, at most 1, has a mean of .58.
    assert 0.45 < still.mean() < 0.7
    assert (still <= 0.1).sum() <= 6
    # Random quarters share some of the drift, and vary more than those in time.
    assert (moving <= 0.1).sum() <= 6
    assert abs(np.mean([drift.by_time - drift.random for drift in drifts])) < 0.02


def _make_sequence(rng, sequence, *, tuning, rounds=16, units=30):
    """Trials in rounds of one sequence, whose noise lasts for four trials."""
    labels = np.tile(sequence, rounds)
    noise, share = rng.normal(size=(len(labels), units)), np.exp(-1 / 4)
    for trial in range(1, len(labels)):
        noise[trial] = share * noise[trial - 1] + np.sqrt(1 - share**2) * noise[trial]
    tuned = tuning * rng.normal(size=(len(sequence), units))[labels]
    responses = tuned + noise + rng.normal(size=noise.shape)
    return Trials(responses, labels, times=np.arange(len(labels), dtype=float), session="1")


@pytest.mark.parametrize(("tuning", "doubt"), [(0.0, True), (1.0, False)])
def test_slow_noise_in_a_sequence_that_repeats_is_no_tuning(tuning, doubt):
    how = {"method": "crossnobis", "comparison": "whitened-cosine", "noise": "none", "splits": 100}
    for seed in range(3):
        rng, sequence = np.random.default_rng(seed), np.random.default_rng(seed).permutation(12)
        blocks = [_make_sequence(rng, sequence, tuning=tuning) for _ in range(8)]
        drift = drift_within([subject_rdm(f"m{index}", [block], 12, **how) for index, block in enumerate(blocks)])
        # Random halves, and halves by time, share the sequence: neighbours in it look alike in all of them.
        assert drift.random > 0.5
        assert (drift.present and not drift.reliable) == doubt


def test_the_order_of_trials_and_sessions_changes_nothing_and_unknown_times_say_nothing():
    block, other = (_make_session(np.random.default_rng(seed), str(seed), change=0.5) for seed in (1, 2))
    order = np.random.default_rng(3).permutation(len(block.labels))
    animal = subject_rdm("a", [block, other], STIMULI, splits=5)
    again = subject_rdm("a", [other, block.take(order)], STIMULI, splits=5)
    assert animal.by_time == pytest.approx(again.by_time, abs=1e-12)
    assert list(animal.presented) == list(again.presented) == ["1", "2"]
    unknown = Trials(block.responses, block.labels, block.keys)
    assert drift_within([subject_rdm("a", [unknown], STIMULI, splits=5)]) is None


def test_a_geometry_that_turns_from_session_to_session_is_found_and_sampled_units_are_no_drift():
    def drift(seed, change):
        animals = [
            subject_rdm(f"m{i}", _make_geometries(100 * seed + i, 6, change=change), STIMULI, method="crossnobis",
                        comparison="whitened-cosine", noise="none", splits=5)
            for i in range(3)
        ]  # fmt: skip
        return drift_between(animals)

    turned = [drift(seed, 1.0) for seed in range(3)]
    assert all(each.present and each.by_time < 0.9 for each in turned)
    still = [drift(seed, 0.0) for seed in range(20)]
    assert sum(each.p <= 0.1 for each in still) <= 5
    assert 0.3 < np.mean([each.p for each in still]) < 0.7
    assert still[0].level == LEVEL


def test_two_sessions_have_no_order():
    assert drift_between([subject_rdm("a", _make_geometries(0, 2, change=1.0), STIMULI, splits=5)]) is None
