"""Write a policy to a file for other runtimes, with its contract, and check the file itself before it is kept."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from brainbench.core.errors import DataError, unknown_name
from brainbench.core.files import atomic_path, provenance, write_json
from brainbench.models.activations import evaluating
from brainbench.models.export import onnx_session, require_onnx

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from robotics_bridge.policies.student import TactilePolicy

SUFFIXES = {"onnx": ".onnx", "jit": ".pt"}
"""Formats and their suffixes: ONNX, and TorchScript."""
TOLERANCE = 1e-4
"""Largest difference of an action between file and policy, relative to the largest action."""
STEPS = 60
"""Steps of the comparison; rows are reset on the way."""

Runner = Callable[[Mapping[str, "NDArray[np.float32]"], bool], "NDArray[np.float32]"]
"""(groups of one row [n…], forget first) → actions [A]."""


@dataclass(frozen=True)
class PolicyExport:
    """A written policy and what was found about it."""

    path: Path
    contract: Path
    """The JSON contract."""
    format: str
    state_size: int
    """H."""
    difference: float
    """Largest difference from the policy over :data:`STEPS` steps, relative to the largest action."""


def export_policy(
    policy: TactilePolicy,
    path: str | Path,
    *,
    format: str = "onnx",
    deployment: Mapping[str, Any] | None = None,
    name: str = "",
) -> PolicyExport:
    """Write a policy and compare the file with it, step by step with resets; a file that differs is not kept.

    Args:
        policy: The policy.
        path: File to write; the suffix of the format is added when there is none.
        format: ``onnx`` or ``jit``.
        deployment: What a robot needs besides (rate, joints, limits, …); kept in the contract.
        name: What the contract calls the policy.

    Raises:
        UsageError: there is no such format.
        MissingDependencyError: a package of the extra ``export`` is missing, for ``onnx``.
        DataError: the file does not compute what the policy does.
    """
    if format not in SUFFIXES:
        raise unknown_name("format of a policy", format, SUFFIXES)
    target = Path(path)
    target = target if target.suffix else target.with_suffix(SUFFIXES[format])
    with atomic_path(target) as temporary, warnings.catch_warnings():
        # The exporters warn of their own parts' deprecations, which nobody here can act on.
        warnings.simplefilter("ignore")
        _write(policy, temporary, format)
        # What the policy reads counts, not what the exported part says of itself.
        difference = compare(policy, read_policy(temporary, policy.shapes, format=format))
        if not difference <= TOLERANCE:
            raise DataError(
                f"The exported file differs from the policy by {difference:.2g} of the largest action (allowed "
                f"{TOLERANCE:g}), so it was not kept."
            )
    contract = {
        "policy": name or type(policy).__name__,
        "format": format,
        "file": target.name,
        # A list: the order counts, and JSON keeps that of lists alone.
        "inputs": [[key, list(shape)] for key, shape in policy.shapes.items()],
        "state": policy.core.state_size,
        "reset": "a state of zeros is the one before the first step" if format == "onnx" else "call reset()",
        "network": policy.config,
        "difference": difference,
        "deployment": dict(deployment or {}),
        "provenance": provenance(),
    }
    file = write_json(target.with_name(f"{target.name}.json"), contract)
    return PolicyExport(target, file, format, policy.core.state_size, difference)


def _write(policy: TactilePolicy, path: Path, format: str) -> None:
    if format == "jit":
        torch.jit.script(policy.as_jit()).save(str(path))
        return
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


def read_policy(
    path: str | Path, shapes: Mapping[str, tuple[int, ...]], *, format: str = "onnx", threads: int | None = None
) -> Runner:
    """Return an exported policy as a function of one step of one hand that remembers.

    Args:
        path: The file.
        shapes: Group → shape, in the order of the contract's ``inputs``.
        format: ``onnx`` or ``jit``.
        threads: Threads that ONNX Runtime computes with; its own choice if None.

    Raises:
        DataError: the file cannot be read, or has other inputs.
    """
    if format == "jit":
        return _JitRunner(path, shapes)
    return _OnnxRunner(path, shapes, threads)


class _OnnxRunner:
    def __init__(self, path: str | Path, shapes: Mapping[str, tuple[int, ...]], threads: int | None) -> None:
        try:
            self.session = onnx_session(path, threads)
        except Exception as error:  # ONNX Runtime's own classes of errors have no common public base
            raise DataError(f"{str(path)!r} cannot be read as an ONNX policy ({error}).") from error
        inputs = {item.name: item.shape for item in self.session.get_inputs()}
        missing = sorted({*shapes, "h_in"} - set(inputs))
        if missing:
            raise DataError(
                f"The exported policy has no input {missing[0]!r} (it has {', '.join(inputs)}), so a part of the "
                "policy was lost on the way."
            )
        self.names, self.size = tuple(shapes), int(inputs["h_in"][1])
        self.state = np.zeros((1, self.size), np.float32)

    def __call__(self, obs: Mapping[str, NDArray[np.float32]], forget: bool = False) -> NDArray[np.float32]:
        if forget:
            self.state = np.zeros((1, self.size), np.float32)
        feed = {name: np.asarray(obs[name], np.float32)[None] for name in self.names}
        actions, self.state = self.session.run(["actions", "h_out"], {**feed, "h_in": self.state})
        return np.asarray(actions)[0]


class _JitRunner:
    def __init__(self, path: str | Path, shapes: Mapping[str, tuple[int, ...]]) -> None:
        self.module = torch.jit.load(str(path))
        self.names = tuple(shapes)

    def __call__(self, obs: Mapping[str, NDArray[np.float32]], forget: bool = False) -> NDArray[np.float32]:
        if forget:
            self.module.reset()
        flat = np.concatenate([np.asarray(obs[name], np.float32).reshape(-1) for name in self.names])
        with torch.no_grad():
            return self.module(torch.from_numpy(flat)[None])[0].numpy()


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
