import logging
import os
import shutil
import stat
from pathlib import Path

import numpy as np
import pytest

from brainbench.core.reading import sealed
from brainbench.core.reading.sealed import is_sealed, keep_entry, read_entry, read_sealed, seal_file, write_sealed


@pytest.fixture(autouse=True)
def settings(tmp_path, monkeypatch):
    """A user with settings of his own; what the process remembers of keys is forgotten."""
    folder = tmp_path / "settings"
    monkeypatch.setenv("BRAINBENCH_CONFIG", str(folder))
    monkeypatch.delenv(sealed.KEY_VARIABLE, raising=False)
    sealed._key.cache_clear()
    yield folder
    sealed._key.cache_clear()


@pytest.fixture
def entry(tmp_path) -> Path:
    path = tmp_path / "things" / "a.npz"
    write_sealed(path, "thing", {"x": np.arange(100.0), "n": 3})
    return path


def test_entries_come_back(entry):
    stored = read_sealed(entry, "thing")
    assert list(stored) == ["x", "n"]
    np.testing.assert_array_equal(stored["x"], np.arange(100.0))
    assert read_sealed(entry.with_name("b.npz"), "thing") is None


def _edited(path: Path) -> None:
    np.savez(path, x=np.arange(100.0) + 1, n=3)


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:200])


def _exchanged(path: Path) -> None:
    rival = path.with_name("rival.npz")
    write_sealed(rival, "thing", {"x": np.zeros(1)})
    shutil.copy(rival, path)
    shutil.copy(f"{rival}.seal", f"{path}.seal")


def _of_another_user(path: Path) -> None:
    os.environ["BRAINBENCH_CONFIG"] += "-of-another"


def _without_seal(path: Path) -> None:
    path.with_name(f"{path.name}.seal").unlink()


@pytest.mark.parametrize("harm", [_edited, _cut, _exchanged, _of_another_user, _without_seal])
def test_an_entry_that_this_user_did_not_write_there_is_made_again(entry, caplog, harm):
    harm(entry)
    with caplog.at_level(logging.WARNING):
        assert read_sealed(entry, "thing") is None
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert "is made again" in caplog.text
    write_sealed(entry, "thing", {"x": 1})
    assert read_sealed(entry, "thing") is not None


def test_an_entry_of_another_folder_does_not_count_here(entry):
    copy = entry.parent.with_name("others") / entry.name
    shutil.copytree(entry.parent, copy.parent)
    assert is_sealed(entry)
    assert not is_sealed(copy)


def test_what_is_sealed_and_cannot_be_read_is_made_again(tmp_path, caplog):
    path = tmp_path / "a.npz"
    path.write_text("no archive")
    seal_file(path)
    assert read_sealed(path, "thing") is None
    assert "no zip archive" in caplog.text


def test_an_entry_that_cannot_be_kept_is_a_warning(tmp_path, caplog):
    (tmp_path / "file").write_text("x")
    write_sealed(tmp_path / "file" / "a.npz", "thing", {"x": 1})
    assert "thing" in caplog.text


def test_a_failure_while_an_entry_is_written_leaves_nothing(tmp_path):
    def write(file: Path) -> None:
        file.write_text("half")
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        keep_entry(tmp_path / "a.txt", "thing", write)
    assert list(tmp_path.glob("a*")) == []
    assert read_entry(tmp_path / "a.txt", "thing", Path.read_text) is None


def test_only_its_user_can_read_the_key(entry, settings):
    folder = settings / "keys"
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert [stat.S_IMODE(path.stat().st_mode) for path in folder.iterdir()] == [0o600]
    assert stat.S_IMODE(entry.with_name("a.npz.seal").stat().st_mode) == 0o600


@pytest.mark.parametrize("harm", [lambda key: key.chmod(0o644), lambda key: key.write_bytes(b"short")])
def test_a_key_that_others_can_read_is_not_used(entry, settings, caplog, harm):
    harm(settings / "keys" / "cache.key")
    sealed._key.cache_clear()
    assert read_sealed(entry, "thing") is None
    assert "No key for the cache can be kept" in caplog.text


def test_without_a_folder_for_the_key_the_processes_of_one_run_share_one(tmp_path, settings, caplog):
    settings.write_text("a file where the folder would be")
    write_sealed(tmp_path / "a.npz", "thing", {"x": 1})
    assert "BRAINBENCH_CONFIG" in caplog.text
    assert read_sealed(tmp_path / "a.npz", "thing") is not None
    sealed._key.cache_clear()  # as a process does that this one starts
    assert read_sealed(tmp_path / "a.npz", "thing") is not None
    del os.environ[sealed.KEY_VARIABLE]
    sealed._key.cache_clear()
    assert read_sealed(tmp_path / "a.npz", "thing") is None


def test_writers_of_one_entry_leave_one_another_their_seals(tmp_path):
    path = tmp_path / "a.txt"
    for text in ("first", "second"):
        keep_entry(path, "thing", lambda file, text=text: file.write_text(text))
    assert read_entry(path, "thing", Path.read_text) == "second"
    # The slower of two writers may put its content there last.
    path.write_text("first")
    assert read_entry(path, "thing", Path.read_text) == "first"
