"""Exported policies: written with their contract, compared with the policy, read again as a function of one step.

A file is tried before it is kept, and before it may move anything.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from brainbench.core.errors import BrainbenchError, DataError
from brainbench.core.files import atomic_path, file_hash, provenance, write_json
from brainbench.models.activations import evaluating
from brainbench.models.export import BATCH, check_difference, onnx_session, require_onnx, write_step
from robotics_bridge.policies.contract import MOST_NUMBERS, check_contract
from robotics_bridge.policies.student import TactilePolicy

Runner = Callable[[Mapping[str, NDArray[np.float32]], bool], NDArray[np.float32]]
"""(groups of one row [n…], forget first) → actions [A]."""


def read_policy(
    path: str | Path, shapes: Mapping[str, tuple[int, ...]], *, threads: int | None = None, actions: int | None = None
) -> Runner:
    """Return an exported policy as a function of one step of one hand that remembers.

    Args:
        shapes: Group → shape, in the order of the contract's ``inputs``.
        threads: Threads that ONNX Runtime computes with; its own choice if None.
        actions: A; not checked if None.
    """
    require_onnx()
    try:
        run: Runner = _OnnxRunner(path, shapes, threads)
        # A step of zeros shows here, and not with a hand in motion, what a file computes.
        tried = run({name: np.zeros(shape, np.float32) for name, shape in shapes.items()}, True)
    except BrainbenchError:
        raise
    except Exception as error:  # ONNX and ONNX Runtime have no common public base of errors
        first = str(error).strip().partition("\n")[0][:80]
        raise DataError(f"{str(path)!r} cannot be read as an ONNX policy ({first}).") from error
    if tried.ndim != 1 or (actions is not None and len(tried) != actions):
        raise DataError(f"{str(path)!r} gives actions of shape {tried.shape}; its contract has {actions}.")
    return run


class _OnnxRunner:
    """An ONNX file as a function of one step, with the memory between steps."""

    def __init__(self, path: str | Path, shapes: Mapping[str, tuple[int, ...]], threads: int | None) -> None:
        self.session = onnx_session(path, threads)
        inputs = {item.name: item.shape for item in self.session.get_inputs()}
        if missing := sorted({*shapes, "h_in"} - set(inputs)):
            raise DataError(
                f"The exported policy has no input {missing[0]!r} (it has {', '.join(inputs)}), so a part of the "
                "policy was lost on the way."
            )
        self.names, self.size = tuple(shapes), int(inputs["h_in"][1])
        if not 0 < self.size <= MOST_NUMBERS:
            raise DataError(f"{str(path)!r} has a memory of {self.size:,} numbers; 1 to {MOST_NUMBERS:,} are allowed.")
        self.state = np.zeros((1, self.size), np.float32)

    def __call__(self, obs: Mapping[str, NDArray[np.float32]], forget: bool = False) -> NDArray[np.float32]:
        if forget:
            self.state = np.zeros((1, self.size), np.float32)
        feed = {name: np.asarray(obs[name], np.float32)[None] for name in self.names}
        actions, self.state = self.session.run(["actions", "h_out"], {**feed, "h_in": self.state})
        return np.asarray(actions)[0]


STEPS = 60  # steps of the comparison; rows are reset on the way


@dataclass(frozen=True)
class PolicyExport:
    """A written policy and what was found about it."""

    path: Path
    contract: Path
    """The JSON contract."""
    state_size: int
    """H."""
    difference: float
    """Largest difference from the policy over :data:`STEPS` steps, relative to the largest action."""


def export_policy(
    policy: TactilePolicy, path: str | Path, *, deployment: Mapping[str, Any] | None = None, name: str = ""
) -> PolicyExport:
    """Write a policy and compare the file with it, step by step with resets; a file that differs is not kept.

    Args:
        path: The suffix .onnx is added when there is none.
        deployment: What a robot needs besides (rate, joints, limits, …); kept in the contract.
        name: What the contract calls the policy.
    """
    target = Path(path) if Path(path).suffix else Path(path).with_suffix(".onnx")
    contract = {
        "policy": name or type(policy).__name__,
        "format": "onnx",
        "file": target.name,
        # A list: the order counts, and JSON keeps that of lists alone.
        "inputs": [[key, list(shape)] for key, shape in policy.shapes.items()],
        "state": policy.core.state_size,
        "reset": "a state of zeros is the one before the first step",
        "network": policy.config,
        "deployment": dict(deployment or {}),
        "provenance": provenance(),
    }
    check_contract(contract, target.name)
    step: Any = policy.as_onnx()
    shapes = (tuple(BATCH for _ in step.input_names),)
    with atomic_path(target) as temporary:
        write_step(step, step.get_dummy_inputs(2), temporary, "onnx", shapes, step.input_names, step.output_names)
        # What the policy reads counts, not what the exported part says of itself.
        difference = compare(policy, read_policy(temporary, policy.shapes))
        check_difference(difference, "policy", "action")
    contract |= {"difference": difference, "sha256": file_hash(target, length=64)}
    file = write_json(target.with_name(f"{target.name}.json"), contract)
    return PolicyExport(target, file, policy.core.state_size, difference)


def compare(policy: TactilePolicy, run: Runner) -> float:
    """Return the largest difference of actions between a file and its policy on a random stream with resets.

    It is relative to the largest action; infinite where the file gives no numbers or fails.
    """
    generator = torch.Generator().manual_seed(0)
    h = policy.zeros(1)
    worst, largest = 0.0, 1e-12
    for step in range(STEPS):
        forget = step in (0, STEPS // 3, STEPS // 3 + 1, 2 * STEPS // 3)
        # Unit noise on flat groups; touch as large as the hand's.
        obs = {
            name: torch.randn(1, *shape, generator=generator) * (0.2 if len(shape) > 1 else 1.0)
            for name, shape in policy.shapes.items()
        }
        if forget:
            h = torch.zeros_like(h)
        with torch.no_grad(), evaluating(policy):
            latent, h = policy.advance({name: value.to(h.device) for name, value in obs.items()}, h)
            expected = policy.action_of(latent).cpu()
        actions = run({name: value[0].numpy() for name, value in obs.items()}, forget)
        if actions.shape != tuple(expected.shape[1:]):
            return math.inf
        error = float(np.abs(actions - expected[0].numpy()).max())
        worst = max(worst, error if math.isfinite(error) else math.inf)
        largest = max(largest, float(expected.abs().max()))
    return worst / largest
