from pathlib import Path

import h5py
import numpy as np
import pytest

from brainbench.core.errors import DataError, DataFileNotFoundError
from brainbench.models.features import read_features, write_features


def test_features_come_back_with_a_time_axis_and_their_names(tmp_path: Path):
    rng = np.random.default_rng(0)
    layers = {"block/conv": rng.normal(size=(3, 4)), "gru": rng.normal(size=(3, 2, 5)).astype(np.float32)}
    features = read_features(write_features(tmp_path / "a.h5", ["x", "y", "z"], layers))
    assert features.labels == ("x", "y", "z")
    assert set(features.activations) == set(layers)
    np.testing.assert_array_equal(features.activations["block/conv"][:, 0], layers["block/conv"])
    np.testing.assert_array_equal(features.activations["gru"], layers["gru"])


def test_nested_groups_of_other_writers_become_layer_names(tmp_path: Path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["labels"] = np.array([b"x", b"y"])
        file["activations/layer1/conv"] = np.ones((2, 3))
    assert list(read_features(tmp_path / "a.h5").activations) == ["layer1/conv"]


def test_bad_files_are_refused_in_words(tmp_path: Path):
    with pytest.raises(DataFileNotFoundError, match=r"/none\.h5'"):
        read_features(tmp_path / "none.h5")
    (tmp_path / "text.h5").write_text("hello")
    with pytest.raises(DataError, match="HDF5"):
        read_features(tmp_path / "text.h5")
    with h5py.File(tmp_path / "bare.h5", "w") as file:
        file["stuff"] = 1
    with pytest.raises(DataError, match=r"'stuff'.*'labels'"):
        read_features(tmp_path / "bare.h5")
    with pytest.raises(DataError, match=r"\[2, 4\]; expected \[3, F\]"):
        write_features(tmp_path / "c.h5", ["x", "y", "z"], {"fc": np.ones((2, 4))})
    with h5py.File(tmp_path / "twice.h5", "w") as file:
        file["labels"] = np.array([b"x", b"x"])
        file["activations/fc"] = np.ones((2, 3))
    with pytest.raises(DataError, match="'x' more than once"):
        read_features(tmp_path / "twice.h5")
    with h5py.File(tmp_path / "empty.h5", "w") as file:
        file["labels"] = np.array([b"x", b"y"])
        file.create_group("activations")
    with pytest.raises(DataError, match=r"empty\.h5' .*'activations'"):
        read_features(tmp_path / "empty.h5")
    with pytest.raises(DataError, match=r"\[2, 0\]; .*one feature"):
        write_features(tmp_path / "d.h5", ["x", "y"], {"fc": np.ones((2, 0))})


def _layer(path: Path, values):
    with h5py.File(path, "w") as file:
        file["labels"] = np.array([b"x", b"y"])
        file["activations/fc"] = values
    return read_features(path).activations["fc"].ravel()


@pytest.mark.parametrize("kind", [np.int16, np.int32, np.uint32, np.int64, np.float16, np.float32, np.float64])
def test_numbers_are_read_without_rounding(tmp_path: Path, kind):
    largest = 2**53 - 1 if np.dtype(kind).itemsize == 8 else np.iinfo(kind).max if kind(0.5) == 0 else 2**11 - 1
    assert _layer(tmp_path / "a.h5", np.array([[largest], [3]], dtype=kind)).tolist() == [largest, 3]


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (np.array([[2**60 + 1], [3]]), r"'fc' .*2\*\*53"),
        (np.array([[-(2**53) - 1], [3]]), r"'fc' .*2\*\*53"),
        (np.array([[1 + 2j], [3]]), "'fc' .*complex128; .*real"),
        (np.zeros((2, 0)), r"\[2, 0\]; .*one feature"),
        (np.zeros((2, 0, 3)), r"\[2, 0, 3\]; .*one feature"),
    ],
)
def test_activations_that_cannot_be_kept_are_refused(tmp_path: Path, values, message):
    with pytest.raises(DataError, match=message):
        _layer(tmp_path / "a.h5", values)
