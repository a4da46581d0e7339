"""Programs of the benchmarks that are themselves under test; they are loaded as programs, never imported for help."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

from brainbench.core.plugins import load_module

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


def benchmark_program(name: str) -> ModuleType:
    """The program of a path relative to ``benchmarks``."""
    return load_module(str(BENCHMARKS / name))
