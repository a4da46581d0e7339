"""Policies that come with the package, so that a hand turns a block and students learn without a GPU or a network."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from brainbench.core.errors import check_name
from brainbench.core.files import read_json
from robotics_bridge.policies.schema import Values
from robotics_bridge.tasks.task import MEASURED

AGENTS = ("zero", "random")
"""Agents that every trained one is held against."""
FOLDER = Path(__file__).parent / "trained"
"""A run's folder per policy, with a model card."""


def list_policies(kind: str, task: str | None = None) -> list[str]:
    """Return the names ``<task>.<what sets it apart>`` of a kind (``teacher``, ``student``), of one task or all."""
    files = sorted(FOLDER.glob("*/config.json"))
    found = [file.parent.name for file in files if ("brainbench_student" in read_json(file)) == (kind == "student")]
    return [name for name in found if task in (None, name.partition(".")[0])]


def stored(name: str | os.PathLike[str]) -> dict[str, Any]:
    """Return what the ``config.json`` of a policy by name, folder or model file says; nothing for other agents."""
    path = Path(name) if Path(name).exists() else FOLDER / str(name)
    path = (path if path.is_dir() else path.parent) / "config.json"
    return dict(Values.read(path).values) if path.is_file() else {}


def unmeasured_inputs(described: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the groups that a student of this ``config.json`` reads and no hand has; none for a teacher."""
    groups = described.get("groups", ()) if "brainbench_student" in described else ()
    return tuple(name for name, _ in groups if name not in MEASURED)


def policy_path(kind: str, name: str | os.PathLike[str]) -> Path:
    """Return the folder of a teacher or student by name, or a path that exists; UsageError where neither is there."""
    path = Path(name)
    if path.exists():
        return path
    check_name(kind, str(name), list_policies(kind), hint="Or give the folder of a training run.")
    return FOLDER / str(name)
