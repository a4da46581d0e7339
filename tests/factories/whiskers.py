"""Whiskers that several tests simulate."""

from __future__ import annotations

from brainbench.stimuli.whiskers.whisker import Whisker

C2 = Whisker(0.015265, 48.365e-6, 8.78e-6, young_modulus=5e9, density=(1260.0, 1690.0), damping_ratio=0.32)
"""Mouse whisker C2, straightened."""
H = Whisker(0.020, 50e-6, 5e-6, young_modulus=3e9, density=1300.0, damping_ratio=0.32)
"""A made-up whisker, for which references were derived."""
RAT = Whisker(0.040, 80e-6, 3e-6, young_modulus=3e9, density=1300.0, damping_ratio=0.15)
"""A long, thin whisker as a rat's."""
NEEDLE = Whisker(0.0056, 31e-6, 1.5e-6, young_modulus=5e9, density=1300.0, damping_ratio=0.32)
"""A short whisker with a very thin tip."""
