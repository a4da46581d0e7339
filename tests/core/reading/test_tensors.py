import zipfile

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from brainbench.core.errors import DataError, DataFileNotFoundError
from brainbench.core.reading.tensors import check_stored, read_checkpoint, read_npz, read_tensors
from tests.factories.damage import Unknown


def test_weights_that_are_not_finite_are_named(tmp_path):
    save_file({"good": torch.ones(2), "bad": torch.tensor([1.0, torch.nan])}, tmp_path / "a.safetensors")
    with pytest.raises(DataError, match=r"'bad'.*1 of 2"):
        read_tensors(tmp_path / "a.safetensors")


def test_a_checkpoint_comes_back_without_the_objects_of_others(tmp_path):
    path = tmp_path / "a.ckpt"
    torch.save({"state_dict": {"a": torch.arange(3)}, "epoch": 2}, path)
    found = read_checkpoint(path)
    assert found["epoch"] == 2
    assert found["state_dict"]["a"].tolist() == [0, 1, 2]
    torch.save({"state_dict": {}, "more": Unknown()}, path)
    with pytest.raises(DataError, match="pickle"):
        read_checkpoint(path)
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(DataError, match=r"a\.ckpt"):
        read_checkpoint(path)
    with pytest.raises(DataFileNotFoundError):
        read_checkpoint(tmp_path / "none.ckpt")


@pytest.mark.parametrize(
    "tensor",
    [
        torch.zeros(1).expand(2**40),
        torch.zeros(3).to_sparse(),
        torch.zeros(3, device="meta"),
        torch.zeros(3, dtype=torch.complex64),
        torch.tensor([torch.inf]),
    ],
    ids=["repeated", "sparse", "meta", "complex", "infinite"],
)
def test_only_plain_tensors_with_all_their_numbers_pass(tensor):
    check_stored({"good": torch.ones(2, 3)}, "file")
    with pytest.raises(DataError, match=r"'bad'.*file"):
        check_stored({"good": torch.ones(2), "bad": tensor}, "file")


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


def test_an_array_that_stands_twice_is_refused(tmp_path):
    np.savez(tmp_path / "a.npz", a=np.arange(3))
    with zipfile.ZipFile(tmp_path / "a.npz", "a") as archive, pytest.warns(UserWarning, match="Duplicate"):
        archive.writestr("a.npy", archive.read("a.npy"))
    with pytest.raises(DataError, match=r"holds 'a.npy' twice, of which one would be read"):
        read_npz(tmp_path / "a.npz")
