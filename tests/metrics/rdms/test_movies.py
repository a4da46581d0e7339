"""Time-resolved RDMs."""

from __future__ import annotations

import numpy as np
import pytest

from brainbench.core.errors import UsageError
from brainbench.metrics import compare, rdm
from brainbench.metrics.rdms.movies import rdm_movie


@pytest.mark.parametrize("method", ["correlation", "sqeuclidean", "poisson"])
def test_a_frame_is_the_rdm_of_its_window(method):
    rng = np.random.default_rng(0)
    trials, labels = rng.random((30, 7, 12)), np.arange(30) % 6
    movie = rdm_movie(trials, labels, width=3, step=2, method=method)
    assert movie.shape == (3, 15)
    for frame, start in enumerate((0, 2, 4)):
        np.testing.assert_allclose(movie[frame], rdm(trials[:, start : start + 3].mean(axis=1), labels, method=method))


def test_bins_that_were_not_recorded_do_not_count():
    rng = np.random.default_rng(1)
    trials, labels = rng.random((12, 4, 9)), np.arange(12) % 6
    trials[3, 1] = np.nan
    movie = rdm_movie(trials, labels, width=2)
    whole = trials[:, 0:2].mean(axis=1)
    whole[3] = trials[3, 0]
    np.testing.assert_allclose(movie[0], rdm(whole, labels))


def test_a_geometry_that_lasts_compares_across_time():
    rng = np.random.default_rng(2)
    patterns = np.repeat(rng.normal(size=(6, 1, 20)), 4, axis=1)
    patterns[:, :2] = rng.normal(size=(6, 2, 20))
    movie = rdm_movie(patterns)
    across = compare(movie[:, None], movie)
    np.testing.assert_allclose(across[2:, 2:], 1)
    assert across[0, 3] < 0.9


def test_misuse_is_told_in_a_sentence():
    with pytest.raises(UsageError, match=r"received shape \(6, 4\)"):
        rdm_movie(np.ones((6, 4)))
    with pytest.raises(UsageError, match="width from 1 to 4"):
        rdm_movie(np.ones((6, 4, 2)), width=5)
