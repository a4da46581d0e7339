import h5py
import numpy as np
import pytest

from brainbench.core.reading.filters import MissingFilterError
from brainbench.core.reading.hdf5 import open_hdf5


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
    with open_hdf5(tmp_path / "a.h5") as file:
        assert file["plain"][...].tolist() == [0, 1, 2]
    message = rf"a.h5.*{words}.*'packed': pip install hdf5plugin"
    with pytest.raises(MissingFilterError, match=message), open_hdf5(tmp_path / "a.h5") as file:
        file["packed"][...]
