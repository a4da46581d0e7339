"""Teachers that come with the package, so that a hand turns a block and students learn without a GPU or a network."""

from __future__ import annotations

import os
from pathlib import Path

from brainbench.errors import unknown_name

FOLDER = Path(__file__).parent / "teachers"
"""A run's folder per teacher, with a model card."""


def list_teachers(task: str | None = None) -> list[str]:
    """Return their names ``<task>.<how it was trained>``, of one task or all."""
    names = sorted(path.parent.name for path in FOLDER.glob("*/config.json"))
    return [name for name in names if task in (None, name.partition(".")[0])]


def teacher_path(name: str | os.PathLike[str]) -> Path:
    """Return the folder of a teacher by name; what is there on the disk is taken as it is.

    Raises:
        UsageError: neither is there.
    """
    path = Path(name)
    if path.exists():
        return path
    if str(name) not in list_teachers():
        raise unknown_name("teacher", str(name), list_teachers(), hint="Or give the folder of a training run.")
    return FOLDER / str(name)
