import numpy as np
import pytest

from brainbench.core.errors import UsageError
from brainbench.metrics import rdm
from brainbench.models.features import write_features
from brainbench.scoring.options import ScoreOptions
from brainbench.scoring.recovery import Candidate, open_candidates
from tests.factories.candidates import make_candidates


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
