from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from brainbench.core.errors import DataError, UsageError
from brainbench.core.files import to_plain
from brainbench.core.reading.values import typed_values
from brainbench.metrics import get_metric, rdm
from brainbench.models.features import write_features
from brainbench.scoring.options import ScoreOptions
from brainbench.scoring.recovery import (
    Candidate,
    Recovery,
    boards,
    find_cheapest,
    open_candidates,
    plot_confusion,
    recover,
)
from brainbench.scoring.recovery.boards import RecoveryBoard, draw_board, make_board, score_board
from tests.factories.candidates import DESIGN, make_candidates


def test_layers_without_differences_are_left_out():
    values = np.random.default_rng(0).standard_normal((5, 3))
    found = Candidate.of("a", "vwxyz", {"same": np.ones((5, 3)), "good": values, "lost": values * np.nan})
    assert list(found.features) == ["good"]
    with pytest.raises(UsageError, match="No layer of a differs"):
        Candidate.of("a", "vwxyz", {"same": np.ones((5, 3))})


def test_the_geometry_of_a_layer_has_its_distances():
    (candidate,) = make_candidates(8, names=("a",))
    rows = np.array([0, 2, 3, 7])
    found = candidate.geometry("layer2", rows).rdm
    wanted = rdm(candidate.features["layer2"][rows], method="sqeuclidean")
    np.testing.assert_allclose(found / found.sum(), wanted / wanted.sum())


def test_an_unknown_layer_names_the_nearest():
    (candidate,) = make_candidates(names=("a",))
    random = np.random.default_rng(0)
    assert candidate.choose("last", random) == "layer2"
    assert {candidate.choose("any", random) for _ in range(20)} == {"layer1", "layer2"}
    with pytest.raises(UsageError, match="layer2"):
        candidate.choose("layr2", random)


def _features(path, names, seed):
    write_features(path, names, {"x": np.random.default_rng(seed).standard_normal((len(names), 4))})
    return str(path)


def test_files_of_activations_are_joined_by_label(tmp_path):
    names = ["p", "q", "r", "s", "t"]
    one = _features(tmp_path / "one.h5", names, 0)
    other = _features(tmp_path / "other.h5", names[::-1], 1)
    found, _ = open_candidates([one, other], ScoreOptions())
    assert [item.stimuli for item in found] == [tuple(names)] * 2
    straight, _ = open_candidates([other, one], ScoreOptions())
    np.testing.assert_allclose(found[1].features["x"], straight[0].features["x"][::-1])


def test_a_recovery_needs_two_different_candidates_of_the_same_stimuli(tmp_path):
    one = _features(tmp_path / "one.h5", ["p", "q", "r"], 0)
    with pytest.raises(UsageError, match="at least 2"):
        open_candidates([one], ScoreOptions())
    with pytest.raises(UsageError, match="'one' is given twice"):
        open_candidates([one, one], ScoreOptions())
    with pytest.raises(UsageError, match="'r'"):
        open_candidates([one, _features(tmp_path / "other.h5", ["p", "q", "z"], 0)], ScoreOptions())


@pytest.mark.parametrize("metric", ["rsa", "cka", "procrustes"])
def test_values_are_those_of_a_whole_score(metric):
    # Chance, on which layers compete, is a mean over orders, so it takes as many to give the same value.
    candidates, design = make_candidates(), replace(DESIGN, metric=metric, orders=get_metric(metric).orders)
    _, rows, animals = draw_board(candidates, design, 1, 0)
    for item, quick in zip(candidates, score_board(candidates, rows, animals, design), strict=True):
        whole = get_metric(metric).score(item.features, animals, name=item.name, stimuli=item.stimuli)
        assert quick.value == pytest.approx(whole.value, abs=1e-12)
        assert quick.attainable == pytest.approx(whole.attainable)
        assert quick.without_stimulus == pytest.approx(whole.without_stimulus)
        assert quick.subjects == whole.subjects
        assert quick.chance == pytest.approx(whole.chance, abs=1e-12)
    fewer = score_board(candidates, rows, animals, replace(design, orders=DESIGN.orders))
    for item, quick in zip(candidates, fewer, strict=True):
        whole = get_metric(metric).score(item.features, animals, name=item.name, stimuli=item.stimuli)
        assert quick.chance == pytest.approx(whole.chance, abs=0.15)


