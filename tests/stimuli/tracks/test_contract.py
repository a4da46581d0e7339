"""Faults of tracks are counted where they can be used, and refused where they cannot."""

from __future__ import annotations

import numpy as np
import pytest

from brainbench.core.errors import DataError
from brainbench.stimuli.fitting import new_shapes
from brainbench.stimuli.tracks.contract import check_length, check_track, inspect_track
from tests.factories.whisker_tracks import bent_shapes

SHAPES = bent_shapes(frames=40)
TIMES = np.arange(40) / 500


def _with(shapes):
    return new_shapes(TIMES, shapes)


def test_a_clean_track_has_no_faults():
    assert check_track(_with(SHAPES)).words == ()


def test_gaps_are_counted():
    shapes = SHAPES.copy()
    shapes[5:12] = np.nan
    shapes[20] = np.nan
    shapes[30, 4] = np.nan
    found = check_track(_with(shapes))
    assert (found.missing_frames, found.longest_gap) == (8, 7)
    assert found.missing_points == pytest.approx(1 / (32 * 10))


def test_more_gaps_than_shapes_are_refused():
    shapes = SHAPES.copy()
    shapes[:25] = np.nan
    with pytest.raises(DataError, match="25 of 40 frames"):
        check_track(_with(shapes))


def test_a_whisker_that_changes_places_with_its_neighbour_is_found():
    shapes = SHAPES.copy()
    shapes[20:] += [0.0, 0.004]
    assert inspect_track(_with(shapes)).jumps.tolist() == [20]
    with pytest.raises(DataError, match="changes places"):
        check_track(_with(shapes))


def test_a_mirrored_shape_is_found():
    shapes = bent_shapes(frames=40, bend=0.4)
    mirrored = bent_shapes(frames=40, bend=-0.4)
    shapes[25:] = mirrored[25:]
    assert 25 in inspect_track(_with(shapes)).jumps.tolist()


def test_a_whisker_of_the_other_side_is_found():
    shapes = SHAPES.copy()
    shapes[10] *= -1
    assert {10, 11} <= set(inspect_track(_with(shapes)).jumps.tolist())


@pytest.mark.parametrize(("factor", "word"), [(1000, "millimetres"), (1e-3, "metres taken"), (1.4, "21")])
def test_wrong_units_and_long_shapes_are_refused(factor, word):
    with pytest.raises(DataError, match=word):
        check_length(_with(SHAPES * factor), 0.0152)


def test_traces_whose_points_lie_at_one_place_are_one_sentence():
    shapes = SHAPES.copy()
    shapes[:30] = shapes[:30, :1]
    for points in (np.zeros_like(SHAPES), shapes):
        with pytest.raises(DataError, match="lie at one place; trace them along the whisker"):
            check_length(_with(points), 0.0152)
    shapes[:30:2] = SHAPES[:30:2]
    check_length(_with(shapes), 0.0155)


def test_noise_does_not_make_a_shape_too_long():
    rng = np.random.default_rng(0)
    shapes = bent_shapes(frames=40, points=200)
    check_length(_with(shapes + rng.normal(size=shapes.shape) * 5e-5), 0.0155)


@pytest.mark.parametrize(
    "times", [np.zeros(40), TIMES[:-1], np.where(TIMES > 0.05, np.nan, TIMES), np.append(TIMES[:-1], np.inf)]
)
def test_times_must_increase(times):
    with pytest.raises(DataError, match="times"):
        new_shapes(times, SHAPES)
