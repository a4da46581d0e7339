"""The files of a student's run: its configuration and weights, written, read and checked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import msgspec
import torch
from safetensors import safe_open

from brainbench.core.errors import DataError
from brainbench.core.files import read_mapping
from brainbench.core.reading.regular import readable
from brainbench.core.reading.tensors import read_tensors
from brainbench.core.runs.folder import odd_shape
from robotics_bridge.hands.layouts import check_probes
from robotics_bridge.policies.contract import JOINTS, Groups, from_json, shapes_of
from robotics_bridge.policies.encoders.arms import EncoderConfig
from robotics_bridge.policies.fit import check_version
from robotics_bridge.policies.shipped import policy_path, student_folder
from robotics_bridge.policies.student import TACTILE, TactilePolicy
from robotics_bridge.policies.training.distill_config import DistillConfig

CONFIG, MODEL = "config.json", "model.safetensors"


class _Described(msgspec.Struct):
    distill: dict[str, Any]
    groups: Groups
    actions: Annotated[int, msgspec.Meta(ge=1, le=JOINTS)]
    deployment: dict[str, Any]


def build_student(
    config: DistillConfig, shapes: Mapping[str, tuple[int, ...]], groups: list[str], actions: int
) -> TactilePolicy:
    """Return a student of ``groups`` with new weights (the global random state)."""
    example: Any = {name: torch.zeros(1, *shapes[name]) for name in groups}
    tactile = config.tactile
    return TactilePolicy(
        example, {"student": groups}, "student", actions, hidden_dims=config.hidden, embedder=config.embedder,
        tactile=asdict(tactile) if tactile is not None else None,
    )  # fmt: skip


def begin_with(student: TactilePolicy, start: str | Path) -> None:
    """Give a student the weights of another, by folder or shipped name; learning begins anew."""
    path = policy_path("student", start) / MODEL
    with readable(path, "student", "It is damaged, or of another student."):
        weights = read_tensors(path, "file of weights (safetensors)")
    if odd := odd_shape(weights, student.state_dict()):
        name, theirs, mine = odd
        raise DataError(
            f"The student {str(start)!r} has {name!r} of shape {theirs}, here {mine}: start from one that feels and "
            "acts alike."
        )
    student.load_state_dict(weights)


def load_student(folder: str | Path, *, device: str = "cpu") -> tuple[TactilePolicy, dict[str, Any]]:
    """Return a distilled student in evaluation mode, and its run's configuration.

    The folder is that of a run, or a name of :func:`~robotics_bridge.policies.shipped.list_policies`.
    """
    folder = student_folder(policy_path("student", folder))
    described = read_mapping(folder / CONFIG, "configuration of a student")
    if described.get("brainbench_student") != 1:
        raise DataError(f"{str(folder)!r} holds no student; brainbench policy distill makes one.")
    if not (folder / MODEL).is_file():
        raise DataError(f"The student in {str(folder)!r} has no weights yet; its run was interrupted early.")
    check_version(described, str(folder))
    stated = from_json(_Described, described, CONFIG)
    config = from_json(DistillConfig, stated.distill, CONFIG)
    settings = {name: value for name, value in config.encoder_settings.items() if value is not None}
    # Which settings it may have depends on the encoder's name.
    from_json(EncoderConfig, {**settings, "name": config.encoder}, f"encoder_settings of {CONFIG}")
    shapes, actions = shapes_of(stated.groups, CONFIG, "groups"), stated.actions
    with readable(folder / MODEL, "student", "It is damaged, or of another student."):
        _require_sizes(folder / MODEL, config, shapes)
        with torch.random.fork_rng(devices=[]):
            student = build_student(config, shapes, list(shapes), actions)
        student.load_state_dict(read_tensors(folder / MODEL, "file of weights (safetensors)"))
    check_probes(config.resolution, stated.deployment.get("probes"))
    return student.to(device).eval(), described


def _require_sizes(path: Path, config: DistillConfig, shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Compare the sizes that a configuration states with the file's, before networks of that size take memory."""
    with safe_open(path, "pt") as file:
        sizes = {name: file.get_slice(name).get_shape() for name in file.keys()}  # noqa: SIM118
    flat = sum(shape[0] for name, shape in shapes.items() if name != TACTILE)
    widths = [sizes.get(f"mlp.{2 * index}.bias") for index in range(len(config.hidden))]
    mean = sizes.get("obs_normalizer._mean", [1, flat])
    if mean != [1, flat] or widths != [[width] for width in config.hidden]:
        raise DataError(f"The weights in {str(path.parent)!r} are of another student than {CONFIG} describes.")