def test_the_network_that_made_the_data_scores_highest():
    candidates = make_candidates(20)
    for true in range(3):
        board = make_board(candidates, DESIGN, true, 0)
        assert board.first == true
        assert board.verdicts[true] == 0
        assert min(board.verdicts) >= 0


def test_few_animals_are_never_told_apart():
    few = replace(DESIGN, population=replace(DESIGN.population, animals=3))
    assert make_board(make_candidates(20), few, 0, 0).verdicts == (0, 0, 0)


def test_a_board_is_the_same_again_and_others_differ():
    candidates = make_candidates()
    once = make_board(candidates, DESIGN, 0, 4)
    assert make_board(make_candidates(), DESIGN, 0, 4) == once
    assert make_board(candidates, DESIGN, 0, 5).scaled != once.scaled


def test_a_score_that_a_board_lacks_is_null_in_its_file():
    board = RecoveryBoard(0, 4, "x", (math.nan, 0.5), (0, 1), math.nan)
    stored = to_plain(board)
    assert stored["scaled"] == [None, 0.5]
    assert stored["reliability"] is None
    assert repr(typed_values(RecoveryBoard, stored, "a board")) == repr(board)


def test_some_of_the_stimuli_are_drawn_anew_for_each_board():
    candidates = make_candidates(12)
    design = replace(DESIGN, stimuli=6)
    shown = [draw_board(candidates, design, 0, number)[1].tolist() for number in range(3)]
    assert all(len(set(rows)) == 6 and rows == sorted(rows) for rows in shown)
    assert len({tuple(rows) for rows in shown}) > 1
    assert score_board(candidates, *draw_board(candidates, design, 0, 0)[1:], design)[0].stimuli == tuple(
        f"s{row}" for row in shown[0]
    )


def test_processes_change_nothing():
    candidates = make_candidates(8)
    here = recover(candidates, DESIGN, boards=2, workers=1)
    assert recover(candidates, DESIGN, boards=2, workers=2) == here
    assert [(one.true, one.number) for one in here.boards] == [(t, n) for t in range(3) for n in range(2)]


def test_a_cluster_changes_nothing():
    distributed = pytest.importorskip("distributed")
    candidates = make_candidates(8)
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None, protocol="tcp", host="127.0.0.1"
    ) as running:
        found = recover(candidates, DESIGN, boards=1, scheduler=running.scheduler_address)
    assert found == recover(candidates, DESIGN, boards=1, workers=1)


def test_an_interrupted_recovery_goes_on(tmp_path, monkeypatch):
    candidates = make_candidates(8)
    whole = recover(candidates, DESIGN, boards=1, workers=1, folder=tmp_path)
    (tmp_path / "boards-001-00000.json").unlink()
    made = []

    def counted(*arguments):
        made.append(arguments[2:])
        return original(*arguments)

    original = boards.make_board
    monkeypatch.setattr(boards, "make_board", counted)
    told = []
    again = recover(
        candidates, DESIGN, boards=1, workers=1, folder=tmp_path, progress=lambda *state: told.append(state)
    )
    assert again == whole
    assert made == [(1, 0)]
    assert told == [(3, 3, "scoring boards")]
    (tmp_path / "boards-001-00000.json").write_text('[{"true": 1}]')
    with pytest.raises(DataError, match=r"lacks 'number'\. Delete it to make it again"):
        recover(candidates, DESIGN, boards=1, workers=1, folder=tmp_path)


def test_a_folder_of_another_recovery_is_refused(tmp_path):
    candidates = make_candidates(8)
    recover(candidates, DESIGN, boards=1, workers=1, folder=tmp_path)
    with pytest.raises(UsageError, match=r"another recovery: design\.seed 0 \(now 1\)"):
        recover(candidates, replace(DESIGN, seed=1), boards=1, workers=1, folder=tmp_path)
    for made in tmp_path.glob("boards-*"):
        made.unlink()
    recover(candidates, replace(DESIGN, seed=1), boards=1, workers=1, folder=tmp_path)
    (tmp_path / "config.json").unlink()
    with pytest.raises(UsageError, match=r"holds no recovery \(it has 'boards-"):
        recover(candidates, DESIGN, boards=1, workers=1, folder=tmp_path)


