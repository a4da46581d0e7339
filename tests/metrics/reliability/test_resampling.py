"""Bootstrap draws of one animal: their definition, and their independence of order."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from brainbench.core.trials import Trials
from brainbench.metrics import rdm
from brainbench.metrics.rdms.pairs import permuted_pairs
from brainbench.metrics.reliability.resampling import resample, trial_counts
from brainbench.metrics.reliability.sessions import SortedTrials
from brainbench.metrics.reliability.subject_rdm import subject_rdm
from brainbench.metrics.reliability.trial_hashes import key_hashes
from tests.factories.animals import make_block, make_latent


def _make_sessions(gap=False):
    blocks = [make_block(make_latent(), units=30, repeats=8), make_block(make_latent(), seed=3, units=70, repeats=9)]
    sessions = [SortedTrials.sort(block.responses.copy(), block.labels, key_hashes(block.keys)) for block in blocks]
    if gap:
        responses = sessions[0].responses.copy()
        responses[0, 3] = np.nan
        sessions[0] = replace(sessions[0], responses=responses)
    return sessions


@pytest.mark.parametrize("method", ["correlation", "sqeuclidean", "crossnobis"])
def test_draws_by_products_and_by_patterns_are_the_same(method, monkeypatch):
    options = {"draws": 40, "splits": 4, "seed": 5}
    fast = resample(_make_sessions(), 6, method, "pearson", **options)
    monkeypatch.setattr("brainbench.metrics.reliability.halves.BY_PRODUCTS", ())
    slow = resample(_make_sessions(), 6, method, "pearson", **options)
    for one, two in zip(fast, slow, strict=True):
        np.testing.assert_allclose(one, two, atol=1e-12)
    assert np.isfinite(fast[0]).all()


def test_a_draw_is_the_rdm_of_the_trials_that_were_drawn():
    (session,) = _make_sessions()[:1]
    counts = trial_counts(session, 6, 3, seed=9)
    assert (np.add.reduceat(counts, np.arange(0, 48, 8), axis=1) == 8).all()
    found, _ = resample([session], 6, "correlation", "pearson", draws=3, splits=1, seed=9)
    for draw in range(3):
        rows = np.repeat(np.arange(48), counts[draw].astype(int))
        np.testing.assert_allclose(found[draw], rdm(session.responses[rows], session.labels[rows]), atol=1e-12)


def test_missing_entries_are_drawn_as_missing():
    found, agreement = resample(_make_sessions(gap=True), 6, "correlation", "pearson", draws=30, splits=4, seed=0)
    assert np.isfinite(found).all()
    assert np.isfinite(agreement).any()


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from(["correlation", "crossnobis", "poisson"]))
def test_the_order_of_trials_sessions_units_and_stimuli_changes_no_draw(seed, method):
    rng = np.random.default_rng(seed)
    blocks = [make_block(make_latent(), seed=j, repeats=8) for j in range(2)]
    blocks = [Trials(np.abs(block.responses), block.labels, block.keys) for block in blocks]
    order = rng.permutation(6)

    def shuffled(block):
        rows, columns = rng.permutation(len(block.labels)), rng.permutation(block.responses.shape[1])
        labels = np.argsort(order)[block.labels][rows]
        return Trials(block.responses[np.ix_(rows, columns)], labels, [block.keys[row] for row in rows])

    options = {"method": method, "splits": 5, "draws": 20, "noise": "diag"}
    first = subject_rdm("a", blocks, 6, **options)
    second = subject_rdm("a", [shuffled(block) for block in blocks[::-1]], 6, **options)
    np.testing.assert_allclose(second.draws, first.draws[:, permuted_pairs(order[None])[0]], atol=1e-11)
    np.testing.assert_allclose(second.draws_r, first.draws_r, atol=1e-11)


def test_halves_of_a_draw_share_no_trial():
    """Trials of pure noise agree with their own copies; halves that held copies would look reliable."""
    rng = np.random.default_rng(0)
    block = Trials(rng.normal(size=(96, 40)), np.repeat(np.arange(6), 16), [str(i) for i in range(96)])
    found = subject_rdm("a", [block], 6, splits=200, draws=200)
    assert abs(np.nanmean(found.draws_r) - found.split_half_r.mean()) < 0.1
    assert abs(np.nanmean(found.draws_r)) < 0.15
