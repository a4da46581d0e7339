"""Trials: what belongs to one is taken with it."""

from __future__ import annotations

import numpy as np

from brainbench.core.trials import Trials


def test_trials_are_taken_with_all_that_belongs_to_them():
    trials = Trials(np.arange(12.0).reshape(4, 3), np.array([0, 1, 0, 1]), list("abcd"), {"licks": np.arange(4.0)})
    some = trials.take(trials.labels > 0)
    assert some.keys == ("b", "d")
    np.testing.assert_array_equal(some.responses, trials.responses[[1, 3]])
    np.testing.assert_array_equal(some.covariates["licks"], [1, 3])
    np.testing.assert_array_equal(trials.take([3, 1]).labels, [1, 1])
    assert Trials(trials.responses, trials.labels).take([0]).keys is None
