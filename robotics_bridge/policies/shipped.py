"""Policies that come with the package, so that a hand turns a block and students learn without a GPU or a network."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from brainbench.core.errors import DataFileNotFoundError, check_name
from brainbench.core.files import read_json, read_mapping

AGENTS = ("zero", "random")  # agents that every trained one is held against
FOLDER = Path(__file__).parent / "trained"
"""A run's folder per policy, with a model card."""
SENSING = "policy"
"""Folder in a teacher's run with the policy as a student's, where it trained on what a hand measures."""
HINT = "Or give the folder of a training run."  # what to do instead where there is no policy of a name


def list_policies(kind: str, task: str | None = None) -> list[str]:
    """Return the names ``<task>.<what sets it apart>`` of a kind (``teacher``, ``student``), of one task or all."""
    files = sorted(FOLDER.glob("*/config.json"))
    names = [file.parent.name for file in files if ("brainbench_student" in read_json(file)) == (kind == "student")]
    return [name for name in names if task in (None, name.partition(".")[0])]


def stored(name: str | os.PathLike[str]) -> dict[str, Any]:
    """Return what the ``config.json`` of a policy by name, folder or model file says; nothing for other agents."""
    path = Path(name) if Path(name).exists() else FOLDER / str(name)
    path = student_folder(path if path.is_dir() else path.parent) / "config.json"
    return read_mapping(path, "configuration of a policy") if path.is_file() else {}


def student_folder(run: Path) -> Path:
    """Return the folder of a run's student: that of :data:`SENSING` where there is one, else the run's own."""
    return run / SENSING if (run / SENSING).is_dir() else run


def policy_path(kind: str, name: str | os.PathLike[str]) -> Path:
    """Return the folder of a teacher or student by name, or a path that exists; UsageError where neither is there."""
    path = Path(name)
    if path.exists():
        return path
    check_name(kind, str(name), list_policies(kind), hint=HINT)
    return FOLDER / str(name)


def newest(run: Path) -> Path:
    """Return the last ``model_<iteration>.safetensors`` of a teacher's run."""
    numbers = [path.stem.removeprefix("model_") for path in run.glob("model_*.safetensors")]
    if not (iterations := [int(number) for number in numbers if number.isdecimal()]):
        raise DataFileNotFoundError(f"{str(run)!r} holds no trained policy (model_<iteration>.safetensors).")
    return run / f"model_{max(iterations)}.safetensors"


def model_file(teacher: str | os.PathLike[str]) -> Path:
    """Return the last model of a run, given its folder or the name of a shipped one, or the model itself."""
    located = policy_path("teacher", teacher)
    return newest(located) if located.is_dir() else located
