"""Nested states (optimizers, environments) as flat tensors and plain numbers, so that no pickle is needed."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from typing import Any

import torch
from safetensors import safe_open

from brainbench.core.errors import DataError
from brainbench.core.reading.regular import check_file, readable
from brainbench.core.writing.tensors import write_tensors

_LEAF = "__tensor__"


def flatten(tree: Any, prefix: str = "") -> tuple[dict[str, torch.Tensor], Any]:
    """Split a tree of dictionaries, lists, tensors and numbers into named tensors and a JSON-able rest."""
    tensors: dict[str, torch.Tensor] = {}
    if isinstance(tree, torch.Tensor):
        return {prefix: tree}, {_LEAF: prefix}
    if isinstance(tree, Mapping):
        pairs = []
        for key, value in tree.items():
            found, rest = flatten(value, f"{prefix}/{key}")
            tensors |= found
            # JSON knows only text as keys; optimizers number their parameters.
            pairs.append(["int" if isinstance(key, int) else "str", str(key), rest])
        return tensors, {"__dict__": pairs}
    if isinstance(tree, (list, tuple)):
        items = []
        for index, value in enumerate(tree):
            found, rest = flatten(value, f"{prefix}/{index}")
            tensors |= found
            items.append(rest)
        return tensors, {"__tuple__" if isinstance(tree, tuple) else "__list__": items}
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


def save(path: str | os.PathLike[str], tree: Any) -> None:
    """Write a tree to one safetensors file, replaced as a whole."""
    tensors, rest = flatten(tree)
    write_tensors(path, tensors, tree=json.dumps(rest))


def load(path: str | os.PathLike[str], device: str = "cpu") -> Any:
    """Read a tree."""
    check_file(path, "saved state")
    with readable(path, "saved state"):
        with safe_open(str(path), framework="pt", device=device) as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            metadata = file.metadata() or {}
        tree = restore(json.loads(metadata["tree"]), tensors)
    if not isinstance(tree, dict):
        raise DataError(f"{str(path)!r} is damaged or not one of ours: it holds no names and values.")
    return tree


def odd_shape(found: Mapping[str, torch.Tensor], own: Mapping[str, torch.Tensor]) -> tuple[str, Any, Any] | None:
    """Return the first name whose shape differs, with both shapes (None where it is missing); None if all agree."""
    theirs, mine = ({name: tuple(value.shape) for name, value in tree.items()} for tree in (found, own))
    names = (name for name in {**mine, **theirs} if mine.get(name) != theirs.get(name))
    return next(((name, theirs.get(name), mine.get(name)) for name in names), None)
