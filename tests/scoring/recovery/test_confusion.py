from __future__ import annotations

import math

import numpy as np
import pytest

from brainbench.core.errors import UsageError
from brainbench.scoring.recovery import Recovery, plot_confusion
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
    wins, losses = (((0.9, 0.1), (0, 1)), ((0.1, 0.9), (1, 0))), (((0.1, 0.9), (0, 0)), ((0.9, 0.1), (0, 0)))
    boards = (_board(number % 2, number, *(wins if number < won else losses)[number % 2]) for number in range(20))
    assert Recovery(("a", "b"), DESIGN, 12, tuple(boards)).answer(0.8).startswith(word)


def test_ties_count_against_a_yes():
    boards = tuple(_board(true, number, (0.9, 0.8)[:: 1 - 2 * true]) for true in (0, 1) for number in range(20))
    answer = Recovery(("a", "b"), DESIGN, 12, boards).answer(0.8)
    assert answer.startswith("Not beyond these stimuli: the true network comes first in 100%")
    assert "100% of the pairs with it tie" in answer


def test_boards_without_a_score_or_with_equal_ones_have_no_winner():
    boards = (_board(0, 0, (math.nan, math.nan)), _board(1, 0, (0.5, 0.5)))
    found = Recovery(("a", "b"), DESIGN, 8, boards)
    assert not np.any(found.firsts)
    assert len(found.notes) == 2


def test_equal_recoveries_have_equal_pictures(tmp_path):
    pytest.importorskip("matplotlib")
    boards = (RecoveryBoard(0, 0, "x", (0.9, 0.2), (0, 1), 0.5), RecoveryBoard(1, 0, "x", (0.9, 0.2), (0, 0), 0.5))
    found = Recovery(("a", "b"), DESIGN, 12, boards)
    pictures = [plot_confusion(found, tmp_path / name).read_bytes() for name in ("a.png", "b.png")]
    assert pictures[0] == pictures[1]
    other = Recovery(("a", "b"), DESIGN, 12, boards[:1])
    assert plot_confusion(other, tmp_path / "c.png").read_bytes() != pictures[0]
    with pytest.raises(UsageError, match=r"\.png"):
        plot_confusion(found, tmp_path / "a.gif")
