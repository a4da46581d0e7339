"""Contracts and small exported policies."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict

from robotics_bridge import hands
from robotics_bridge.policies.export import export_policy
from robotics_bridge.policies.student import TactilePolicy


def contract_of() -> dict[str, Any]:
    """Return the contract of a hand with three joints, of which actions move two."""
    mapping = {
        "names": ["a", "c"], "default": [0.1, 0.2], "scale": [0.5, -0.5], "low": [-1.0, 0.0], "high": [1.0, 0.4],
    }  # fmt: skip
    deployment = {
        "rate": 40, "hand": "xhand1", "joints": ["a", "b", "c"], "action_map": mapping, "frozen": {"b": 0.3},
        "links": ["l", "m"], "observe": "agg_force", "task": "hold", "sub_steps": 5,
    }  # fmt: skip
    inputs = [["proprio", [8]], ["goal", [1]], ["tactile", [5, 2, 3]]]
    return {"format": "onnx", "file": "policy.onnx", "inputs": inputs, "state": 0, "deployment": deployment}


def export_small(folder: Path, *, format: str = "onnx") -> Path:
    """Write an untrained policy of the XHand1, all of whose joints move, as ``brainbench policy export`` does."""
    hand = hands.load("xhand1")
    joints = hand.joints
    shapes = {"proprio": (36,), "goal": (1,), "tactile": (5, 5, 3)}
    obs = TensorDict({name: torch.zeros(1, *shape) for name, shape in shapes.items()}, [1])
    with torch.random.fork_rng():
        torch.manual_seed(0)
        tactile = {"name": "mlp", "observe": "agg_force", "placement": "tips"}
        policy = TactilePolicy(obs, {"s": list(shapes)}, "s", 12, hidden_dims=(16,), tactile=tactile)
    limits = hand.model.jnt_range
    mapping = {"names": joints, "default": [0.3] * 12, "scale": [0.1] * 12, "low": limits[:, 0], "high": limits[:, 1]}
    deployment = {
        "rate": 40, "hand": "xhand1", "observe": "agg_force", "joints": joints, "action_map": mapping, "frozen": {},
        "links": list(hand.layout("med", "tips")), "task": "hold",
    }  # fmt: skip
    return export_policy(policy, folder / "policy", format=format, deployment=deployment).path
