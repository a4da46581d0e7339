"""Reliability of single units."""

from __future__ import annotations

import numpy as np
import pytest

from brainbench.core.contracts import Trials
from brainbench.core.errors import UsageError
from brainbench.metrics.reliability.subject_rdm import subject_rdm
from brainbench.metrics.reliability.units import reliable_units, unit_reliability


def _make_block(seed=0, trials=20):
    """Ten tuned units, ten of pure noise, one silent."""
    rng = np.random.default_rng(seed)
    labels = np.repeat(np.arange(6), trials)
    tuned = rng.normal(size=(6, 10))[labels] + rng.normal(size=(len(labels), 10))
    responses = np.concatenate([tuned, rng.normal(size=(len(labels), 10)), np.zeros((len(labels), 1))], axis=1)
    return Trials(responses, labels, [f"{seed}/{i}" for i in range(len(labels))])


def test_a_units_reliability_is_signal_over_signal_and_noise():
    values = np.concatenate([unit_reliability([_make_block(seed)], 6)[0][:10] for seed in range(12)])
    # Variance 1 of tuning, 1/20 of the mean's noise: near 20/21 for units whose six draws vary as expected.
    assert np.median(values) == pytest.approx(20 / 21, abs=0.03)


def test_the_filter_is_per_unit():
    (kept,), told = reliable_units([_make_block()], 6)
    assert kept.responses.shape[1] < 14
    np.testing.assert_array_equal(kept.responses[:, 0], _make_block().responses[:, 0])
    assert told.endswith("of 21 units left out: reliability of their tuning below 0.5")
    assert np.isnan(unit_reliability([_make_block()], 6)[0][-1])
    before, after = (subject_rdm("a", blocks, 6, splits=50) for blocks in ([_make_block()], [kept]))
    assert after.reliability > before.reliability


def test_the_order_of_trials_and_units_is_irrelevant():
    block = _make_block()
    rng = np.random.default_rng(1)
    rows, columns = rng.permutation(120), rng.permutation(21)
    moved = Trials(block.responses[np.ix_(rows, columns)], block.labels[rows], [block.keys[row] for row in rows])
    np.testing.assert_allclose(unit_reliability([moved], 6)[0], unit_reliability([block], 6)[0][columns], atol=1e-12)


def test_misuse_is_told_in_a_sentence():
    with pytest.raises(UsageError, match="at least 3 stimuli"):
        unit_reliability([_make_block()], 2)
