import os
import stat

import pytest

from brainbench.core.writing.private import private_folder, write_private


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
