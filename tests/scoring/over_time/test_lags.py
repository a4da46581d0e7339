"""Comparisons at every lag, and where they are highest."""

from __future__ import annotations

import numpy as np

from brainbench.metrics import compare
from brainbench.scoring.over_time.lags import LaggedRDMs, best_lag, held_out_course, votes
from tests.factories.moving_geometry import lagged, make_layer, make_movie, make_path


def _joined(rng, *, animals=3, lag=1, bins=6, comparison="whitened-cosine"):
    path = make_path(rng, 6, bins)
    movies = [make_layer(rng, make_path(rng, 6, bins)), make_layer(rng, path), make_layer(rng, path)[:1]]
    brain = [make_movie(rng, lagged(path, lag), str(index)).rdms for index in range(animals)]
    return movies, brain, LaggedRDMs.join(movies, brain, largest=2, comparison=comparison)


def test_a_lag_compares_the_animals_bin_with_an_earlier_bin_of_the_model():
    movies, brain, joined = _joined(np.random.default_rng(0))
    (r,) = joined.compared()
    assert r.shape == (3, 5, 6, 3)
    for lag, place in ((-1, 1), (0, 2), (2, 4)):
        expected = compare(movies[1][3 - lag], brain[2][3], method="whitened-cosine")
        np.testing.assert_allclose(r[1, place, 3, 2], expected)
    # The model has no time before its first bin, nor after its last.
    assert np.isnan(r[1, 4, :2]).all()
    assert np.isnan(r[1, 1, 5:]).all()
    # A layer without time is compared at lag zero, with every bin.
    assert np.isfinite(r[2, 2]).all()
    assert np.isnan(np.delete(r[2], 2, axis=0)).all()


def test_the_first_order_is_the_given_one_and_left_out_stimuli_leave_their_pairs():
    _, _, joined = _joined(np.random.default_rng(1), comparison="pearson")
    first = next(joined.permuted(20, 0))[0]
    np.testing.assert_allclose(first, joined.compared()[0], equal_nan=True)
    rows, cols = np.triu_indices(6, 1)
    kept = (rows != 4) & (cols != 4)
    expected = compare(joined.layers[3, kept], joined.animals[0, kept])
    np.testing.assert_allclose(
        np.ravel(joined.without_stimulus(4)[0, 0, 2, 3, 0]),
        compare(joined.layers[3, kept], joined.animals.reshape(6, 3, -1)[3, 0, kept]),
    )
    assert np.isfinite(expected)


def test_bins_without_an_rdm_are_left_out():
    movies, brain, _ = _joined(np.random.default_rng(2))
    brain[1] = brain[1].copy()
    brain[1][3] = np.nan
    (r,) = LaggedRDMs.join(movies, brain, largest=2, comparison="whitened-cosine").compared()
    assert np.isnan(r[:, :, 3, 1]).all()
    assert np.isfinite(r[1, 2, 3, 0])
    assert np.isfinite(votes(r[None])[0, 1, 2, 1])


def test_layer_and_lag_of_an_animal_are_chosen_on_the_others():
    rng = np.random.default_rng(3)
    r = rng.uniform(-0.1, 0.1, size=(1, 2, 3, 4, 3))
    r[0, 1, 2, :, :2] = 0.9
    r[0, 0, 0, :, 2] = 0.99
    course, chosen = held_out_course(r)
    # The third animal's own favourite is not what it is scored with.
    assert chosen[0, 2] == 5
    np.testing.assert_allclose(course[0, :, 2], r[0, 1, 2, :, 2])


def test_bins_that_never_match_do_not_move_the_peak():
    # True lag 1; the first three bins match nothing, and larger lags lose them.
    bins, lags = 12, np.arange(-3, 4)
    at = np.arange(bins) - lags[:, None]
    height = np.exp(-0.5 * (lags - 1.0) ** 2)[:, None] * (np.arange(bins) >= 3)
    excess = np.where((at >= 0) & (at < bins), height, np.nan)[None, :, :, None]
    np.testing.assert_allclose(best_lag(excess) - 3, [1.0])
    before, here, after = votes(excess[None])[0, 0, 3:6, 0]
    assert 0.5 * (before - after) / (before - 2 * here + after) > 0.06


def test_a_peak_at_an_end_or_without_a_neighbour_has_no_place():
    heights = np.array([[3.0, 2.0, 1.0, 0.0], [np.nan, 2.0, 1.0, 0.0], [0.0, 1.0, 1.0, 0.0], [np.nan] * 4])
    found = best_lag(np.repeat(heights[:, :, None, None], 5, axis=2))
    np.testing.assert_allclose(found, [np.nan, np.nan, 1.5, np.nan])
