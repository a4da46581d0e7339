from dataclasses import replace

import pytest

from brainbench.metrics import get_metric
from brainbench.scoring.recovery.boards import RecoveryBoard, draw_board, make_board, score_board
from tests.factories.candidates import DESIGN, make_candidates


@pytest.mark.parametrize("metric", ["rsa", "cka", "procrustes"])
def test_values_are_those_of_a_whole_score(metric):
    candidates, design = make_candidates(), replace(DESIGN, metric=metric)
    _, rows, animals = draw_board(candidates, design, 1, 0)
    for item, quick in zip(candidates, score_board(candidates, rows, animals, design), strict=True):
        whole = get_metric(metric).score(item.features, animals, name=item.name, stimuli=item.stimuli)
        assert quick.value == pytest.approx(whole.value, abs=1e-12)
        assert quick.attainable == pytest.approx(whole.attainable)
        assert quick.without_stimulus == pytest.approx(whole.without_stimulus)
        assert quick.subjects == whole.subjects
        # Chance is a mean over fewer orders.
        assert quick.chance == pytest.approx(whole.chance, abs=0.15)


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


def test_a_board_is_the_same_again_and_others_differ():
    candidates = make_candidates()
    once = make_board(candidates, DESIGN, 0, 4)
    assert make_board(make_candidates(), DESIGN, 0, 4) == once
    assert make_board(candidates, DESIGN, 0, 5).scaled != once.scaled
    assert RecoveryBoard.of({**vars(once), "scaled": [None, *once.scaled[1:]]}).scaled[1:] == once.scaled[1:]


def test_some_of_the_stimuli_are_drawn_anew_for_each_board():
    candidates = make_candidates(12)
    design = replace(DESIGN, stimuli=6)
    shown = [draw_board(candidates, design, 0, number)[1].tolist() for number in range(3)]
    assert all(len(set(rows)) == 6 and rows == sorted(rows) for rows in shown)
    assert len({tuple(rows) for rows in shown}) > 1
    assert score_board(candidates, *draw_board(candidates, design, 0, 0)[1:], design)[0].stimuli == tuple(
        f"s{row}" for row in shown[0]
    )
