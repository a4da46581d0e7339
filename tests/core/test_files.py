import hashlib
import json
import math
import multiprocessing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from brainbench.core import files
from brainbench.core.errors import DataError, DataFileNotFoundError


@dataclass(frozen=True)
class _Config:
    name: str
    values: tuple[float, ...]


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


def _write_repeatedly(path: str, word: str) -> None:
    for _ in range(50):
        files.write_text(path, word * 10_000)


def test_readers_never_see_a_mixture_of_two_writers(tmp_path: Path):
    target = tmp_path / "shared.txt"
    files.write_text(target, "a" * 10_000)
    context = multiprocessing.get_context("spawn")
    writers = [context.Process(target=_write_repeatedly, args=(str(target), word)) for word in "ab"]
    for writer in writers:
        writer.start()
    seen = set()
    while any(writer.is_alive() for writer in writers):
        text = target.read_text()
        seen.add((len(text), len(set(text))))
    for writer in writers:
        writer.join()
        assert writer.exitcode == 0
    assert seen <= {(10_000, 1)}


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
