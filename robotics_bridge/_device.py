"""Warp and MuJoCo, loaded late, and their devices."""

from __future__ import annotations

from functools import cache
from importlib import import_module
from typing import Any

from brainbench.errors import MissingDependencyError, UsageError


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
            "The tactile simulator needs warp-lang; install it with: pip install 'brainbench[tactile]'"
        ) from error
    # Only errors: a user need not hear which devices there are, nor that kernels were compiled.
    wp.config.log_level = wp.LOG_ERROR
    wp.config.enable_backward = False
    wp.init()
    return wp


def mujoco_module() -> Any:
    """Return the module ``mujoco``, loaded late; its names are made at run time."""
    return import_module("mujoco")


def pick_device(name: Any) -> Any:
    """Return the Warp device called ``cpu``, ``cuda`` or ``cuda:1``; a Warp device passes through.

    Raises:
        UsageError: there is no such device here.
    """
    wp = warp()
    if not isinstance(name, str):
        return wp.get_device(name)
    if name != "cpu" and name.split(":")[0] != "cuda":
        raise UsageError(f"A device is 'cpu' or 'cuda'; received {name!r}.")
    if name != "cpu" and not wp.is_cuda_available():
        raise UsageError(f"No CUDA device was found, so {name!r} cannot be used; use 'cpu'.")
    return wp.get_device(name)
