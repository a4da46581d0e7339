"""A straight whisker and a bar that bends it by a known distance."""

from __future__ import annotations

import math

import numpy as np

from brainbench.stimuli.motion.trajectories import Still, Translation
from brainbench.stimuli.objects.solid import PlacedObject, capsule
from brainbench.stimuli.scenes.scene import Frames, Head, Scene
from brainbench.stimuli.whiskers.array import WhiskerArray

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
