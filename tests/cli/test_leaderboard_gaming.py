"""What could raise a score without a better model: many layers, copies, units, the brain's own dissimilarities."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from brainbench.core.records import ResultRecord
from brainbench.datasets import open_recordings
from brainbench.scoring.scores import score_record
from leaderboards import rank


@pytest.fixture
def scored(study):
    """Return a function from {layer: [K, F]} to its record on four animals and eight stimuli."""
    recordings = open_recordings(study["recordings"], conditions="trials:texture")

    def call(layers: dict[str, np.ndarray]) -> ResultRecord:
        return score_record(layers, recordings=recordings, stimuli=study["arrays"], time="mean")

    return call


@pytest.fixture
def layer():
    return np.random.default_rng(1).normal(size=(8, 6))


def test_a_copied_layer_changes_neither_value_nor_p(scored, layer):
    one, two = scored({"fc": layer}).score, scored({"fc": layer, "copy": layer}).score
    assert two.value == pytest.approx(one.value)
    assert two.p == pytest.approx(one.p)


@pytest.mark.parametrize("factor", [1e-100, 1e100])
def test_other_units_of_the_activations_change_nothing(scored, layer, factor):
    one, other = scored({"fc": layer}).score, scored({"fc": factor * layer}).score
    assert other.value == pytest.approx(one.value)
    assert (other.p, other.status) == (pytest.approx(one.p), one.status)


@pytest.mark.slow
def test_hundreds_of_random_layers_are_not_told_apart_from_chance(scored):
    rng = np.random.default_rng(2)
    p = [scored({f"layer{i}": rng.normal(size=(8, 6)) for i in range(300)}).score.p for _ in range(4)]
    assert sum(value <= 0.05 for value in p) <= 1
    assert np.mean(p) > 0.15


def test_coordinates_made_from_the_dissimilarities_of_the_brain_stand_apart(scored, layer):
    record = scored({"fc": layer})
    size = len(record.score.stimuli)
    distances = np.zeros((size, size))
    distances[np.triu_indices(size, 1)] = record.score.brain_rdm
    distances += distances.T
    centred = np.eye(size) - 1 / size
    values, vectors = np.linalg.eigh(-0.5 * centred @ distances @ centred)
    cheat = scored({"mds": vectors * np.sqrt(np.maximum(values, 0))})
    assert cheat.score.value > record.score.value
    (board,) = rank([replace(cheat, synthetic=True), replace(record, synthetic=True)])
    assert all(entry.unranked_because.startswith("not repeatable here") for entry in board.entries)
    assert board.leader is None
