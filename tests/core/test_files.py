from __future__ import annotations

import errno
import hashlib
import json
import math
import os
import resource
import signal
import stat
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from safetensors import safe_open

from brainbench.core import files
from brainbench.core.errors import DataError, DataFileNotFoundError, FileWriteError, UsageError
from brainbench.core.files import (
    create_hdf5,
    lock_folder,
    private_folder,
    temporary_path,
    write_private,
    write_tensors,
    write_text,
)
from brainbench.core.reading.sealed import read_sealed, write_sealed
from brainbench.core.reading.tensors import read_tensors

KILLED = """
import os, signal, sys
from pathlib import Path
from brainbench.core.files import temporary_path
left = temporary_path(Path(sys.argv[1]) / "x.json")
left.write_text("{ half")
folder = temporary_path(Path(sys.argv[1]) / "run")
(folder / "inner").mkdir(parents=True)
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_what_a_killed_process_left_goes_with_the_next_file_written_there(tmp_path: Path):
    (tmp_path / ".notes-0123456789abcdef.txt").write_text("somebody's own")
    mine = temporary_path(tmp_path / "mine.json")
    mine.write_text("being written")
    subprocess.run([sys.executable, "-c", KILLED, tmp_path], check=False)
    assert len(list(tmp_path.iterdir())) == 4
    subprocess.run(
        [
            sys.executable,
            "-c",
            f"from brainbench.core.files import write_text; write_text({str(tmp_path / 'y')!r}, 'y')",
        ],
        check=True,
    )
    assert {path.name for path in tmp_path.iterdir()} == {".notes-0123456789abcdef.txt", mine.name, "y"}


def test_a_long_name_leaves_room_for_the_token(tmp_path: Path):
    write_text(tmp_path / ("n" * 240 + ".json"), "x")
    assert [path.name for path in tmp_path.iterdir()] == ["n" * 240 + ".json"]


def test_a_locked_folder_is_refused_or_waited_for(tmp_path):
    code = (
        "import pathlib, sys; from brainbench.core.files import lock_folder\n"
        "with lock_folder(pathlib.Path(sys.argv[1]), wait=sys.argv[2] == 'wait') as held: print(held)"
    )
    words = [sys.executable, "-c", code, str(tmp_path)]
    with lock_folder(tmp_path) as held:
        assert held
        refused = subprocess.run([*words, "refuse"], capture_output=True, text=True, check=False)
        assert (refused.returncode, tmp_path.name in refused.stderr) == (1, True)
        waiting = subprocess.Popen([*words, "wait"], stdout=subprocess.PIPE, text=True)
        with pytest.raises(subprocess.TimeoutExpired):
            waiting.wait(2)
    assert waiting.communicate(timeout=30)[0] == "True\n"


@dataclass(frozen=True)
class _Config:
    name: str
    values: tuple[float, ...]


def test_a_folder_that_was_made_for_a_lock_goes_with_an_error_while_it_is_empty(tmp_path):
    (tmp_path / "before").mkdir()
    for folder, stays in ((tmp_path / "a" / "b", False), (tmp_path / "before", True)):
        with pytest.raises(FileNotFoundError), lock_folder(folder):
            (folder / "none").unlink()
        assert folder.exists() == stays
    assert not (tmp_path / "a").exists()


def test_a_failed_write_leaves_the_old_file_and_no_rubbish(tmp_path: Path):
    target = tmp_path / "result.json"
    files.write_json(target, {"old": 1})

    def fail_halfway() -> None:
        with files.atomic_path(target) as temporary:
            temporary.write_text("half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail_halfway()
    assert json.loads(target.read_text()) == {"old": 1}
    assert [path.name for path in tmp_path.iterdir()] == ["result.json"]


def test_an_atomic_file_keeps_the_suffix_and_the_usual_permissions(tmp_path: Path):
    with files.atomic_path(tmp_path / "deep" / "set.h5") as temporary:
        assert temporary.suffix == ".h5"
        temporary.write_bytes(b"x")
    plain = tmp_path / "plain"
    plain.write_bytes(b"x")
    assert (tmp_path / "deep" / "set.h5").stat().st_mode == plain.stat().st_mode


WRITER = """
import sys
from brainbench.core.files import write_text
for _ in range(50):
    write_text(sys.argv[1], sys.argv[2] * 10_000)
