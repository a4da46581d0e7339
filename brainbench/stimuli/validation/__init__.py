"""Whisker mechanics without an engine (:mod:`.references`), and bench tests that hold engines against it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from brainbench.core.lazy import lazy_exports

if TYPE_CHECKING:
    from brainbench.stimuli.validation import references
    from brainbench.stimuli.validation.bench_tests import BenchTest, peg, point_load, ringdown, slip_off

__all__ = [
    "BenchTest",
    "peg",
    "point_load",
    "references",
    "ringdown",
    "slip_off",
]

__getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "BenchTest": ".bench_tests",
        "peg": ".bench_tests",
        "point_load": ".bench_tests",
        "references": ".references.",
        "ringdown": ".bench_tests",
        "slip_off": ".bench_tests",
    },
)
