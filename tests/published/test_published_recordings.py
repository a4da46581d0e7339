"""Scores on the published ``.npz`` recordings: never ``ok``, and the published estimator on the array as it is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import brainbench
from brainbench.core.errors import UsageError
from brainbench.published.estimator import POOL, make_targets, score_published
from brainbench.scoring.neural_responses import open_neural_responses
from brainbench.scoring.scores import score_record
from tests.factories.published_files import make_zero_filled, write_published

SLOTS = tuple(f"slot-{number}" for number in range(1, 7))


@pytest.fixture(scope="module")
def arrays():
    shown = np.resize(np.arange(6), 60)
    return {
        f"m{seed}": make_zero_filled([60, 54], units=10, seed=seed, order=[shown, shown[:54]])[0] for seed in range(5)
    }


@pytest.fixture(scope="module")
def file(arrays, tmp_path_factory):
    return write_published(tmp_path_factory.mktemp("published") / "rodgers6_data.npz", **arrays)


@pytest.fixture(scope="module")
def features():
    rng = np.random.default_rng(3)
    return {f"layer{number}": rng.normal(size=(6, 30)) for number in range(3)}


@pytest.mark.slow
@pytest.mark.parametrize("options", [{}, {"metric": "rsa-correlation"}, {"metric": "ridge"}, {"estimator": "thesis"}])
def test_no_score_is_ok_and_the_first_reason_is_the_labels(file, features, options):
    record = score_record(features, recordings=file, stimuli="rodgers", **options)
    for score in (record.score, record.animal_to_animal):
        assert score.status == "unreliable"
        assert "570 of 570 trials" in score.reasons[0]
        assert np.isfinite(score.value)


def test_zeros_of_other_slots_enter_no_default_score(file, arrays):
    found = open_neural_responses(file, progress=None).trials(SLOTS)
    for animal, array in arrays.items():
        for session, block in zip(found[animal], (array[:, :, :10], array[:54, :, 10:]), strict=True):
            slots = block.sum(axis=2).argmax(axis=1)
            np.testing.assert_array_equal(session.labels, slots)
            np.testing.assert_allclose(session.responses[:, 0], block[np.arange(len(block)), slots], rtol=1e-6)


def test_published_estimators_take_no_choice_of_units(file, features):
    with pytest.raises(UsageError, match="units_reliability"):
        brainbench.score(features, recordings=file, estimator="thesis", units_reliability=0.5)


@pytest.mark.parametrize("estimator", ["thesis", pytest.param("thesis-input", marks=pytest.mark.slow)])
def test_published_estimators_take_the_array_as_it_is(file, arrays, features, estimator):
    found = brainbench.score(features, recordings=file, estimator=estimator)
    expected = score_published(
        features, make_targets(arrays), name="features", stimuli=found.stimuli, estimator=estimator
    )
    assert found.value == expected.value
    assert POOL in [part.subject for part in found.subjects]


def test_a_layer_asked_for_is_the_only_one(file, features):
    score = brainbench.score(features, recordings=file, estimator="thesis", layer="layer1")
    assert [layer.layer for layer in score.layers] == ["layer1"]


def test_other_numbers_of_stimuli_need_a_match(file, features, tmp_path):
    with pytest.raises(UsageError, match="--match"):
        brainbench.score({"a": np.zeros((40, 3))}, recordings=file, stimuli="objects")
    recipe = ["convex-close", "convex-medium", "convex-far", "concave-close", "concave-medium", "concave-far"]
    pairs = dict(zip(SLOTS, reversed(recipe), strict=True))
    score = brainbench.score(features, recordings=file, match=pairs, metric="rsa-correlation")
    assert dict(score.provenance.pairs) == pairs
    assert score.status == "unreliable"


@pytest.mark.slow
@pytest.mark.shared
def test_the_numbers_of_the_page_are_those_of_the_example(reference):
    page = (Path(__file__).parents[2] / "docs" / "published-files.md").read_text(encoding="utf-8")
    for line, options in (("thesis", {"estimator": "thesis"}), ("rsa-correlation", {"metric": "rsa-correlation"})):
        row = next(row for row in page.splitlines() if row.startswith("| `--") and line in row)
        stated = [float(cell.replace("−", "-")) for cell in row.split("|")[2:5]]
        record = score_record("zhuang-small", recordings=reference / "published" / "rodgers6_example.npz", **options)
        raw, animals = record.baselines["raw input"], record.animal_to_animal
        assert [raw.value, raw.p, animals.value] == pytest.approx(stated, abs=0.02)
