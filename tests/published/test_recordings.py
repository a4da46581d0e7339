"""The published ``.npz`` recordings: what can be recovered, against the sessions they were made from, and bad files."""

from __future__ import annotations

import numpy as np
import pytest

from brainbench.core.errors import DataError, UsageError
from brainbench.datasets import check, inspect, open_recordings
from brainbench.datasets.ledger import balance_line
from brainbench.published.recordings import SILENT, read_published
from tests.factories.published_files import make_zero_filled, write_published


@pytest.fixture
def published(reference):
    return reference / "published"


@pytest.fixture
def truth(published):
    """Session ``animal/number`` → its arrays."""
    with np.load(published / "rodgers6_truth.npz", allow_pickle=False) as stored:
        found = {}
        for key in stored.files:
            animal, session, name = key.split("/")
            found.setdefault(f"{animal}/{session.removeprefix('ses-')}", {})[name] = stored[key]
    return found


@pytest.mark.shared
def test_sessions_units_and_slots_are_those_the_file_was_made_from(published, truth):
    found = {f"{s.subject}/{s.session}": s for s in read_published(published / "rodgers6_example.npz")}
    assert found.keys() == truth.keys()
    for name, session in found.items():
        true = truth[name]
        fired = true["counts"].sum(axis=1) > 0
        assert [session.first, session.first + session.units] == true["units"].tolist()
        assert len(session.slots) == len(true["slot"])
        np.testing.assert_array_equal(session.slots[fired], true["slot"][fired])
        assert (session.slots[~fired] == -1).all()
        # Spikes in [start, choice) over whole bins of 45 ms.
        np.testing.assert_allclose(session.rates, true["counts"] / (true["bins"][:, None] * 0.045))


@pytest.mark.shared
def test_slots_number_the_true_stimuli_in_another_order_in_every_session(published, truth):
    dataset = open_recordings(published / "rodgers6_example.npz")
    stimuli = {}
    for name, true in truth.items():
        animal, session = name.split("/")
        mine = (dataset["subject"].values == animal) & (dataset["session"].values == session)
        rows = dataset["trial_id"].values[mine].astype(int)
        for label, stimulus in zip(dataset["stimulus"].values[mine], true["stimulus"][rows], strict=True):
            stimuli.setdefault((name, str(label)), set()).add(str(stimulus))
    assert all(len(found) == 1 for found in stimuli.values())
    assert len({stimuli[name, "slot-1"].pop() for name in truth}) > 1
    assert "label" in dataset.attrs["label_doubt"]


@pytest.mark.parametrize("stray", [True, False])
def test_the_stray_entry_is_no_animal(tmp_path, stray):
    array, _ = make_zero_filled([24, 30])
    dataset = open_recordings(write_published(tmp_path / "a.npz", stray=stray, m1=array))
    assert set(dataset["subject"].values) == {"m1"}
    assert dataset.sizes["trial"] == 54


def test_zeros_of_other_slots_are_missing_and_silent_trials_are_counted(tmp_path):
    array, slots = make_zero_filled([24])
    array[5] = 0
    dataset = open_recordings(write_published(tmp_path / "a.npz", m1=array))
    kept = np.delete(np.arange(24), 5)
    assert dataset.attrs["removed"] == {f"trials: {SILENT}": 1}
    assert balance_line(dataset.attrs["ledger"]) == f"1 of 24 trials: {SILENT}"
    assert dataset["stimulus"].values.tolist() == [f"slot-{slot + 1}" for slot in slots[0][kept]]
    np.testing.assert_allclose(dataset["counts"].values[:, 0], array[kept, slots[0][kept]], rtol=1e-6)


def test_a_trial_whose_window_has_no_length_is_missing(tmp_path):
    array, slots = make_zero_filled([24, 30])
    # The mean over no bins: NaN in the slot of the trial, zeros elsewhere.
    array[7, slots[0][7], :6] = np.nan
    dataset = open_recordings(write_published(tmp_path / "a.npz", m1=array))
    assert dataset.attrs["removed"] == {f"trials: {SILENT}": 1}
    assert np.unique(dataset["session"].values, return_counts=True)[1].tolist() == [23, 30]


def test_sessions_of_equal_length_are_parted_where_their_slots_contradict(tmp_path):
    array, slots = make_zero_filled([24, 24])
    found = list(read_published(write_published(tmp_path / "a.npz", m1=array)))
    assert [(item.first, item.units) for item in found] == [(0, 6), (6, 6)]
    for item, true in zip(found, slots, strict=True):
        np.testing.assert_array_equal(item.slots, true)


def test_all_borders_of_many_sparse_sessions_are_found(tmp_path):
    rng = np.random.default_rng(0)
    lengths = {f"m{number}": rng.choice([180, 220, 260], 4).tolist() for number in range(11)}
    animals = {name: make_zero_filled(item, 20, seed=seed)[0] for seed, (name, item) in enumerate(lengths.items())}
    for array in animals.values():
        # A quarter of the units fires in one trial of fifty.
        sparse = np.arange(array.shape[2]) % 4 == 0
        array *= ~sparse | (rng.random((len(array), 1, array.shape[2])) < 0.02)
    path = write_published(tmp_path / "a.npz", **animals)
    found = [(item.subject, item.first) for item in read_published(path)]
    assert found == [(name, first) for name in lengths for first in range(0, 80, 20)]
    assert sum(np.diff(item).tolist().count(0) for item in lengths.values()) > 5


