"""Contracts, small exported policies, and ``brainbench policy`` called as a user calls it."""

from __future__ import annotations

import shutil
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from typer.testing import CliRunner

from brainbench.cli import app
from brainbench.core.files import read_json, to_plain, write_json, write_tensors
from robotics_bridge import hands
from robotics_bridge.policies.export import export_policy
from robotics_bridge.policies.shipped import FOLDER
from robotics_bridge.policies.student import TactilePolicy
from robotics_bridge.policies.training.distill import build_student
from robotics_bridge.policies.training.distill_config import DistillConfig
from robotics_bridge.tasks.settings import CONTACTS
from robotics_bridge.tasks.task import TASK_VERSION


def contract_of() -> dict[str, Any]:
    """Return the contract of a hand with three joints, of which actions move two."""
    mapping = {
        "names": ["a", "c"], "default": [0.1, 0.2], "scale": [0.5, -0.5], "low": [-1.0, 0.0], "high": [1.0, 0.4],
    }  # fmt: skip
    deployment = {
        "rate": 40, "hand": "xhand1", "joints": ["a", "b", "c"], "action_map": mapping, "frozen": {"b": 0.3},
        "links": ["l", "m"], "observe": "agg_force", "task": "hold", "sub_steps": 5, "twist": None,
        "contacts": to_plain(asdict(CONTACTS["published"])),
    }  # fmt: skip
    inputs = [["proprio", [8]], ["command", [1]], ["tactile", [5, 2, 3]]]
    return {"format": "onnx", "file": "policy.onnx", "inputs": inputs, "state": 0, "deployment": deployment}


def export_small(folder: Path) -> Path:
    """Write an untrained policy of the XHand1, all of whose joints move, as ``brainbench policy export`` does."""
    hand = hands.load("xhand1")
    joints = hand.joints
    shapes = {"proprio": (36,), "command": (1,), "tactile": (5, 5, 3)}
    obs = TensorDict({name: torch.zeros(1, *shape) for name, shape in shapes.items()}, [1])
    with torch.random.fork_rng():
        torch.manual_seed(0)
        tactile = {"name": "mlp", "observe": "agg_force", "placement": "tips"}
        policy = TactilePolicy(obs, {"s": list(shapes)}, "s", 12, hidden_dims=(16,), tactile=tactile)
    limits = hand.model.jnt_range
    mapping = {"names": joints, "default": [0.3] * 12, "scale": [0.1] * 12, "low": limits[:, 0], "high": limits[:, 1]}
    deployment = {
        "rate": 40, "hand": "xhand1", "observe": "agg_force", "joints": joints, "action_map": mapping, "frozen": {},
        "links": list(hand.layout("med", "tips")), "task": "hold", "twist": None,
        "contacts": asdict(CONTACTS["published"]),
    }  # fmt: skip
    return export_policy(policy, folder / "policy", deployment=deployment).path


def teacher_in(contacts: str, folder: Path) -> Path:
    """Write a copy of the shipped teacher that says it was trained in other contacts, and not from where it acts."""
    shutil.copytree(FOLDER / "in_palm_rotate.teacher", folder)
    described = {**read_json(folder / "config.json"), "contacts": asdict(CONTACTS[contacts])}
    del described["action_map"]
    write_json(folder / "config.json", described)
    return folder


def student_folder(folder: Path) -> Path:
    """Write the folder of a small untrained student of the XHand1, as ``brainbench policy distill`` does."""
    config = DistillConfig(
        task="in_palm_rotate", observe="agg_force", placement="tips", encoder="mlp", hidden=(8,), num_envs=2
    )
    shapes = {"proprio": (8,), "command": (1,), "tactile": (5, 5, 3)}
    with torch.random.fork_rng():
        torch.manual_seed(0)
        student = build_student(config, shapes, list(shapes), 2)
    described = {
        "brainbench_student": 1, "task_version": TASK_VERSION, "distill": asdict(config), "network": student.config,
        "groups": [[name, list(shape)] for name, shape in shapes.items()], "actions": 2,
        "deployment": contract_of()["deployment"],
    }  # fmt: skip
    write_json(folder / "config.json", described)
    write_tensors(folder / "model.safetensors", student.state_dict())
    return folder


def run_policy(*arguments: object, code: int = 0) -> str:
    """Return what ``brainbench policy`` prints; what it raises is raised here too."""
    result = CliRunner().invoke(app, ["policy", *map(str, arguments)])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == code, result.output
    return result.stdout


NETWORK, ITEMS, GROUPS = "zhuang-intersection-ln-small", 45, {"student": ["proprio", "goal", "tactile"]}
"""A network, taxels of a finger, and what a student reads."""


def student_observations(batch: int, steps: int = 1, seed: int = 0) -> TensorDict:
    """Return observations of random numbers [step, environment, …]."""
    generator = torch.Generator().manual_seed(seed)

    def values(*shape: int) -> torch.Tensor:
        return torch.randn(steps, batch, *shape, generator=generator)

    touch = values(5, ITEMS, 6) * torch.tensor([0.2] * 3 + [2e-3] * 3)
    groups = {"proprio": values(30), "goal": values(1), "tactile": touch}
    return TensorDict(groups, batch_size=[steps, batch])


def make_student(name: str = NETWORK, **settings: Any) -> TactilePolicy:
    """Return an untrained student that reads them."""
    from rsl_rl.utils import resolve_class

    cfg = {
        "class_name": "robotics_bridge.policies.student:TactilePolicy",
        "tactile": {"name": name, "placement": "tips", "resolution": "low", **settings.pop("tactile", {})},
        **settings,
    }
    kind, arguments = resolve_class(cfg)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        policy = kind(student_observations(1)[0], GROUPS, "student", 12, **arguments)
    policy.update_normalization(student_observations(64)[0])
    return policy
