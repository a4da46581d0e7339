import os

import pytest

from brainbench.core.errors import DataError, DataFileNotFoundError
from brainbench.core.reading.regular import check_file, readable


def test_only_regular_files_of_bounded_size_are_opened(tmp_path):
    (tmp_path / "a").write_bytes(b"12345")
    assert check_file(tmp_path / "a", most=5) == tmp_path / "a"
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "loop").symlink_to("loop")
    for path, told in (
        (tmp_path, "folder"),
        ("/dev/zero", "device"),
        (tmp_path / "pipe", "pipe"),
        (tmp_path / "loop", "loop"),
    ):
        with pytest.raises(DataError, match=told):
            check_file(path)
    with pytest.raises(DataError, match="5 bytes"):
        check_file(tmp_path / "a", most=4)
    for missing in (tmp_path / "none", tmp_path / "a" / "inside"):
        with pytest.raises(DataFileNotFoundError, match=missing.name):
            check_file(missing)


@pytest.mark.parametrize("error", [KeyError("x"), MemoryError(), RecursionError(), TypeError("no"), OSError(5, "I/O")])
def test_every_failure_of_a_library_names_the_file_and_keeps_its_cause(error):
    with pytest.raises(DataError, match="some-file") as found, readable("some-file", "thing"):
        raise error
    assert found.value.__cause__ is error


def test_long_values_are_cut():
    with pytest.raises(DataError) as found, readable("some-file", "thing"):
        raise ValueError("x" * 10_000)
    assert len(str(found.value)) < 300


def test_a_missing_file_is_answered_with_the_nearest_of_its_kind(tmp_path):
    for name in ("gripper.xml", "griper.txt"):
        (tmp_path / name).write_text("")
    with pytest.raises(DataFileNotFoundError, match=r"did you mean '.*gripper\.xml'"):
        check_file(tmp_path / "griper.xml")
