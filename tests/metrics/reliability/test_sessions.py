"""Sessions of an animal: joined unit by unit, sorted by content, and taken in slices of units."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from brainbench.core.contracts import Trials
from brainbench.metrics import rdm
from brainbench.metrics.reliability.sessions import SortedTrials, content_hashes
from brainbench.metrics.reliability.subject_rdm import subject_rdm
from tests.factories.animals import STIMULI, make_block, make_latent


def test_content_hashes_tell_trials_apart_and_number_the_identical_ones():
    responses = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, -0.0, np.nan], [2.0, 2.0, 0.0]])
    hashes = content_hashes(responses, np.array([0, 0, 0, 1, 1]))
    assert len(set(hashes.tolist())) == 5


def test_sessions_with_other_units_are_joined_unit_by_unit():
    latent = make_latent(2)
    blocks = [make_block(latent, seed=i, units=7, repeats=5) for i in range(2)]
    means = [np.stack([b.responses[b.labels == k].mean(axis=0) for k in range(6)]) for b in blocks]
    np.testing.assert_allclose(
        subject_rdm("a", blocks, 6, splits=5).rdm, rdm(np.concatenate(means, axis=1)), atol=1e-12
    )


def test_a_session_with_a_single_trial_of_a_stimulus_is_left_out_in_words():
    good = make_block(make_latent(6), seed=1)
    bad = make_block(make_latent(6), seed=2)
    keep = np.r_[np.flatnonzero(bad.labels != 5), np.flatnonzero(bad.labels == 5)[:1]]
    bad = Trials(bad.responses[keep], bad.labels[keep])
    found = subject_rdm("a", [good, bad], 6, stimuli=STIMULI, splits=10)
    np.testing.assert_allclose(found.rdm, subject_rdm("a", [good], 6, splits=10).rdm, atol=1e-12)
    assert found.notes == ("1 of 2 sessions left out: fewer than 2 trials of concave-far (1)",)
    alone = subject_rdm("a", [bad], 6, stimuli=STIMULI, splits=10)
    assert alone.problem == "no session can be split into halves: fewer than 2 trials of concave-far (1)"
    assert np.isnan(alone.reliability)


def test_an_animal_without_a_stimulus_says_which():
    found = subject_rdm("a", [make_block(make_latent(7), gap=(2,))], 6, stimuli=STIMULI)
    assert found.problem == "no trials of 'convex-far'"
    assert np.isnan(found.rdm).all()


def test_an_animal_without_sessions_has_no_trials_of_anything():
    assert subject_rdm("a", [], 6, stimuli=STIMULI).problem.startswith("no trials of 'convex-close', 'convex-medium'")


def _block(missing: bool) -> Trials:
    rng = np.random.default_rng(4)
    labels = np.arange(48) % 6
    responses = rng.gamma(2.0, 4.0, (6, 900))[labels] + rng.normal(size=(48, 900))
    if missing:
        responses[rng.uniform(size=responses.shape) < 0.05] = np.nan
    return Trials(responses, labels, [str(trial) for trial in range(48)])


@pytest.mark.parametrize("missing", [False, True])
@pytest.mark.parametrize("method", ["correlation", "sqeuclidean", "mahalanobis", "crossnobis"])
def test_slices_change_no_number_and_no_response_of_the_caller(method, missing, monkeypatch):
    block = _block(missing)
    before = block.responses.copy()
    whole = subject_rdm("a", [block], 6, method=method, splits=20)
    np.testing.assert_array_equal(block.responses, before)
    monkeypatch.setattr(SortedTrials, "slices", lambda self: (slice(at, at + 70) for at in range(0, 900, 70)))
    sliced = subject_rdm("a", [block], 6, method=method, splits=20)
    for name in ("rdm", "split_half_r", "halves", "patterns", "noise"):
        np.testing.assert_allclose(getattr(sliced, name), getattr(whole, name), rtol=1e-11, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("job", ["score, every time step kept, crossnobis", "score, every time step kept"])
def test_a_thousand_units_in_bins_of_ten_milliseconds_take_less_than_four_gigabytes(job):
    root = Path(__file__).parents[3]
    words = [sys.executable, "-m", "benchmarks.scores.memory", "--job", job]
    environment = {**os.environ, "PYTHONPATH": str(root)}
    found = subprocess.run(words, cwd=root, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    assert json.loads(found.stdout.splitlines()[-1])["gigabytes"] < 4
