import h5py
import numpy as np
import pytest
import xarray as xr

from brainbench.core.errors import DataError, DataFileNotFoundError, UsageError
from brainbench.core.files import to_json
from brainbench.stimuli import Stimuli, load_stimuli, read_stimulus_set, to_grid, write_stimulus_set
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.scenes.recipes import get_recipe
from brainbench.stimuli.simulation import simulate
from tests.factories.engines import FakeEngine

OPTIONS = {"fidelity": Fidelity(), "backend": FakeEngine()}


@pytest.fixture(scope="module")
def dataset():
    return simulate(get_recipe("rodgers", whiskers="C0-C3,D1").scenes, **OPTIONS)


def _arrays(path, **content):
    with h5py.File(path, "w") as file:
        for key, value in content.items():
            file[key] = value
    return path


def test_a_recipe_name_gives_labelled_input():
    stimuli = load_stimuli("rodgers", whiskers="C0-C3", **OPTIONS)
    assert stimuli.labels[0] == "convex-close"
    assert stimuli.input.shape == (6, 22, 30, 5, 7)
    assert stimuli.input.dtype == np.float32
    assert "Rodgers (2022)" in stimuli.description
    assert repr(stimuli).startswith("Stimuli('convex-close', 'convex-medium'")
    assert "input 6 × 22 × 30 × 5 × 7" in repr(stimuli)
    assert stimuli.content_hash == stimuli.dataset.attrs["content_hash"]


@pytest.mark.parametrize(
    ("errors", "whole"),
    [
        (None, None),
        ((0.1, 0.5, 9.0), np.hypot(0.1 * 3, 0.5 * 4) / 5),
        ((np.nan, 0.5, 9.0), 0.4),
        ((np.inf, 0, 0), np.inf),
    ],
)
def test_the_error_of_all_forces_counts_whiskers_by_what_they_feel(errors, whole):
    wrench = np.zeros((1, 4, 3, 6))
    wrench[0, :, 0, 1], wrench[0, :, 1, 2] = 3.0, 4.0
    variables = {"wrench": (("stimulus", "time", "whisker", "channel"), wrench)}
    if errors is not None:
        variables["error"] = (("stimulus", "whisker"), np.array([errors], dtype=float))
    stimuli = Stimuli(("a",), np.zeros((1, 4, 1)), xr.Dataset(variables), "", "", "")
    assert stimuli.error == (whole if whole is None else pytest.approx(whole))


@pytest.mark.parametrize(
    ("fidelity", "promise"),
    [(to_json(Fidelity.auto(error=0.2), indent=None), 0.2), (to_json(Fidelity(error=1e-5), indent=None), 1e-5),
     (to_json(Fidelity(), indent=None), None), ("{}", None), ("of another lab", None), (None, None)],
)  # fmt: skip
def test_stimuli_say_what_error_their_fidelity_promised(fidelity, promise):
    dataset = xr.Dataset(attrs={} if fidelity is None else {"fidelity": fidelity})
    assert Stimuli(("a",), np.zeros((1, 4, 1)), dataset, "", "", "").promise == promise
    assert Stimuli(("a",), np.zeros((1, 4, 1)), None, "", "", "").promise is None


def test_a_scene_file_is_simulated(tmp_path):
    path = tmp_path / "one.toml"
    path.write_text('[array]\nwhiskers = "C2"\n[[scene]]\nlabel = "free"\n')
    stimuli = load_stimuli(str(path), **OPTIONS)
    assert stimuli.labels == ("free",)
    assert stimuli.description == "one"


def test_a_stimulus_set_survives_the_disk_unchanged(tmp_path, dataset):
    path = write_stimulus_set(dataset, tmp_path / "set.h5")
    xr.testing.assert_identical(read_stimulus_set(path), dataset)
    stimuli = load_stimuli(path)
    np.testing.assert_array_equal(stimuli.input, to_grid(dataset))
    assert stimuli.content_hash == dataset.attrs["content_hash"]


def test_whiskers_of_a_finished_set_can_be_chosen(tmp_path, dataset):
    path = write_stimulus_set(dataset, tmp_path / "set.nc")
    stimuli = load_stimuli(path, whiskers="C*")
    assert list(stimuli.dataset["whisker"].values) == ["C0", "C1", "C2", "C3"]
    assert stimuli.content_hash != dataset.attrs["content_hash"]
    assert load_stimuli(dataset, whiskers="C*").content_hash == stimuli.content_hash
    assert load_stimuli(load_stimuli(dataset), whiskers="C*").content_hash == stimuli.content_hash
    with pytest.raises(UsageError, match="Unknown whisker 'A0'"):
        load_stimuli(path, whiskers="A0")


