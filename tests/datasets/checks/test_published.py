"""What the check says of the published ``.npz`` recordings, against files whose faults are known."""

from __future__ import annotations

import numpy as np
import pytest

from brainbench.datasets import check
from tests.factories.published_recordings import make_zero_filled, write_published


def _finding(checkup, name, word):
    return next(item for item in checkup.findings if item.check == name and word in item.message)


@pytest.mark.shared
def test_the_example_file_is_explained(reference):
    found = check(reference / "published" / "rodgers6_example.npz")
    assert found.verdict == "error"
    assert len(found.sessions) == 6
    # Five of six slots of every trial and unit.
    assert _finding(found, "zeros", "83 %").values["zeros"] == 5 * (31 * 4 + 24 * 3 + 28 * 5 + 19 * 3 + 24 * 4 + 19 * 2)
    assert _finding(found, "labels", "first appear").values["by_first_appearance"] == 6
    assert "allow_pickle" in _finding(found, "file", "keyword").message


def test_dilution_is_how_often_a_slot_was_shown(tmp_path):
    shown = [0] * 12 + [1] * 3 + [2, 3, 4, 5] * 3
    array, _ = make_zero_filled([27], order=[shown])
    values = _finding(check(write_published(tmp_path / "a.npz", m1=array)), "zeros", "true rate").values
    assert (values["least"], values["most"]) == (pytest.approx(3 / 27), pytest.approx(12 / 27))


def _animals(scramble):
    """Eight animals with one geometry; slots are stimuli, or their order differs between animals."""
    rng = np.random.default_rng(1)
    latent = rng.normal(size=(6, 3))
    found = {}
    for animal in range(8):
        slots = np.resize(np.arange(6), 60)
        means = np.exp(2 + 0.4 * latent @ rng.normal(size=(3, 40)))
        order = rng.permutation(6) if scramble else np.arange(6)
        array = np.zeros((60, 6, 40))
        array[np.arange(60), slots] = rng.poisson(means[order[slots]]) + 0.1
        found[f"m{animal}"] = array
    return found


@pytest.mark.parametrize("scramble", [False, True])
def test_labels_that_agree_are_told_from_labels_that_could(tmp_path, scramble):
    path = write_published(tmp_path / "a.npz", **_animals(scramble))
    values = _finding(check(path), "labels", "agree by").values
    assert values["best"] > values["best_chance"]
    assert (values["stored"] > values["stored_chance"]) is not scramble


def test_tuning_that_no_animals_share_is_not_called_shared(tmp_path):
    rng = np.random.default_rng(2)
    animals = {}
    for animal in range(6):
        means = np.exp(2 + 0.4 * rng.normal(size=(6, 15)))
        slots = np.resize(np.arange(6), 60)
        array = np.zeros((60, 6, 15))
        array[np.arange(60), slots] = rng.poisson(means[slots]) + 0.1
        animals[f"m{animal}"] = array
    values = _finding(check(write_published(tmp_path / "a.npz", **animals)), "labels", "agree by").values
    assert values["best"] > 0.5
    assert values["best"] < values["best_chance"]


def test_trials_without_a_spike_and_rare_slots_are_warned_of(tmp_path):
    array, _ = make_zero_filled([24], order=[np.resize(np.arange(6), 24)])
    array[3] = 0
    found = check(write_published(tmp_path / "a.npz", stray=False, m1=array))
    assert "1 of 24" in _finding(found, "silent", "all slots").message
    assert _finding(found, "labels", "fewer than 4 trials").where == "m1"
    assert not [item for item in found.findings if item.check == "file"]


def test_a_damaged_file_is_a_finding(tmp_path):
    (tmp_path / "a.npz").write_bytes(b"")
    assert check(tmp_path / "a.npz").findings[0].check == "file"
