import os
import time

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


def _virtual(file, name, shape, parts):
    """Write a virtual array of parts (selection, file, array, shape there, selection there)."""
    layout = h5py.VirtualLayout(shape, "f8")
    for to, source, inner, size, of in parts:
        layout[to] = h5py.VirtualSource(source, inner, size)[of]
    file.create_virtual_dataset(name, layout, fillvalue=0)


ALL = slice(None)


def _raw(name):
    return lambda file: file.create_dataset("x", (4,), "f8", external=[(name, 0, h5py.h5f.UNLIMITED)])


def _pattern(file):
    space = h5py.h5s.create_simple((4,), (h5py.h5s.UNLIMITED,))
    space.select_hyperslab((0,), (h5py.h5s.UNLIMITED,), (2,), (2,))
    plan = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    plan.set_virtual(space, b"part%b.h5", b"a", h5py.h5s.create_simple((2,)))
    space = h5py.h5s.create_simple((4,), (h5py.h5s.UNLIMITED,))
    h5py.h5d.create(file.id, b"x", h5py.h5t.IEEE_F64LE, space, plan)


def _linked(target, inner="/a"):
    return lambda file: file.__setitem__("x", h5py.ExternalLink(target, inner))


def _parts(*parts, shape=(4,)):
    return lambda file: _virtual(file, "x", shape, parts)


REFUSED = {
    "a source is gone": (_parts((ALL, "gone.h5", "a", (4,), ALL)), "gone.h5"),
    "half of it is gone": (
        _parts((slice(2), "four.h5", "a", (4,), slice(2)), (slice(2, 4), "gone.h5", "a", (2,), ALL)), "gone.h5",
    ),
    "a source lacks the array": (_parts((ALL, "four.h5", "b", (4,), ALL)), "lacks '/b'"),
    "a source has a group of the name": (_parts((ALL, "four.h5", "group", (4,), ALL)), "no array"),
    "a source is shorter": (_parts((ALL, "two.h5", "a", (4,), ALL)), "smaller"),
    "a source's own source is gone": (_parts((ALL, "hollow.h5", "x", (4,), ALL)), "gone.h5"),
    "a source's link leads nowhere": (_parts((ALL, "links.h5", "x", (4,), ALL)), "gone.h5"),
    "a part comes from nowhere": (_parts((slice(2), "four.h5", "a", (4,), slice(2))), "from nowhere"),
    "a source is itself": (_parts((ALL, ".", "x", (4,), ALL)), "made of itself"),
    "two refer to one another": (_parts((ALL, "back.h5", "x", (4,), ALL)), "made of itself"),
    "a pattern": (_pattern, "pattern"),
    "a source is a pipe": (_parts((ALL, "pipe.h5", "a", (4,), ALL)), "no regular file"),
    "a source is outside": (_parts((ALL, "../outside.h5", "a", (4,), ALL)), "outside.h5"),
    "a source is a link to outside": (_parts((ALL, "away.h5", "a", (4,), ALL)), "away.h5"),
    "a source is too large": (_parts((slice(4), "four.h5", "a", (4,), ALL), shape=(2**40,)), "declares"),
    "a link leads outside": (_linked("../outside.h5"), "outside.h5"),
    "a link leads to a device": (_linked("/dev/zero"), "/dev/zero"),
    "a link leads on to a pipe": (_linked("on.h5", "/x"), "pipe.h5"),
    "links lead in a circle": (_linked("circle.h5", "/x"), "themselves"),
    "bytes of a text": (_raw("text.txt"), "text.txt"),
    "bytes of a pipe": (_raw("pipe.h5"), "pipe.h5"),
}  # fmt: skip


@pytest.fixture
def folder(tmp_path):
    """Return a folder with files that link well and badly."""
    inside = tmp_path / "inside"
    inside.mkdir()
    for path, size in ((inside / "four.h5", 4), (inside / "two.h5", 2), (tmp_path / "outside.h5", 4)):
        with h5py.File(path, "w") as file:
            file["a"] = 1.0 + np.arange(size)
            file.create_group("group")
    (inside / "text.txt").write_text("PRIVATE-LINE " * 9)
    (inside / "away.h5").symlink_to(tmp_path / "outside.h5")
    os.mkfifo(inside / "pipe.h5")
    changes = {
        "hollow.h5": _parts((ALL, "gone.h5", "a", (4,), ALL)), "links.h5": _linked("gone.h5"),
        "back.h5": _parts((ALL, "x.h5", "x", (4,), ALL)), "on.h5": _linked("pipe.h5"),
        "circle.h5": _linked("x.h5", "/x"),
    }  # fmt: skip
    for name, change in changes.items():
        with h5py.File(inside / name, "w") as file:
            change(file)
    return inside


