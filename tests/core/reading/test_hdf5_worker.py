import h5py
import numpy as np
import pytest

from brainbench.core.errors import DataError
from brainbench.core.reading import hdf5, hdf5_worker


def _write(path):
    with h5py.File(path, "w") as file:
        file["a"] = np.arange(3)
    return path


def test_a_declared_shape_takes_no_memory(tmp_path):
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset("huge", shape=(2**40,), dtype="f8", chunks=True)
    with pytest.raises(DataError, match="huge"), hdf5.open_hdf5(path):
        pass


def test_a_link_into_a_device_is_refused(tmp_path):
    path = _write(tmp_path / "a.h5")
    with h5py.File(path, "a") as file:
        file["out"] = h5py.ExternalLink("/dev/zero", "/x")
    with pytest.raises(DataError, match="/dev/zero"), hdf5.open_hdf5(path):
        pass


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (b"", "it is empty"),
        (b"version https://git-lfs.github.com/spec/v1\n", "pointer that git-lfs"),
        (b"plain text", "is not an HDF5 file"),
    ],
)
def test_what_stands_in_place_of_a_file_is_told(tmp_path, content, told):
    path = tmp_path / "a.h5"
    path.write_bytes(content)
    assert told in hdf5_worker.fault_of(str(path))


def test_a_whole_file_has_no_fault_and_one_that_was_cut_off_is_truncated(tmp_path):
    path = _write(tmp_path / "a.h5")
    assert hdf5_worker.fault_of(str(path)) == ""
    path.write_bytes(path.read_bytes()[:-100])
    assert "truncated" in hdf5_worker.fault_of(str(path))
