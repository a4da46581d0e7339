"""Programs of the benchmarks that are themselves under test; they are loaded as programs, never imported for help."""

from __future__ import annotations

from importlib import import_module
from types import ModuleType


def benchmark_program(name: str) -> ModuleType:
    """The module of a name inside ``benchmarks``, as ``policies.jobs``."""
    return import_module(f"benchmarks.{name}")