@pytest.mark.parametrize("case", REFUSED)
def test_what_a_file_names_is_refused_by_name(folder, case):
    change, words = REFUSED[case]
    with h5py.File(folder / "x.h5", "w") as file:
        change(file)
    began = time.monotonic()
    with pytest.raises(DataError) as caught, hdf5.open_hdf5(folder / "x.h5"):
        pass
    assert words in str(caught.value)
    assert "PRIVATE" not in str(caught.value)
    assert len(str(caught.value)) < 400
    assert time.monotonic() - began < 20


def test_folders_that_are_allowed_are_read_from(folder, monkeypatch):
    (folder / "numbers.bin").write_bytes((1.0 + np.arange(4)).tobytes())
    for name, change in (
        ("a.h5", _parts((ALL, "../outside.h5", "a", (4,), ALL))),
        ("b.h5", _raw("numbers.bin")),
    ):
        with h5py.File(folder / name, "w") as file:
            change(file)
        with pytest.raises(DataError, match="--allow-linked"), hdf5.open_hdf5(folder / name):
            pass
        with monkeypatch.context() as patch:
            patch.setenv(hdf5.LINKED_VARIABLE, str(folder.parent))
            with hdf5.open_hdf5(folder / name) as file:
                assert file["x"][()].tolist() == [1, 2, 3, 4]
    # Raw bytes that end early would read as zeros.
    (folder / "numbers.bin").write_bytes(bytes(20))
    monkeypatch.setenv(hdf5.LINKED_VARIABLE, str(folder))
    with pytest.raises(DataError, match="lacks bytes"), hdf5.open_hdf5(folder / "b.h5"):
        pass


def test_a_copy_keeps_groups_their_order_attributes_and_references(folder):
    with h5py.File(folder / "x.h5", "w") as file:
        group = file.create_group("layers", track_order=True)
        for name in "zb":
            group[name] = np.arange(3.0)
        _virtual(group, "y", (4,), [(ALL, "four.h5", "a", (4,), ALL)])
        group["a"] = np.arange(2.0)
        group["y"].attrs["unit"] = "N"
        file["soft"] = h5py.SoftLink("/layers/y")
        file["whole"] = h5py.ExternalLink("four.h5", "/")
        file.attrs["to"] = file["layers/z"].ref
    with hdf5.open_hdf5(folder / "x.h5") as file:
        assert [*file["layers"]] == ["z", "b", "y", "a"]
        assert file["soft"][()].tolist() == [1, 2, 3, 4]
        assert file["layers/y"].attrs["unit"] == "N"
        assert file["whole/a"][()].tolist() == [1, 2, 3, 4]
        assert file[file.attrs["to"]].name == "/layers/z"


def test_parts_of_any_shape_are_put_in_their_places(folder):
    values = np.arange(48.0).reshape(6, 8)
    with h5py.File(folder / "grid.h5", "w") as file:
        file["a"], file["long"] = values, values.reshape(-1)
    layout = h5py.VirtualLayout((6, 8), "f8")
    layout[::2] = h5py.VirtualSource("grid.h5", "a", (6, 8))[::2]
    layout[1::2, :3] = h5py.VirtualSource("grid.h5", "a", (6, 8))[1::2, :3]
    layout[1::2, 3:] = h5py.VirtualSource("grid.h5", "a", (6, 8))[1::2, 3:]
    with h5py.File(folder / "x.h5", "w") as file:
        file.create_virtual_dataset("x", layout)
        rows = h5py.VirtualLayout((3, 8), "f8")
        rows[[0, 1, 2]] = h5py.VirtualSource("grid.h5", "a", (6, 8))[[0, 1, 4]]
        file.create_virtual_dataset("y", rows)
    with hdf5.open_hdf5(folder / "x.h5") as file:
        assert (file["x"][()] == values).all()
        assert (file["y"][()] == values[[0, 1, 4]]).all()


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
    assert told in hdf5_worker.fault_of(str(path))[0]


def test_a_whole_file_has_no_fault_and_one_that_was_cut_off_is_truncated(tmp_path):
    path = _write(tmp_path / "a.h5")
    assert hdf5_worker.fault_of(str(path)) == ("", False)
    path.write_bytes(path.read_bytes()[:-100])
    assert "truncated" in hdf5_worker.fault_of(str(path))[0]
