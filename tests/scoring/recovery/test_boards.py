from dataclasses import replace

import numpy as np
import pytest

from brainbench.metrics import get_metric
from brainbench.metrics.rdms.pairs import square
from brainbench.scoring.recovery.boards import Board, draw_board, make_board, pairs_of, score_board
from tests.factories.candidates import DESIGN, make_candidates


@pytest.mark.parametrize("metric", ["rsa", "cka", "rsa-crossnobis"])
def test_the_fast_value_is_that_of_the_score(metric):
    candidates, design = make_candidates(), replace(DESIGN, metric=metric)
    _, rows, animals = draw_board(candidates, design, 1, 0)
    found = score_board(candidates, rows, animals, design)
    for place, item in enumerate(candidates):
        score = get_metric(metric).score(item.features, animals, name=item.name, stimuli=item.stimuli)
        assert found.values[place] == pytest.approx(score.value, abs=1e-12)
        np.testing.assert_allclose(found.animals[place], [one.value for one in score.subjects], atol=1e-12)
        assert found.reliability == pytest.approx(score.reliability)


def test_values_without_a_stimulus_are_those_of_the_other_stimuli():
    candidates = make_candidates(layers=1)
    _, rows, animals = draw_board(candidates, DESIGN, 0, 0)
    found = score_board(candidates, rows, animals, DESIGN)
    kept = np.delete(rows, 3)
    pairs = pairs_of(kept, len(rows))
    fewer = [replace(one, rdm=one.rdm[pairs]) for one in animals]
    less = score_board(candidates, kept, fewer, DESIGN)
    np.testing.assert_allclose(found.without_stimulus[:, 3], less.values, atol=1e-12)


def test_the_network_that_made_the_data_scores_highest():
    candidates = make_candidates(20)
    for true in range(3):
        board = make_board(candidates, DESIGN, true, 0)
        assert board.first == true
        assert board.told[true] == 0
        assert min(board.told) >= 0


def test_few_animals_are_never_told_apart():
    few = replace(DESIGN, population=replace(DESIGN.population, animals=3))
    assert make_board(make_candidates(20), few, 0, 0).told == (0, 0, 0)


def test_another_metric_makes_its_whole_score():
    design = replace(DESIGN, metric="procrustes", population=replace(DESIGN.population, animals=4))
    candidates = make_candidates(layers=1)
    _, rows, animals = draw_board(candidates, design, 2, 0)
    assert int(np.argmax(score_board(candidates, rows, animals, design).values)) == 2


def test_a_board_is_the_same_again_and_others_differ():
    candidates = make_candidates()
    once = make_board(candidates, DESIGN, 0, 4)
    assert make_board(make_candidates(), DESIGN, 0, 4) == once
    assert make_board(candidates, DESIGN, 0, 5).scaled != once.scaled
    assert Board.of({**vars(once), "scaled": [None, *once.scaled[1:]]}).scaled[1:] == once.scaled[1:]


def test_pairs_of_some_stimuli():
    distances = np.arange(15.0)
    rows = np.array([1, 2, 5])
    assert distances[pairs_of(rows, 6)].tolist() == [square(distances)[i, j] for i, j in ((1, 2), (1, 5), (2, 5))]
