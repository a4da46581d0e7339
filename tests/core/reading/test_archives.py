import zipfile

import numpy as np
import pytest

from brainbench.core.errors import DataError
from brainbench.core.reading.archives import read_npz


def test_arrays_come_back(tmp_path):
    np.savez(tmp_path / "a.npz", one=np.arange(3), two=np.eye(2))
    found = read_npz(tmp_path / "a.npz")
    np.testing.assert_array_equal(found["two"], np.eye(2))
    assert list(found) == ["one", "two"]


def test_pickles_encryption_and_false_headers_are_refused(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, evil=np.array([{}], dtype=object))
    with pytest.raises(DataError, match="evil"):
        read_npz(path)
    np.savez(path, one=np.arange(3))
    data = bytearray(path.read_bytes())
    # Bit 0 of the flags says encrypted, in the local header and in the directory.
    data[6] |= 1
    data[data.index(b"PK\x01\x02") + 8] |= 1
    path.write_bytes(data)
    with pytest.raises(DataError, match="encrypted"):
        read_npz(path)
    with zipfile.ZipFile(path, "w") as archive, archive.open("one.npy", "w") as stream:
        np.lib.format.write_array_header_1_0(stream, {"descr": "<f8", "fortran_order": False, "shape": (2**40,)})
    with pytest.raises(DataError, match="one"):
        read_npz(path)
