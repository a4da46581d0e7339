"""Write a policy to a file for other runtimes, with its contract, and check the file itself before it is kept."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from brainbench.core.errors import DataError
from brainbench.core.files import atomic_path, file_hash, provenance, write_json
from brainbench.models.activations import evaluating
from brainbench.models.export import require_onnx
from robotics_bridge.policies.contract import check_contract
from robotics_bridge.policies.runners import Runner, read_policy
from robotics_bridge.policies.student import TactilePolicy

TOLERANCE = 1e-4
"""Largest difference of an action between file and policy, relative to the largest action."""
STEPS = 60
"""Steps of the comparison; rows are reset on the way."""


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
    with atomic_path(target) as temporary, warnings.catch_warnings():
        # The exporters warn of their own parts' deprecations, which nobody here can act on.
        warnings.simplefilter("ignore")
        _write(policy, temporary)
        # What the policy reads counts, not what the exported part says of itself.
        difference = compare(policy, read_policy(temporary, policy.shapes))
        if not difference <= TOLERANCE:
            raise DataError(
                f"The exported file differs from the policy by {difference:.2g} of the largest action (allowed "
                f"{TOLERANCE:g}), so it was not kept."
            )
    contract |= {"difference": difference, "sha256": file_hash(target, length=64)}
    file = write_json(target.with_name(f"{target.name}.json"), contract)
    return PolicyExport(target, file, policy.core.state_size, difference)


def _write(policy: TactilePolicy, path: Path) -> None:
    require_onnx()
    step: Any = policy.as_onnx()
    batch = torch.export.Dim("batch", min=1, max=8192)
    names = step.input_names
    with torch.no_grad():
        program = torch.onnx.export(
            step, step.get_dummy_inputs(2), dynamo=True, opset_version=18, input_names=names,
            output_names=step.output_names, dynamic_shapes=(tuple({0: batch} for _ in names),), verbose=False,
        )  # fmt: skip
    if program is None:
        raise DataError("PyTorch gave no ONNX program for this policy.")
    program.save(str(path), external_data=False)


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
        found = run({name: value[0].numpy() for name, value in obs.items()}, forget)
        if found.shape != tuple(expected.shape[1:]):
            return math.inf
        error = float(np.abs(found - expected[0].numpy()).max())
        worst = max(worst, error if math.isfinite(error) else math.inf)
        largest = max(largest, float(expected.abs().max()))
    return worst / largest