def test_sessions_that_never_contradict_look_like_one(tmp_path):
    shown = np.resize(np.arange(6), 24)
    array, _ = make_zero_filled([24, 24], order=[shown, shown])
    assert [item.units for item in read_published(write_published(tmp_path / "a.npz", m1=array))] == [12]


def test_the_window_is_that_of_the_file_name(tmp_path):
    array, _ = make_zero_filled([24])
    names = ("rodgers6_data.npz", "rodgers6_data_touch_to_choice.npz")
    windows = [open_recordings(write_published(tmp_path / name, m1=array)).attrs["window"] for name in names]
    assert windows == ["start..choice", "first-contact..choice"]


def test_an_inspection_tells_sessions_slots_and_the_doubt(tmp_path):
    text = str(inspect(write_published(tmp_path / "a.npz", m1=make_zero_filled([24, 30])[0])))
    assert text.count("subject m1, session") == 2
    assert text.count("cannot be trusted") == 1
    assert "slot-6" in text


def test_options_for_spike_times_are_refused(tmp_path):
    path = write_published(tmp_path / "a.npz", m1=make_zero_filled([24])[0])
    with pytest.raises(UsageError, match="window"):
        open_recordings(path, window="start..choice")


def test_other_layouts_lists_and_copies_are_refused(tmp_path):
    from brainbench.datasets import export

    path = write_published(tmp_path / "a.npz", m1=make_zero_filled([24])[0])
    assert open_recordings(f"published-npz:{path}").sizes["trial"] == 24
    for refused in (
        lambda: open_recordings(f"rodgers:{path}"),
        lambda: open_recordings([path, write_published(tmp_path / "b.npz", m1=make_zero_filled([24])[0])]),
        lambda: export(path, tmp_path / "a.h5"),
    ):
        with pytest.raises(DataError, match="one at a time"):
            refused()
    assert not (tmp_path / "a.h5").exists()


def _edited(change):
    array = make_zero_filled([24, 30])[0]
    change(array)
    return {"m1": array}


BAD = {
    "two stimuli": ({"m1": np.zeros((5, 2, 3))}, "6 stimuli"),
    "two axes": ({"m1": np.zeros((5, 6))}, r"\[5, 6\]"),
    "no trials": ({"m1": np.zeros((0, 6, 3))}, r"\[0, 6, 3\]"),
    "text": ({"m1": np.full((5, 6, 3), "a")}, "not numbers"),
    "all NaN": ({"m1": np.full((5, 6, 3), np.nan)}, "every value is NaN"),
    "negative": (_edited(lambda a: a.__setitem__((0, 0, 0), -1)), "negative"),
    "infinite": (_edited(lambda a: a.__setitem__((0, 0, 0), np.inf)), "infinite"),
    "NaN row": (_edited(lambda a: a.__setitem__((2, slice(None), 1), np.nan)), "inside a session"),
    "two slots": (_edited(lambda a: a.__setitem__((2, slice(None), 1), 3.0)), "several slots"),
    "sweep": ({"data": np.zeros((110, 35, 6)), "shape": np.array("a/b"), "label": np.array(3)}, "whisker sweep"),
    "splits": ({"r_xy": np.zeros(3), "r_yy": np.zeros(3)}, "--explain-estimator"),
    "nothing": ({}, "no animal"),
}


@pytest.mark.parametrize("name", BAD)
def test_arrays_that_are_no_recordings_are_refused_in_one_sentence(tmp_path, name):
    arrays, culprit = BAD[name]
    path = tmp_path / "a.npz"
    np.savez(path, **arrays)
    with pytest.raises(DataError, match=culprit):
        open_recordings(path)


def test_files_that_are_no_archives_are_refused_in_one_sentence(tmp_path):
    whole = write_published(tmp_path / "whole.npz", m1=make_zero_filled([24])[0]).read_bytes()
    for content, culprit in ((b"", "empty"), (b"rates\n", "no zip archive"), (whole[:-500], "truncated")):
        (tmp_path / "a.npz").write_bytes(content)
        with pytest.raises(DataError, match=culprit):
            open_recordings(tmp_path / "a.npz")
    middle = len(whole) // 3
    (tmp_path / "a.npz").write_bytes(whole[:middle] + b"\xff" * 64 + whole[middle + 64 :])
    with pytest.raises(DataError, match=r"a\.npz.*CRC"):
        open_recordings(tmp_path / "a.npz")


def test_python_objects_are_never_loaded(tmp_path):
    np.savez(tmp_path / "a.npz", m1=np.array([{"a": 1}, None], dtype=object))
    with pytest.raises(DataError, match="never loaded"):
        open_recordings(tmp_path / "a.npz")


def test_a_foreign_archive_is_refused(tmp_path):
    import zipfile

    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("word/document.xml", "<a/>")
    with pytest.raises(DataError, match=r"word/document\.xml"):
        open_recordings(tmp_path / "a.npz")


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
