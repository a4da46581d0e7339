"""Whiskers that several tests simulate."""

from __future__ import annotations

from dataclasses import replace

from brainbench.stimuli.whiskers.array import WhiskerArray
from brainbench.stimuli.whiskers.whisker import Whisker

C2 = Whisker(0.015265, 48.365e-6, 8.78e-6, young_modulus=5e9, density=(1260.0, 1690.0), damping_ratio=0.32)
"""Mouse whisker C2, straightened."""
H = Whisker(0.020, 50e-6, 5e-6, young_modulus=3e9, density=1300.0, damping_ratio=0.32)
"""A made-up whisker, for which references were derived."""
RAT = Whisker(0.040, 80e-6, 3e-6, young_modulus=3e9, density=1300.0, damping_ratio=0.15)
"""A long, thin whisker as a rat's."""
NEEDLE = Whisker(0.0056, 31e-6, 1.5e-6, young_modulus=5e9, density=1300.0, damping_ratio=0.32)
"""A short whisker with a very thin tip."""


def _gate_whiskers() -> dict[str, Whisker]:
    mouse, rat = WhiskerArray.mouse(), WhiskerArray.rat()
    published = [mouse["C2"], mouse["A4"], mouse["E5"], rat["C1"]]
    rods = [replace(mount.whisker, curvature=0.0) for mount in published]
    uniform = Whisker(0.015, 30e-6, 30e-6, young_modulus=5e9, density=1300.0, damping_ratio=0.32)
    steep = Whisker(0.020, 60e-6, 3e-6, young_modulus=3e9, density=1300.0, damping_ratio=0.32)
    return dict(zip(("C2", "A4", "E5", "rat C1", "uniform", "steep"), [*rods, uniform, steep], strict=True))


GATE_WHISKERS = _gate_whiskers()
"""Straight whiskers on which every preset has to keep its promise, by name."""
