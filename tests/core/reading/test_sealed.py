import logging

import numpy as np

from brainbench.core.reading.sealed import read_sealed, write_sealed


def test_entries_come_back_and_damage_is_noticed(tmp_path, caplog):
    path = tmp_path / "a.npz"
    assert read_sealed(path, "thing") is None
    assert not caplog.records
    write_sealed(path, "thing", {"x": np.arange(100.0), "n": 3})
    found = read_sealed(path, "thing")
    assert list(found) == ["x", "n"]
    np.testing.assert_array_equal(found["x"], np.arange(100.0))
    # A sound archive with other numbers: only the hash tells.
    np.savez(path, x=np.arange(100.0) + 1, n=3, sha256="0" * 32)
    with caplog.at_level(logging.WARNING):
        assert read_sealed(path, "thing") is None
    path.write_bytes(path.read_bytes()[:200])
    assert read_sealed(path, "thing") is None
    assert [record.levelname for record in caplog.records] == ["WARNING"] * 2


def test_an_entry_that_cannot_be_kept_is_a_warning(tmp_path, caplog):
    (tmp_path / "file").write_text("x")
    write_sealed(tmp_path / "file" / "a.npz", "thing", {"x": 1})
    assert "thing" in caplog.text
