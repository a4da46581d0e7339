from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from brainbench.core.errors import UsageError
from brainbench.metrics import get_metric, rdm
from brainbench.models.features import write_features
from brainbench.scoring.options import ScoreOptions
from brainbench.scoring.recovery import Candidate, open_candidates
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
    assert RecoveryBoard.of({**once.stored, "scaled": [None, *once.scaled[1:]]}).scaled[1:] == once.scaled[1:]


def test_some_of_the_stimuli_are_drawn_anew_for_each_board():
    candidates = make_candidates(12)
    design = replace(DESIGN, stimuli=6)
    shown = [draw_board(candidates, design, 0, number)[1].tolist() for number in range(3)]
    assert all(len(set(rows)) == 6 and rows == sorted(rows) for rows in shown)
    assert len({tuple(rows) for rows in shown}) > 1
    assert score_board(candidates, *draw_board(candidates, design, 0, 0)[1:], design)[0].stimuli == tuple(
        f"s{row}" for row in shown[0]
    )
