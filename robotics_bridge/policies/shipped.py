"""Policies that come with the package, so that a hand turns a block and students learn without a GPU or a network."""

from __future__ import annotations

import os
from pathlib import Path

from brainbench.core.errors import unknown_name
from brainbench.core.files import read_json

AGENTS = ("zero", "random")
"""Agents that every trained one is held against."""
FOLDER = Path(__file__).parent / "trained"
"""A run's folder per policy, with a model card."""


def list_policies(kind: str, task: str | None = None) -> list[str]:
    """Return the names ``<task>.<what sets it apart>`` of policies of one task or all.

    Args:
        kind: ``teacher`` or ``student``.
        task: None for all.
    """
    files = sorted(FOLDER.glob("*/config.json"))
    found = [file.parent.name for file in files if ("brainbench_student" in read_json(file)) == (kind == "student")]
    return [name for name in found if task in (None, name.partition(".")[0])]


def policy_path(kind: str, name: str | os.PathLike[str]) -> Path:
    """Return the folder of a teacher or student by name; what is there on the disk is taken as it is.

    Raises:
        UsageError: neither is there.
    """
    path = Path(name)
    if path.exists():
        return path
    known = list_policies(kind)
    if str(name) not in known:
        raise unknown_name(kind, str(name), known, hint="Or give the folder of a training run.")
    return FOLDER / str(name)
