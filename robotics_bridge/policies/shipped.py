"""Policies that come with the package, so that a hand turns a block and students learn without a GPU or a network."""

from __future__ import annotations

import os
from pathlib import Path

from brainbench.core.errors import unknown_name
from brainbench.core.files import read_json

FOLDER = Path(__file__).parent / "trained"
"""A run's folder per policy, with a model card."""


def list_teachers(task: str | None = None) -> list[str]:
    """Return their names ``<task>.<how it was trained>``, of one task or all."""
    return _names(task, student=False)


def list_students(task: str | None = None) -> list[str]:
    """Return their names ``<task>.<what it feels>``, of one task or all."""
    return _names(task, student=True)


def teacher_path(name: str | os.PathLike[str]) -> Path:
    """Return the folder of a teacher by name; what is there on the disk is taken as it is.

    Raises:
        UsageError: neither is there.
    """
    return _path(name, "teacher", list_teachers())


def student_path(name: str | os.PathLike[str]) -> Path:
    """Return the folder of a student by name; what is there on the disk is taken as it is.

    Raises:
        UsageError: neither is there.
    """
    return _path(name, "student", list_students())


def _names(task: str | None, *, student: bool) -> list[str]:
    files = sorted(FOLDER.glob("*/config.json"))
    found = [file.parent.name for file in files if ("brainbench_student" in read_json(file)) == student]
    return [name for name in found if task in (None, name.partition(".")[0])]


def _path(name: str | os.PathLike[str], kind: str, known: list[str]) -> Path:
    path = Path(name)
    if path.exists():
        return path
    if str(name) not in known:
        raise unknown_name(kind, str(name), known, hint="Or give the folder of a training run.")
    return FOLDER / str(name)
