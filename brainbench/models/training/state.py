"""The whole state of a training run in one safetensors file, so that it goes on exactly where it stood.

Tensors (weights, optimiser, random states) are stored as they are, everything else as JSON in the header. The file
replaces its predecessor in one move: after a kill there is the old state or the new one.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import nn

from brainbench.core.errors import DataError


def save_state(path: Path, learner: nn.Module, optimizer: torch.optim.Optimizer, plain: Mapping[str, Any]) -> None:
    """Write weights, optimiser, random states and plain values."""
    from safetensors.torch import save_file

    from brainbench.core.files import atomic_path

    tensors = {f"learner.{name}": value for name, value in learner.state_dict().items()}
    packed = optimizer.state_dict()
    scalars: dict[str, dict[str, Any]] = {}
    for index, entries in packed["state"].items():
        for key, value in entries.items():
            if isinstance(value, torch.Tensor):
                tensors[f"optimizer.{index}.{key}"] = value
            else:
                scalars.setdefault(str(index), {})[key] = value
    tensors["random.cpu"] = torch.get_rng_state()
    if torch.cuda.is_available():
        tensors["random.cuda"] = torch.cuda.get_rng_state()
    header = {"groups": packed["param_groups"], "scalars": scalars, "plain": dict(plain)}
    with atomic_path(path) as temporary:
        save_file(
            {name: value.detach().cpu().contiguous().clone() for name, value in tensors.items()},
            temporary,
            metadata={"state": json.dumps(header)},
        )


def load_state(path: Path, learner: nn.Module, optimizer: torch.optim.Optimizer) -> dict[str, Any]:
    """Put a run back where :func:`save_state` found it; return the plain values.

    Raises:
        DataError: the file is damaged or belongs to another network.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="pt") as file:
            header = json.loads(file.metadata()["state"])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a mapping
    except (SafetensorError, KeyError, TypeError, json.JSONDecodeError) as error:
        raise DataError(
            f"{str(path)!r} is not a readable training state ({error}); delete it to start anew."
        ) from error
    weights = {name.removeprefix("learner."): value for name, value in tensors.items() if name.startswith("learner.")}
    try:
        learner.load_state_dict(weights)
    except RuntimeError as error:
        raise DataError(f"{str(path)!r} belongs to another network: {error}") from error
    entries: dict[int, dict[str, Any]] = {int(key): dict(value) for key, value in header["scalars"].items()}
    for name, value in tensors.items():
        if name.startswith("optimizer."):
            _, index, key = name.split(".", 2)
            entries.setdefault(int(index), {})[key] = value
    optimizer.load_state_dict({"state": entries, "param_groups": header["groups"]})
    torch.set_rng_state(tensors["random.cpu"])
    if torch.cuda.is_available() and "random.cuda" in tensors:
        torch.cuda.set_rng_state(tensors["random.cuda"])
    return header["plain"]