"""


def test_readers_never_see_a_mixture_of_two_writers(tmp_path: Path):
    target = tmp_path / "shared.txt"
    files.write_text(target, "a" * 10_000)
    writers = [subprocess.Popen([sys.executable, "-c", WRITER, target, word]) for word in "ab"]
    seen = set()
    while any([writer.poll() is None for writer in writers]):
        text = target.read_text()
        seen.add((len(text), len(set(text))))
        time.sleep(2e-4)
    assert [writer.returncode for writer in writers] == [0, 0]
    assert seen == {(10_000, 1)}


def test_json_is_deterministic_and_writes_nan_as_null():
    text = files.to_json({"b": math.nan, "a": np.array([1.5, np.inf]), "c": _Config("x", (0.1,)), "p": Path("q")})
    assert json.loads(text) == {"a": [1.5, None], "b": None, "c": {"name": "x", "values": [0.1]}, "p": "q"}
    assert text.index('"a"') < text.index('"b"')


@given(st.dictionaries(st.text(max_size=5), st.floats(allow_nan=False, allow_infinity=False), max_size=5))
def test_json_round_trips_floats_exactly(values: dict[str, float]):
    assert json.loads(files.to_json(values)) == values


def test_hashes_separate_what_differs_and_only_that(tmp_path: Path):
    one = np.arange(6.0).reshape(2, 3)
    assert files.content_hash(one) == files.content_hash(one.copy())
    distinct = [one, one.T, one.reshape(3, 2), one.astype(np.float32), one.tolist(), "x", b"x", _Config("x", (1.0,))]
    assert len({files.content_hash(value) for value in distinct}) == len(distinct)
    assert files.content_hash("ab", "c") != files.content_hash("a", "bc")
    first, second = tmp_path / "1", tmp_path / "2"
    first.write_bytes(b"same")
    second.write_bytes(b"same")
    assert files.content_hash(first) == files.content_hash(second)


def test_long_doubles_count_as_the_numbers_they_are():
    values = np.arange(3) / 4
    assert files.content_hash([values.astype(np.longdouble)]) == files.content_hash([values])


def test_a_hash_is_equal_on_every_machine():
    raw = b"array:<f4:(3,):" + np.arange(3, dtype="<f4").tobytes() + b"\0" + b'json:{"a": 0.5, "b": 1}\0'
    expected = hashlib.sha256(raw).hexdigest()[:16]
    assert files.content_hash(np.arange(3, dtype="<f4"), {"b": 1, "a": 0.5}) == expected


def test_reading_json_says_what_is_wrong(tmp_path: Path):
    with pytest.raises(DataError, match=r"/none\.json'"):
        files.read_json(tmp_path / "none.json")
    (tmp_path / "bad.json").write_text("{")
    with pytest.raises(DataError, match=r"/bad\.json' .*JSON"):
        files.read_json(tmp_path / "bad.json")


def test_the_cache_folder_follows_the_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv(files.CACHE_VARIABLE, str(tmp_path / "mine"))
    assert files.cache_dir("stimuli") == tmp_path / "mine" / "stimuli"
    assert (tmp_path / "mine" / "stimuli").is_dir()


def test_an_empty_variable_does_not_make_the_working_folder_the_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "usual"))
    monkeypatch.setenv(files.CACHE_VARIABLE, "")
    assert tmp_path / "usual" in files.cache_dir("stimuli").parents
    assert not (tmp_path / "stimuli").exists()


def _unwritable(monkeypatch, *folders):
    access = os.access
    # Whoever runs the tests may be allowed everything.
    allowed = lambda path, mode: access(path, mode) and not (mode & os.W_OK and Path(path) in folders)  # noqa: E731
    monkeypatch.setattr(os, "access", allowed)


def test_a_filled_cache_that_cannot_be_written_is_read_and_left_as_it_is(tmp_path, monkeypatch, caplog):
    root = tmp_path / "cache"
    monkeypatch.setenv(files.CACHE_VARIABLE, str(root))
    for name in ("old", "renewed"):
        write_sealed(files.cache_dir("numbers") / f"{name}.npz", "numbers", {"x": [1.0]})
    before = {path: path.read_bytes() for path in root.rglob("*") if path.is_file()}
    _unwritable(monkeypatch, root / "numbers")
    folder = files.cache_dir("numbers")
    assert root not in folder.parents
    assert read_sealed(folder / "old.npz", "numbers") == {"x": [1.0]}
    for name in ("new", "renewed"):
        write_sealed(folder / f"{name}.npz", "numbers", {"x": [2.0]})
        assert read_sealed(folder / f"{name}.npz", "numbers") == {"x": [2.0]}
    assert {path: path.read_bytes() for path in root.rglob("*") if path.is_file()} == before
    assert files.cache_dir("other").parent == folder.parent
    (message,) = [record.getMessage() for record in caplog.records]
    assert message.startswith(f"The cache folder {root} cannot be written (Permission denied)")


def test_a_home_that_is_read_only_has_a_cache_until_the_process_ends(tmp_path, monkeypatch, caplog):
    monkeypatch.setenv(files.CACHE_VARIABLE, str(tmp_path / "home" / "cache"))
    monkeypatch.setenv(files.CONFIG_VARIABLE, str(tmp_path / "home" / "settings"))
    monkeypatch.setenv(files.KEY_VARIABLE, "")  # restored after the test
    monkeypatch.delenv(files.KEY_VARIABLE)
    make = Path.mkdir

    def refuse(path, *arguments, **options):
        if tmp_path in path.parents:
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        make(path, *arguments, **options)

    monkeypatch.setattr(Path, "mkdir", refuse)
    folder = files.cache_dir("numbers")
    write_sealed(folder / "new.npz", "numbers", {"x": [2.0]})
    assert read_sealed(folder / "new.npz", "numbers") == {"x": [2.0]}
    assert len(caplog.records) == 1


@pytest.mark.skipif(os.name != "posix", reason="home folders are found otherwise")
def test_a_user_without_a_home_folder_is_told_what_to_set(monkeypatch: pytest.MonkeyPatch):
    for name in ("HOME", "XDG_CACHE_HOME", "XDG_CONFIG_HOME", files.CACHE_VARIABLE, files.CONFIG_VARIABLE):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("pwd.getpwuid", lambda user: {}[user])
    with pytest.raises(UsageError, match="no home folder: set HOME, or name a folder with BRAINBENCH_CACHE"):
        files.cache_dir("stimuli")
    with pytest.raises(UsageError, match="or name a folder with BRAINBENCH_CONFIG"):
        files.settings_dir()


def test_provenance_names_version_packages_and_time():
    origin = files.provenance(seed=3)
    assert {"version", "python", "packages", "machine", "time"} <= set(origin)
    assert origin["seed"] == 3
    assert origin["packages"]["numpy"] == np.__version__


def test_names_and_values_are_read_from_toml_and_json(tmp_path):
    (tmp_path / "a.toml").write_text('epochs = 4\naugmentation = "none"\n')
    (tmp_path / "a.json").write_text(json.dumps({"epochs": 4, "augmentation": "none"}))
    assert (
        files.read_mapping(tmp_path / "a.toml")
        == files.read_mapping(tmp_path / "a.json")
        == {"epochs": 4, "augmentation": "none"}
    )
    (tmp_path / "b.toml").write_text("epochs = \n")
    with pytest.raises(DataError, match=r"/b\.toml' .*TOML"):
        files.read_mapping(tmp_path / "b.toml")
    with pytest.raises(DataFileNotFoundError):
        files.read_mapping(tmp_path / "none.toml")
    (tmp_path / "c.json").write_text("[1]")
    with pytest.raises(DataError, match=r"/c\.json' .*list"):
        files.read_mapping(tmp_path / "c.json")


def test_all_files_or_none(tmp_path):
    (tmp_path / "b").mkdir()
    with pytest.raises(DataError):
        files.write_together({tmp_path / "a.txt": "new", tmp_path / "b": "a folder is in the way"})
    assert not (tmp_path / "a.txt").exists()
    paths = files.write_together({tmp_path / "a.txt": "new", tmp_path / "c.txt": b"too"})
    assert [path.name for path in paths] == ["a.txt", "c.txt"]


def _mode(path) -> str:
    return oct(stat.S_IMODE(path.stat().st_mode))


@pytest.mark.parametrize("mask", [0o000, 0o022, 0o077])
def test_whatever_the_umask_nobody_else_can_read(tmp_path, mask):
    before = os.umask(mask)
    try:
        write_private(tmp_path / "deep" / "key", b"secret")
    finally:
        os.umask(before)
    assert (_mode(tmp_path / "deep"), _mode(tmp_path / "deep" / "key")) == ("0o700", "0o600")
    assert (tmp_path / "deep" / "key").read_bytes() == b"secret"


def test_a_folder_that_others_can_enter_is_closed(tmp_path):
    (tmp_path / "open").mkdir(mode=0o755)
    assert _mode(private_folder(tmp_path / "open")) == "0o700"


def test_a_file_is_replaced_only_where_that_is_wanted(tmp_path):
    path = tmp_path / "key"
    write_private(path, b"first")
    write_private(path, b"second", replace=False)
    assert path.read_bytes() == b"first"
    write_private(path, b"third")
    assert path.read_bytes() == b"third"
    assert [file.name for file in tmp_path.iterdir()] == ["key"]


def test_a_file_system_without_links_serves_too(tmp_path, monkeypatch):
    def refuse(*_):
        raise PermissionError

    monkeypatch.setattr(os, "link", refuse)
    write_private(tmp_path / "key", b"first", replace=False)
    assert (tmp_path / "key").read_bytes() == b"first"


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


def test_what_has_no_place_on_a_full_disk_is_read_back(tmp_path, little_room):
    """The library reads again what it wrote of a file of many parts; where that was gone it crashed, or never ended."""
    values, same = np.random.default_rng(0).normal(size=20_000), []

    def write():
        with create_hdf5(tmp_path / "a.h5") as file:
            file["values"] = values
            same.append(np.array_equal(file["values"][...], values))

    with pytest.raises(FileWriteError, match=r"a\.h5"):
        write()
    assert same == [True]
    assert [*tmp_path.iterdir()] == []


def test_what_a_full_disk_did_not_take_is_read_back_by_the_library(tmp_path, little_room):
    path = tmp_path / "a"
    path.touch()
    with files._Disk(path, "r+") as disk:
        for content in (b"a" * 90_000, b"b" * 20_000):
            assert disk.write(content) == len(content)
        disk.seek(105_000)
        disk.write(b"c" * 10)
        assert disk.tell() == 105_010
        assert disk.fault is not None
        disk.seek(89_000)
        buffer = bytearray(21_000)
        disk.readinto(buffer)
    assert buffer == b"a" * 1_000 + b"b" * 15_000 + b"c" * 10 + b"b" * 4_990


def test_nul_in_a_text_is_refused_in_words(tmp_path):
    with pytest.raises(DataError, match="NUL"), create_hdf5(tmp_path / "a.h5") as file:
        file.create_dataset("a", data=["a\0b"], dtype=h5py.string_dtype())
    assert [*tmp_path.iterdir()] == []


TENSORS = {"a": torch.arange(6.0).reshape(2, 3).T, "b": torch.tensor([1.5], dtype=torch.float16)}


def test_tensors_come_back_with_what_is_said_of_them(tmp_path):
    write_tensors(tmp_path / "x.safetensors", TENSORS, step="3")
    found = read_tensors(tmp_path / "x.safetensors")
    assert found["b"].dtype == torch.float16
    assert all(torch.equal(found[name], value) for name, value in TENSORS.items())
    with safe_open(tmp_path / "x.safetensors", "pt") as file:
        assert file.metadata() == {"step": "3"}


def test_the_file_is_as_open_to_others_as_any_other(tmp_path):
    umask = os.umask(0)
    os.umask(umask)
    write_tensors(tmp_path / "x.safetensors", TENSORS)
    assert (tmp_path / "x.safetensors").stat().st_mode & 0o777 == 0o666 & ~umask


def test_what_fails_in_the_middle_leaves_the_old_file_alone(tmp_path, monkeypatch):
    write_tensors(tmp_path / "x.safetensors", TENSORS)
    monkeypatch.setattr("brainbench.core.files.os.fsync", lambda stream: (_ for _ in ()).throw(RuntimeError("stop")))
    with pytest.raises(RuntimeError, match="stop"):
        write_tensors(tmp_path / "x.safetensors", {"a": torch.zeros(1)})
    assert [path.name for path in tmp_path.iterdir()] == ["x.safetensors"]
    assert len(read_tensors(tmp_path / "x.safetensors")) == 2
