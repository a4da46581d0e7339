"""Whisker mechanics without an engine (:mod:`.references`), and bench tests that hold engines against it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from brainbench.core.lazy import lazy_exports

if TYPE_CHECKING:
    from brainbench.stimuli.validation.bench_tests import peg, point_load, ringdown, slip_off

__all__ = ["peg", "point_load", "ringdown", "slip_off"]

_MODULES = {".bench_tests": ("peg", "point_load", "ringdown", "slip_off"), ".references.": ("references",)}
__getattr__, __dir__ = lazy_exports(__name__, {name: module for module, names in _MODULES.items() for name in names})
