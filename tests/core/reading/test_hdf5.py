import time
from pathlib import Path

import h5py
import numpy as np
import pytest

from brainbench.core.errors import DataError, DataFileNotFoundError
from brainbench.core.reading import hdf5
from brainbench.core.reading.sealed import read_entry, seal_file


def _write(path):
    with h5py.File(path, "w") as file:
        file["a"] = np.arange(3)
    return path


def test_a_good_file_is_opened_and_failures_inside_name_it(tmp_path):
    path = _write(tmp_path / "a.h5")
    with hdf5.open_hdf5(path) as file:
        assert file["a"][2] == 2
    with pytest.raises(DataError, match=r"a\.h5.*'b'"), hdf5.open_hdf5(path) as file:
        file["b"]
    with pytest.raises(DataFileNotFoundError), hdf5.open_hdf5(tmp_path / "none.h5"):
        pass


def test_a_file_that_the_library_never_returns_from_is_refused_and_the_next_one_is_read(tmp_path, monkeypatch):
    slow, good = _write(tmp_path / "slow.h5"), _write(tmp_path / "good.h5")
    # No time at all: the worker is stopped as it is when the library loops for ever.
    monkeypatch.setattr(hdf5, "SECONDS", -1e6)
    began = time.monotonic()
    with pytest.raises(DataError, match=r"slow\.h5"), hdf5.open_hdf5(slow):
        pass
    assert time.monotonic() - began < 5
    monkeypatch.undo()
    with hdf5.open_hdf5(good) as file:
        assert list(file) == ["a"]


@pytest.mark.parametrize("size", [100, 200_000])
@pytest.mark.parametrize(("code", "words"), [(32001, r"32001 \(Blosc\)"), (32015, "Zstandard"), (32999, "32999 to")])
def test_a_missing_filter_is_named_with_its_package_and_hinders_nothing_else(tmp_path, code, words, size):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["plain"] = np.arange(3)
        create = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        create.set_chunk((size,))
        create.set_filter(code, h5py.h5z.FLAG_OPTIONAL, (2, 2, 8, 8 * size))
        space = h5py.h5s.create_simple((size,))
        packed = h5py.h5d.create(file.id, b"packed", h5py.h5t.IEEE_F64LE, space, create)
        packed.write_direct_chunk((0,), np.random.default_rng(0).bytes(8 * size), 0)
    with hdf5.open_hdf5(tmp_path / "a.h5") as file:
        assert file["plain"][...].tolist() == [0, 1, 2]
    message = rf"a.h5.*{words}.*'packed': pip install hdf5plugin"
    with pytest.raises(hdf5.MissingFilterError, match=message), hdf5.open_hdf5(tmp_path / "a.h5") as file:
        file["packed"][...]


def test_a_file_of_ours_whose_hash_was_checked_is_opened_at_once(tmp_path, monkeypatch):
    path = _write(tmp_path / "a.h5")
    seal_file(path)
    read_entry(path, "file", Path.stat)
    monkeypatch.setattr(hdf5, "call_apart", lambda *_: ("was looked through", False))
    with hdf5.open_hdf5(path) as file:
        assert list(file) == ["a"]
    # Other bytes, or another file under the name, are looked through again.
    path.write_bytes(path.read_bytes() + b"\0")
    read_entry(path, "file", Path.stat)
    with pytest.raises(DataError, match="looked through"), hdf5.open_hdf5(path):
        pass


def test_a_file_that_is_replaced_between_its_walk_and_its_opening_is_refused(tmp_path, monkeypatch):
    path, ask = _write(tmp_path / "a.h5"), hdf5.call_apart

    def swap(*request):
        answer = ask(*request)
        _write(tmp_path / "b.h5").replace(path)
        return answer

    monkeypatch.setattr(hdf5, "call_apart", swap)
    with pytest.raises(DataError, match="changed while"), hdf5.open_hdf5(path):
        pass


def test_a_linked_file_is_read_from_a_copy_that_is_gone_afterwards(tmp_path):
    path = _write(tmp_path / "a.h5")
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file["b"] = h5py.ExternalLink("a.h5", "/a")
    for _ in range(2):
        with hdf5.open_hdf5(tmp_path / "b.h5") as file:
            copy = Path(file.filename)
            assert file["b"][2] == 2
            assert file.get("b", getlink=True).__class__ is h5py.HardLink
            assert copy.parent != tmp_path
            assert copy.stat().st_mode & 0o777 == 0o600
        assert not copy.exists()
    # What it links to is looked up anew each time.
    path.unlink()
    with pytest.raises(DataError, match=r"b\.h5"), hdf5.open_hdf5(tmp_path / "b.h5") as file:
        file["b"][()]
