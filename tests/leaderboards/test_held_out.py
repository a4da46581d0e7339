"""A published commitment opens with its own file and salt alone."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from brainbench.core.errors import DataError
from leaderboards.held_out import DATA, SALT, Commitment, digest, new_salt


@pytest.fixture
def secret(tmp_path: Path) -> Path:
    """Return a secret folder with data and salt."""
    folder = tmp_path / "secret"
    folder.mkdir()
    (folder / DATA).write_bytes(b"recordings")
    new_salt(folder)
    return folder


def _commit(secret: Path) -> Commitment:
    return Commitment("animals", 2, 4, "0" * 16, digest(secret / DATA, (secret / SALT).read_text().strip()))


def test_a_commitment_survives_its_file_and_opens(secret: Path, tmp_path: Path) -> None:
    told = _commit(secret)
    assert told.plain["kept"] == 4
    (tmp_path / "held-out.json").write_text(json.dumps(told.plain))
    read = Commitment.read(tmp_path / "held-out.json")
    assert read == told
    assert read.open(secret) == secret / DATA


@pytest.mark.parametrize(("name", "content"), [(DATA, b"others"), (SALT, b"0" * 64)])
def test_another_file_or_salt_is_not_what_was_committed_to(secret: Path, name: str, content: bytes) -> None:
    told = _commit(secret)
    (secret / name).write_bytes(content)
    with pytest.raises(DataError, match="commits to"):
        told.open(secret)
    (secret / name).unlink()
    with pytest.raises(DataError, match="lacks"):
        told.open(secret)


def test_the_hash_tells_nothing_without_the_salt_and_salts_differ(secret: Path) -> None:
    salts = {new_salt(secret) for _ in range(3)}
    assert len(salts) == 3
    assert all(len(salt) == 64 for salt in salts)
    assert len({digest(secret / DATA, salt) for salt in salts}) == 3


@pytest.mark.parametrize("change", [{"kind": "units"}, {"held": -1}, {"held": "two"}])
def test_a_file_that_is_no_commitment_is_refused(secret: Path, tmp_path: Path, change: dict[str, object]) -> None:
    (tmp_path / "held-out.json").write_text(json.dumps(_commit(secret).plain | change))
    with pytest.raises(DataError, match=next(iter(change))):
        Commitment.read(tmp_path / "held-out.json")


def test_a_commitment_that_nothing_can_fit_is_refused(secret: Path, tmp_path: Path) -> None:
    path = tmp_path / "held-out.json"
    path.write_text(json.dumps({**_commit(secret).plain, "digest": "xyz"}))
    with pytest.raises(DataError, match="digest is 'xyz'; expected text of length >= 64"):
        Commitment.read(path)
