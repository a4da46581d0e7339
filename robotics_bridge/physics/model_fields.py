"""Per-environment numbers of a MuJoCo model: domain randomisation and variants of objects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.errors import UsageError, unknown_name


def model_fields(model: Any) -> tuple[str, ...]:
    """Return the names of the numeric array fields of a ``mujoco.MjModel``."""
    names = (name for name in dir(model) if not name.startswith("_"))
    return tuple(name for name in names if isinstance(getattr(model, name, None), np.ndarray))


def check_fields(model: Any, fields: Mapping[str, ArrayLike], num_envs: int) -> dict[str, NDArray]:
    """Return the fields as arrays [B, ...] after checking names and shapes.

    Raises:
        UsageError: the model has no such field, or its shape is not one value per environment.
    """
    checked = {}
    for name, values in fields.items():
        own = getattr(model, name, None)
        if not isinstance(own, np.ndarray):
            raise unknown_name("model field", name, model_fields(model))
        array = np.asarray(values, dtype=own.dtype)
        if array.shape != (num_envs, *own.shape):
            raise UsageError(
                f"The field {name!r} needs one value per environment, shape {(num_envs, *own.shape)}; "
                f"received {array.shape}."
            )
        checked[name] = array
    return checked


def differing_fields(models: Sequence[Any], order: Sequence[int], num_envs: int) -> dict[str, NDArray]:
    """Stack per environment [B, ...] every field in which variants of a model differ.

    Args:
        models: compiled variants of one model.
        order: variant of environment e is ``order[e % len(order)]``.
        num_envs: B.

    Raises:
        UsageError: variants differ in structure, not only in numbers.
    """
    first = models[0]
    rows = np.array([order[env % len(order)] for env in range(num_envs)])
    found = {}
    for name in model_fields(first):
        values = [getattr(model, name) for model in models]
        if any(value.shape != values[0].shape for value in values):
            raise UsageError(
                f"Variants of a model must differ in numbers only; the shape of {name!r} differs "
                f"({', '.join(sorted({str(value.shape) for value in values}))}). Give every variant all the meshes, "
                "as compile_variants does."
            )
        if any(not np.array_equal(value, values[0], equal_nan=value.dtype.kind == "f") for value in values[1:]):
            found[name] = np.stack(values)[rows]
    return found
