"""The state of a run in one safetensors file, from which it goes on exactly where it stood.

A state is a tree of dictionaries, lists, tensors and plain values: tensors are stored as they are, the rest as JSON in
the header, so no pickle is needed. A file replaces its predecessor in one move: after a kill there is the old state or
the new one.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from torch import nn

from brainbench.core.errors import DataError, brief
from brainbench.core.reading.regular import check_file, readable, reason
from brainbench.core.reading.tensors import check_finite
from brainbench.core.runs.folder import RESTART, earlier_state
from brainbench.core.writing.tensors import write_tensors

STATE = "state.safetensors"
_LEAF = "__tensor__"


def flatten(tree: Any, prefix: str = "") -> tuple[dict[str, torch.Tensor], Any]:
    """Split a tree into named tensors and a JSON-able rest."""
    tensors: dict[str, torch.Tensor] = {}
    if isinstance(tree, torch.Tensor):
        return {prefix: tree}, {_LEAF: prefix}
    if isinstance(tree, Mapping):
        pairs = []
        for key, value in tree.items():
            inner, rest = flatten(value, f"{prefix}/{key}")
            tensors |= inner
            # JSON knows only text as keys; optimizers number their parameters.
            pairs.append(["int" if isinstance(key, int) else "str", str(key), rest])
        return tensors, {"__dict__": pairs}
    if isinstance(tree, (list, tuple)):
        entries = []
        for index, value in enumerate(tree):
            inner, rest = flatten(value, f"{prefix}/{index}")
            tensors |= inner
            entries.append(rest)
        return tensors, {"__tuple__" if isinstance(tree, tuple) else "__list__": entries}
    return tensors, tree


def restore(rest: Any, tensors: Mapping[str, torch.Tensor]) -> Any:
    """Put together what :func:`flatten` split."""
    if isinstance(rest, dict):
        if _LEAF in rest:
            return tensors[rest[_LEAF]]
        if "__dict__" in rest:
            return {int(k) if kind == "int" else k: restore(v, tensors) for kind, k, v in rest["__dict__"]}
        if "__tuple__" in rest:
            return tuple(restore(value, tensors) for value in rest["__tuple__"])
        if "__list__" in rest:
            return [restore(value, tensors) for value in rest["__list__"]]
    return rest


def save_state(path: str | os.PathLike[str], tree: Mapping[Any, Any]) -> None:
    """Write a tree to one safetensors file, replaced as a whole."""
    tensors, rest = flatten(tree)
    write_tensors(path, tensors, tree=json.dumps(rest))


def load_state(path: str | os.PathLike[str]) -> Any:
    """Read a tree; its tensors are on the CPU."""
    check_file(path, "saved state")
    with readable(path, "saved state", RESTART):
        with safe_open(str(path), framework="pt") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a mapping
            metadata = file.metadata() or {}
        if "tree" not in metadata and "state" in metadata:
            raise earlier_state(Path(path))
        tree = restore(json.loads(metadata["tree"]), tensors)
    if not isinstance(tree, dict):
        raise DataError(f"{str(path)!r} is damaged or not one of ours: it holds no names and values.")
    return tree


def random_state(device: torch.device) -> dict[str, torch.Tensor]:
    """Return the states of PyTorch's random numbers on the CPU and on a device."""
    states = {"cpu": torch.get_rng_state()}
    if device.type == "cuda":
        states["cuda"] = torch.cuda.get_rng_state(device)
    return states


def set_random_state(states: Mapping[str, torch.Tensor], device: torch.device) -> None:
    """Put random numbers back where :func:`random_state` found them."""
    torch.set_rng_state(states["cpu"])
    if device.type == "cuda" and "cuda" in states:
        torch.cuda.set_rng_state(states["cuda"], device)


def learner_state(learner: nn.Module, optimizer: torch.optim.Optimizer) -> dict[str, Any]:
    """Return the weights and moments of a training, as part of its state."""
    return {"learner": learner.state_dict(), "optimizer": optimizer.state_dict()}


def restore_learner(
    state: Mapping[str, Any], learner: nn.Module, optimizer: torch.optim.Optimizer, path: str | os.PathLike[str]
) -> None:
    """Put weights and moments of a state read from a file back; all of them must be finite and fit."""
    weights, moments = state["learner"], state["optimizer"]
    check_finite(flatten([weights, moments])[0], os.fspath(path))
    try:
        learner.load_state_dict(weights)
    except RuntimeError as error:
        raise DataError(f"{brief(os.fspath(path))} belongs to another network ({reason(error)}). {RESTART}") from error
    optimizer.load_state_dict(moments)
    for name in {name for entries in optimizer.state.values() for name in entries}:
        pairs = optimizer.state.items()
        shapes = [(getattr(entries.get(name), "shape", None), weight.shape) for weight, entries in pairs]
        # Moments have the shapes of the weights; counts of steps are alike for all.
        if any(shape != expected for shape, expected in shapes) and len({shape for shape, _ in shapes}) > 1:
            raise DataError(f"{brief(name)} of the optimiser in {brief(os.fspath(path))} fits no weights. {RESTART}")


def odd_shape(
    given: Mapping[str, torch.Tensor], expected: Mapping[str, torch.Tensor]
) -> tuple[str, tuple[int, ...] | None, tuple[int, ...] | None] | None:
    """Return the first name whose shape differs, with both shapes (None where it is missing); None if all agree."""
    theirs, ours = ({name: tuple(value.shape) for name, value in tree.items()} for tree in (given, expected))
    names = (name for name in {**ours, **theirs} if ours.get(name) != theirs.get(name))
    return next(((name, theirs.get(name), ours.get(name)) for name in names), None)
