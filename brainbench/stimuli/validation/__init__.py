"""Whisker mechanics without an engine (:mod:`.references`), and bench tests that hold engines against it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from brainbench.core.lazy import lazy_exports

if TYPE_CHECKING:
    from brainbench.stimuli.validation.bench_tests import peg, point_load, ringdown, slip_off

__all__ = ["peg", "point_load", "ringdown", "slip_off"]

__getattr__, __dir__ = lazy_exports(__name__)
