"""MuJoCo, loaded late."""

from __future__ import annotations

from functools import cache
from importlib import import_module
from typing import Any


@cache
def engine() -> Any:
    """Return the module ``mujoco``."""
    return import_module("mujoco")
