"""RDMs of layers and animals in bins of time."""

from __future__ import annotations

import numpy as np
import pytest

from brainbench.core.contracts import Trials
from brainbench.core.errors import UsageError
from brainbench.metrics import rdm
from brainbench.metrics.reliability.subject_rdm import subject_rdm
from brainbench.scoring.over_time import animal_movie, in_bins, layer_movie
from tests.factories.moving_geometry import lagged, make_moving_session, make_path


def test_an_activation_counts_in_a_bin_for_as_long_as_it_lasts_there():
    values = np.array([0.0, 3.0, 6.0])[None, :, None]
    np.testing.assert_allclose(in_bins(values, 0.1, 0.15).ravel(), [1.0, 5.0])
    np.testing.assert_allclose(in_bins(values, 0.1, 0.05).ravel(), [0, 0, 3, 3, 6, 6])
    # The last third of a bin is left out, two thirds of one are not.
    assert in_bins(values, 0.1, 0.225).shape == (1, 1, 1)
    assert in_bins(values, 0.1, 0.18).shape == (1, 2, 1)


def test_a_layer_without_time_has_one_rdm():
    patterns = np.random.default_rng(0).normal(size=(6, 1, 9))
    movie = layer_movie(patterns, 1.0, 0.05)
    np.testing.assert_allclose(movie, rdm(patterns[:, 0], method="sqeuclidean")[None])


def test_each_bin_of_an_animal_is_prepared_as_a_score_without_time():
    rng = np.random.default_rng(1)
    session = make_moving_session(rng, make_path(rng, 6, 4))
    how = {"method": "sqeuclidean", "comparison": "pearson", "splits": 30, "seed": 5}
    movie = animal_movie("a", [session], 6, **how)
    for bin in range(4):
        alone = subject_rdm("a", [Trials(session.responses[:, bin], session.labels, session.keys)], 6, **how)
        np.testing.assert_allclose(movie.rdms[bin], alone.rdm)
        assert movie.reliability[bin] == alone.reliability


def test_an_animal_is_reliable_only_where_it_responds():
    rng = np.random.default_rng(2)
    session = make_moving_session(rng, lagged(make_path(rng, 8, 6), 0, onset=3), noise=1.0)
    movie = animal_movie("a", [session], 8, splits=30)
    assert (movie.reliability[3:] > 0.6).all()
    assert (movie.reliability[:3] < 0.5).all()


def test_a_bin_without_an_rdm_says_why():
    rng = np.random.default_rng(3)
    session = make_moving_session(rng, make_path(rng, 6, 3))
    responses = session.responses.copy()
    responses[session.labels == 2, 1] = np.nan
    movie = animal_movie("a", [Trials(responses, session.labels, session.keys)], 6, splits=5)
    assert np.isnan(movie.rdms[1]).all()
    assert np.isnan(movie.reliability[1])
    assert [problem is None for problem in movie.problems] == [True, False, True]


def test_misuse_is_told_in_a_sentence():
    with pytest.raises(UsageError, match="'a'"):
        animal_movie("a", [Trials(np.ones((6, 3)), np.arange(6))], 6)
    with pytest.raises(UsageError, match=r"\(6, 4\)"):
        in_bins(np.ones((6, 4)), 0.1, 0.1)
    with pytest.raises(UsageError, match="bins of 0"):
        in_bins(np.ones((6, 4, 2)), 0.1, 0.0)
