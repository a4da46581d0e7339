"""Warp, loaded late and quietly, and its devices."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from brainbench.errors import MissingDependencyError, UsageError

if TYPE_CHECKING:
    from collections.abc import Mapping


@cache
def warp() -> Any:
    """Return the initialised module ``warp``.

    Raises:
        MissingDependencyError: it is not installed.
    """
    try:
        import warp as wp
    except ImportError as error:
        raise MissingDependencyError(
            "The rod backend needs warp-lang; install it with: pip install 'brainbench[rod]'"
        ) from error
    # Only errors: a user need not hear which devices there are, nor that kernels were compiled.
    wp.config.log_level = wp.LOG_ERROR
    wp.config.enable_backward = False
    wp.init()
    return wp


def pick_device(name: str) -> Any:
    """Return the Warp device called ``cpu`` or ``cuda`` (``cuda:1``).

    Raises:
        UsageError: there is no such device here.
    """
    wp = warp()
    if name != "cpu" and not name.startswith("cuda"):
        raise UsageError(f"A device is 'cpu' or 'cuda'; received {name!r}.")
    if name != "cpu" and not wp.is_cuda_available():
        raise UsageError(f"No CUDA device was found, so {name!r} cannot be used; use 'cpu'.")
    return wp.get_device(name)


def to_struct(kind: Any, values: Mapping[str, np.ndarray], device: Any) -> Any:
    """Fill a Warp structure of arrays; empty arrays become one unused element."""
    wp = warp()
    struct = kind()
    for name, value in values.items():
        dtype = kind.vars[name].type.dtype
        array = np.ascontiguousarray(value)
        if array.size == 0:
            array = np.zeros((1, *array.shape[1:]), dtype=array.dtype)
        setattr(struct, name, wp.array(array, dtype=dtype, device=device))
    return struct
