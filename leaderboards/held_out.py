"""Recordings that a board holds back: a published commitment now, the data later.

Whoever keeps a board publishes the salted hash of the file of held-out animals or stimuli. Nobody can learn the data
from it, and nobody can exchange them afterwards: when file and salt are shown, everybody can compute the hash again.
"""

from __future__ import annotations

import hashlib
import os
import secrets
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from brainbench.core.errors import DataError
from brainbench.core.files import file_hash, read_json, write_private
from brainbench.core.limits import Count
from brainbench.core.reading.texts import read_text
from brainbench.core.reading.values import typed_values

DATA, SALT = "held-out.h5", "salt.txt"  # files of the secret folder


class Commitment(msgspec.Struct, frozen=True, rename={"public": "kept"}):
    """The public part of held-out recordings."""

    kind: Literal["animals", "stimuli"]
    """Kind that was held back: animals or stimuli."""
    held: Count
    """Number held back."""
    public: Count
    """Number that is public; files call it ``kept``."""
    recordings: str
    """Content hash of the recordings before they were split."""
    digest: Annotated[str, msgspec.Meta(min_length=64, max_length=64)]
    """SHA-256 of salt and file."""

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Commitment:
        """Read a published commitment; raise DataError if the file is missing or is none."""
        name = f"the commitment {os.fspath(path)!r}"
        return typed_values(cls, read_json(path, "commitment"), name, choices={"kind": ("animals", "stimuli")})

    @property
    def plain(self) -> dict[str, Any]:
        """The commitment as files hold it."""
        return msgspec.to_builtins(self)

    def open(self, secret: str | os.PathLike[str]) -> Path:
        """Return the held-out file of a secret folder, after checking that it is the one committed to."""
        data, salt = Path(secret) / DATA, Path(secret) / SALT
        if not data.is_file() or not salt.is_file():
            raise DataError(f"The secret folder {os.fspath(secret)!r} lacks {DATA!r} or {SALT!r}.")
        if digest(data, read_text(salt, "salt").strip()) != self.digest:
            raise DataError(f"{os.fspath(data)!r} is not what the published hash {self.digest[:12]}… commits to.")
        return data


def digest(data: Path, salt: str) -> str:
    """Return the salted hash of a file."""
    return hashlib.sha256(f"{salt}:{file_hash(data, length=64)}".encode()).hexdigest()


def new_salt(secret: str | os.PathLike[str]) -> str:
    """Write a salt that nobody can guess into a secret folder, which nobody else can enter, and return it."""
    salt = secrets.token_hex(32)
    write_private(Path(secret) / SALT, f"{salt}\n".encode())
    return salt
