import math

import numpy as np
import pytest

from brainbench.scoring.recovery import Recovery
from brainbench.scoring.recovery.boards import RecoveryBoard
from tests.factories.candidates import DESIGN


def _board(true, number, scaled, told=(0, 0)):
    return RecoveryBoard(true, number, "layer1", scaled, told, 0.5)


def test_boards_are_counted_by_who_made_them_and_who_came_first():
    boards = (
        _board(0, 0, (0.9, 0.2), (0, 1)),
        _board(0, 1, (0.4, 0.6)),
        _board(1, 0, (0.1, 0.8), (-1, 0)),
        _board(1, 1, (0.1, 0.8), (1, 0)),
    )
    found = Recovery(("a", "b"), DESIGN, 12, boards)
    assert found.firsts.tolist() == [[1, 1], [0, 2]]
    assert found.win_rate == 0.75
    assert found.outcomes == {"win": 0.5, "tie": 0.25, "loss": 0.25}
    assert found.hardest() == [("a", "b", 0.5)]
    assert found.wins(1).high == 1.0
    assert found.wins().low < 0.75 < found.wins().high


@pytest.mark.parametrize(("won", "word"), [(20, "Yes"), (2, "No"), (17, "Undecided")])
def test_the_answer_follows_the_interval(won, word):
    boards = tuple(_board(0, number, (0.9, 0.1) if number < won else (0.1, 0.9)) for number in range(20))
    assert Recovery(("a", "b"), DESIGN, 12, boards).answer(0.8).startswith(word)


def test_boards_without_a_score_or_with_equal_ones_have_no_winner():
    boards = (_board(0, 0, (math.nan, math.nan)), _board(1, 0, (0.5, 0.5)))
    found = Recovery(("a", "b"), DESIGN, 8, boards)
    assert not np.any(found.firsts)
    assert len(found.notes) == 2