@pytest.mark.parametrize("change", ["wrench", "cells"])
def test_a_set_that_was_edited_is_another_one(tmp_path, dataset, change):
    if change == "wrench":
        edited = dataset.assign(wrench=2 * dataset["wrench"])
    else:
        edited = dataset.assign_coords(col=("whisker", dataset["col"].values[[1, 0, *range(2, len(dataset["col"]))]]))
    before, after = load_stimuli(dataset), load_stimuli(edited)
    assert (before.input != after.input).any()
    for name in ("content_hash", "config_hash"):
        assert getattr(before, name) == dataset.attrs[name]
        assert getattr(after, name) != getattr(before, name)
    assert load_stimuli(edited, whiskers="C1").config_hash != load_stimuli(dataset, whiskers="C1").config_hash
    with pytest.raises(DataError, match="hash_stimulus_set"):
        read_stimulus_set(write_stimulus_set(edited, tmp_path / "set.h5"))


def test_choosing_whiskers_leaves_the_data_set_of_the_caller_alone(dataset):
    before = dataset.attrs["content_hash"]
    load_stimuli(dataset, whiskers="C2")
    assert dataset.attrs["content_hash"] == before


def test_arrays_are_taken_as_they_are(tmp_path):
    values = np.random.default_rng(0).normal(size=(3, 4, 5))
    path = _arrays(tmp_path / "a.h5", stimuli=values, labels=["one", "two", "three"])
    stimuli = load_stimuli(path)
    np.testing.assert_array_equal(stimuli.input, values.astype(np.float32))
    assert stimuli.labels == ("one", "two", "three")
    assert stimuli.dataset is None
    other = _arrays(tmp_path / "b.h5", stimuli=values, labels=["one", "three", "two"])
    assert load_stimuli(other).content_hash != stimuli.content_hash


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"x": np.zeros((2, 3))}, r"lacks stimuli and labels.*It holds: 'x \[2, 3\]'"),
        ({"stimuli": np.zeros((2, 3))}, "lacks labels"),
        ({"stimuli": np.zeros(2), "labels": ["a", "b"]}, r"must be numbers of shape \[K, T, …\]; it is \[2\]"),
        ({"stimuli": np.zeros((2, 3)), "labels": ["a"]}, r"must be 2 texts, one per stimulus; it is \[1\]"),
        ({"stimuli": np.zeros((2, 3)), "labels": [1, 2]}, "must be 2 texts"),
        ({"stimuli": np.zeros((2, 3)), "labels": ["a", "a"]}, "names a stimulus twice"),
        ({"stimuli": np.full((2, 3), np.nan), "labels": ["a", "b"]}, "not finite, in 'a', 'b'"),
    ],
)
def test_an_array_file_that_does_not_fit_says_what_it_holds(tmp_path, content, message):
    path = _arrays(tmp_path / "bad.h5", **content)
    with pytest.raises(DataError, match=message):
        load_stimuli(path)


def test_whiskers_of_an_array_file_have_no_names(tmp_path):
    path = _arrays(tmp_path / "a.h5", stimuli=np.zeros((1, 2)), labels=["a"])
    with pytest.raises(UsageError, match=r"a\.h5' .*'all'"):
        load_stimuli(path, whiskers="C2")


def test_an_unknown_name_suggests_the_nearest_and_the_kinds_of_files():
    with pytest.raises(UsageError, match=r"'rodger'; did you mean 'rodgers'.*\.toml"):
        load_stimuli("rodger")


def test_files_that_are_missing_or_damaged_are_named(tmp_path, dataset):
    with pytest.raises(DataFileNotFoundError, match=r"/gone\.h5'"):
        load_stimuli(tmp_path / "gone.h5")
    text = tmp_path / "text.h5"
    text.write_text("hello")
    with pytest.raises(DataError, match=r"text\.h5' .*HDF5"):
        load_stimuli(text)
    path = write_stimulus_set(dataset, tmp_path / "set.h5")
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(DataError, match=r"set\.h5"):
        load_stimuli(path)


def test_an_edited_set_is_noticed(tmp_path, dataset):
    path = write_stimulus_set(dataset, tmp_path / "set.h5")
    with h5py.File(path, "r+") as file:
        file["wrench"][0, 0, 0, 0] += 1
    with pytest.raises(DataError, match=r"set\.h5' .*hash_stimulus_set"):
        load_stimuli(path)


def test_labels_are_known_before_scenes_are_built(tmp_path):
    from brainbench.stimuli import get_recipe
    from brainbench.stimuli.sources import known_labels

    path = tmp_path / "scene.toml"
    path.write_text('[[scene]]\nlabel = "a"\n[[scene]]\nlabel = "b"\n')
    assert known_labels("rodgers") == get_recipe("rodgers").labels
    assert known_labels(path) == ("a", "b")
    path.write_text("[[scene]]\n")
    assert [known_labels(source) for source in (path, "set.h5", "no-such-recipe", None)] == [None] * 4
