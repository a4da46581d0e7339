"""Whiskers, a post, a bar that bends a whisker, and motions of its base, with which engines are tested."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from brainbench.stimuli.motion.trajectories import Still, Translation, smooth_step
from brainbench.stimuli.objects.obstacle import Capsule, Obstacle
from brainbench.stimuli.objects.solid import PlacedObject, capsule
from brainbench.stimuli.scenes.scene import Frames, Head, Scene
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


def post(x, y, radius=1e-3, **options):
    """Return a post along z through (x, y), 40 mm long; lengths in m."""
    return Obstacle((Capsule((x, y, -0.02), (x, y, 0.02), radius),), **options)


FLAT = (math.pi / 2, 0.0, -math.pi / 2)
"""Angles of a whisker along +x."""


@dataclass(frozen=True)
class _Motion:
    angles: tuple[float, float, float] = (0.0, 0.0, 0.0)
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rest: tuple[float, float, float] = FLAT


@dataclass(frozen=True)
class Swing(_Motion):
    """Angles and displacement that swing out smoothly and stay: amplitude × 6u⁵ − 15u⁴ + 10u³."""

    duration: float = 0.04

    def pose(self, times):
        ramp = smooth_step(times, self.duration)[:, None]
        return ramp * np.array(self.shift), ramp * np.array(self.angles) + np.array(self.rest)


@dataclass(frozen=True)
class Oscillation(_Motion):
    """Sinusoidal angles (rad) about a rest pose and a sinusoidal displacement (m) at ``frequency`` (Hz)."""

    frequency: float = 20.0

    def pose(self, times):
        phase = 2 * np.pi * self.frequency * times
        euler = np.sin(phase)[:, None] * np.array(self.angles) + np.array(self.rest)
        return np.sin(phase + 0.3)[:, None] * np.array(self.shift), euler


# A straight C2 whose base frame lies on the array frame: it points along +x.
STRAIGHT = WhiskerArray.mouse(whiskers="C2").replace(
    position=(0.0, 0.0, 0.0), angles=(math.pi / 2, 0.0, -math.pi / 2), curvature=0.0
)
AT = 6e-3
DEFLECTION = 0.1e-3


def pushed_bar(head: Head | None = None) -> Scene:
    """A smooth upright bar that moves from +y against the whisker by DEFLECTION and stops there."""
    radius = 0.5e-3
    head = head or Head()
    rod = float(STRAIGHT["C2"].whisker.radius(AT))
    speed, onset = 2e-3, 0.02
    travel = speed * (0.08 - onset / 2)
    start = np.array([AT, radius + rod + travel - DEFLECTION, 0.0])
    bar = PlacedObject(
        capsule(radius, 8e-3),
        position=tuple(head.matrix @ start + head.position),
        rotation=head.rotation,
        motion=Translation(tuple(head.matrix @ [0.0, -speed, 0.0]), onset),
        friction=0.0,
    )
    return Scene("pushed", STRAIGHT, (bar,), Still(), head, Frames(0.08, 0.001, 1))