@pytest.mark.parametrize(
    ("candidates", "changes", "boards", "culprit"),
    [
        (make_candidates(names=("a",)), {}, 1, "at least 2"),
        (make_candidates(8), {"stimuli": 9}, 1, "9 stimuli .* the pool has 8"),
        (make_candidates(8), {"metric": "rsaa"}, 1, "'rsa'"),
        (make_candidates(8), {"layer": "layr1"}, 1, "'layer1'"),
        (make_candidates(8), {"metric": "decoding"}, 1, "'decoding'"),
        (make_candidates(8), {}, 0, "received 0"),
        (make_candidates(8), {"splits": 1.5}, 1, "splits .* received 1.5"),
        (make_candidates(8), {"seed": -1}, 1, "seed .* received -1"),
        ((*make_candidates(8), *make_candidates(9, names=("d",))), {}, 1, "different stimuli"),
    ],
)
def test_what_cannot_be_run_is_refused_before_it_starts(candidates, changes, boards, culprit):
    with pytest.raises(UsageError, match=culprit):
        recover(candidates, replace(DESIGN, **changes), boards=boards, workers=1)


@pytest.fixture
def small(monkeypatch):
    """A grid of four designs."""
    for name, values in (("ANIMALS", (4,)), ("UNITS", (40,)), ("TRIALS", (2, 8)), ("STIMULI", (6, 12))):
        monkeypatch.setattr(boards, name, values)


def test_the_cheapest_design_that_suffices_is_named(small):
    candidates = make_candidates(14)
    best, tried = find_cheapest(candidates, DESIGN, 0.7, boards=3, workers=1)
    assert best is not None
    assert best.win_rate >= 0.7
    assert best == tried[-1]
    costs = [one.animals * one.trials * one.stimuli for one in tried]
    assert max(costs) == costs[-1]


def test_none_is_named_where_none_suffices(small):
    # Twins cannot be told apart, whatever is measured.
    (one,) = make_candidates(14, names=("a",))
    (twin,) = make_candidates(14, names=("b",))
    best, tried = find_cheapest((one, twin), DESIGN, 0.9, boards=4, workers=1)
    assert best is None
    assert tried


def test_no_design_is_named_whose_scores_are_unreliable(small, monkeypatch):
    monkeypatch.setattr(boards, "RELIABILITY_GATE", 1.1)
    best, tried = find_cheapest(make_candidates(14), DESIGN, 0.7, boards=3, workers=1)
    assert best is None
    assert not any(design.win_rate for design in tried)


def test_a_rate_lies_between_0_and_1():
    with pytest.raises(UsageError, match="received 1"):
        find_cheapest(make_candidates(), DESIGN, 1.0)


def _board(true, number, scaled, told=(0, 0), reliability=0.5):
    return RecoveryBoard(true, number, "layer1", scaled, told, reliability)


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
    assert found.notes[-2:] == (
        "1 boards have no score: their animals cannot be compared.",
        "1 boards have no first: the highest score is shared.",
    )


def test_scores_that_are_unreliable_are_no_yes():
    # Of 60 units and 5 trials all scores were unreliable, and the answer was Yes, first in 100 % of the boards.
    wins = ((0.9, 0.1), (0, 1)), ((0.1, 0.9), (1, 0))
    noisy = tuple(_board(number % 2, number, *wins[number % 2], 0.4) for number in range(40))
    answer = Recovery(("a", "b"), DESIGN, 12, noisy).answer()
    assert answer.startswith("Not by scores that count: the true network comes first in 100% of 40 boards")
    assert answer.endswith("but the animals' reliability is below 0.5.")
    clean = tuple(replace(board, reliability=value) for board, value in zip(noisy, [0.6, math.nan] * 20, strict=True))
    assert Recovery(("a", "b"), DESIGN, 12, clean).answer().startswith("Yes")


def test_copies_of_a_network_are_named_and_never_ranked_by_rounding():
    (network, rival) = make_candidates(10, names=("a", "c"))
    random = np.random.default_rng(1)
    turn = np.linalg.qr(random.standard_normal((6, 6)))[0]
    copies = {
        "same": lambda values: values,
        "scaled": lambda values: 3.7 * values,
        "shuffled": lambda values: values[:, random.permutation(6)],
        "turned": lambda values: values @ turn + 5,
    }
    for name, change in copies.items():
        layers = {layer: change(values) for layer, values in network.features.items()}
        copy = Candidate.of(name, network.stimuli, layers)
        result = recover((network, copy, rival), DESIGN, boards=2, workers=1)
        assert result.alike == [("a", name)]
        assert result.answer().startswith(f"No design tells 'a' from {name!r} by this metric")
        assert not result.firsts[:2, :2].any()
        assert result.notes == ("4 boards have no first: the highest score is shared.",)


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
