import resource
import signal

import h5py
import numpy as np
import pytest

from brainbench.core.errors import DataError, FileWriteError
from brainbench.core.writing.hdf5 import create_hdf5


@pytest.fixture
def little_room():
    """Let files of this process take 100 kB at most, as on a full disk."""
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    signal.signal(signal.SIGXFSZ, handler)


def test_a_file_is_there_as_a_whole(tmp_path):
    with create_hdf5(tmp_path / "a.h5", track_order=True) as file:
        file["b"], file["a"] = np.arange(3), np.arange(200_000.0)
        assert not (tmp_path / "a.h5").exists()
    with h5py.File(tmp_path / "a.h5") as file:
        assert [*file] == ["b", "a"]
        assert file["a"][-1] == 199_999


def _write(path, count):
    values = np.random.default_rng(0).normal(size=20_000 // count + 400)
    with create_hdf5(path) as file:
        for number in range(count):
            file.create_dataset(str(number), data=values, chunks=True)


@pytest.mark.parametrize("count", [1, 3, 10, 100, 1000])
def test_a_full_disk_is_told_in_our_words_alone(tmp_path, little_room, capfd, count):
    with pytest.raises(FileWriteError, match=r"a\.h5"):
        _write(tmp_path / "a.h5", count)
    assert capfd.readouterr() == ("", "")
    assert [*tmp_path.iterdir()] == []


def test_nul_in_a_text_is_refused_in_words(tmp_path):
    with pytest.raises(DataError, match="NUL"), create_hdf5(tmp_path / "a.h5") as file:
        file.create_dataset("a", data=["a\0b"], dtype=h5py.string_dtype())
    assert [*tmp_path.iterdir()] == []
