"""Array library of the heavy products: numpy on the processor, or torch on any device, by the same code.

Functions of distances use only what both libraries spell alike; :func:`library` names the one that an
array belongs to. Everything is float64 on either side, so the numbers agree to rounding.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.devices import torch_device
from brainbench.core.errors import UsageError

Array = Any  # a numpy array or a torch tensor
Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


def is_tensor(values: Any) -> bool:
    """Return whether ``values`` is a torch tensor; torch is not imported for that."""
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(values, torch.Tensor)


def library(values: Array) -> Any:
    """Return ``numpy``, or ``torch`` for a tensor."""
    return sys.modules["torch"] if is_tensor(values) else np


def find_device(device: Any, *arrays: Any) -> Any:
    """Return the torch device to compute on: ``device``, else where a tensor among ``arrays`` lies; None for numpy."""
    if device is None:
        device = next((array.device for array in arrays if is_tensor(array)), None)
        if device is None:
            return None
    chosen = torch_device(device)
    if chosen.type == "mps":
        raise UsageError("The device 'mps' has no float64, which RDMs need; leave device out.")
    return chosen


def place(values: Any, device: Any) -> Array:
    """Return ``values`` in float64: as a tensor on ``device``, or where and what they are for None."""
    if is_tensor(values):
        return values.detach().to(device or values.device).to(library(values).float64)
    if device is None:
        return np.asarray(values).astype(np.float64, copy=False)
    import torch

    # A copy, since torch refuses memory that numpy may not write to.
    return torch.from_numpy(np.array(values, order="C")).to(device).to(torch.float64)


def fetch(values: Array) -> Any:
    """Return a numpy array of what may be a tensor on any device."""
    return values.detach().cpu().numpy() if is_tensor(values) else np.asarray(values)


def slices(values: Any, elements: int, device: Any) -> Iterator[tuple[slice, Array]]:
    """Yield slices of the last axis with at most ``elements`` entries, in float64 on the device.

    The whole is never copied, so what is wider than the device's memory is computed all the same.
    """
    # Slices of units are summed up by the caller; their number depends on the input alone, so sums are reproducible.
    rows = max(1, int(np.prod(tuple(values.shape[:-1]))))
    step = max(1, elements // rows)
    for start in range(0, values.shape[-1], step):
        part = slice(start, start + step)
        yield part, place(values[..., part], device)


def finite_mean(values: np.ndarray, axis: int | tuple[int, ...] = -1) -> np.ndarray:
    """Return the mean over the finite values along axes, which go; NaN where there is none."""
    present = np.isfinite(values)
    number = present.sum(axis=axis)
    return np.where(number > 0, np.where(present, values, 0.0).sum(axis=axis) / np.maximum(number, 1), np.nan)


def cholesky(matrix: Array) -> Array | None:
    """Return the lower Cholesky factor [N, N], or None where the matrix has none."""
    if is_tensor(matrix):
        # cholesky_ex reports a failure as a number instead of raising.
        factor, info = library(matrix).linalg.cholesky_ex(matrix)
        return None if int(info) else factor
    from scipy.linalg import LinAlgError
    from scipy.linalg import cholesky as factorise

    try:
        return factorise(matrix, lower=True, check_finite=False)
    except LinAlgError:
        return None


def solve_lower(factor: Array, right: Array) -> Array:
    """Return the solution [N, M] of a lower triangular system."""
    if is_tensor(factor):
        return library(factor).linalg.solve_triangular(factor, right, upper=False)
    from scipy.linalg import solve_triangular

    return solve_triangular(factor, right, lower=True, check_finite=False)
