"""Objects that whiskers meet: primitives, the Rodgers solid, procedural shapes and meshes from files. Metres.

A :class:`Solid` stands in its own frame; :class:`PlacedObject` puts it into a scene.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from brainbench.core.errors import UsageError
from brainbench.geometry import Mesh
from brainbench.stimuli.motion.trajectories import Path, Spin, Still, Translation
from brainbench.stimuli.objects.mesh_solids import COLLISIONS, mesh_solid, shape_solid, shape_solids
from brainbench.stimuli.objects.obstacle import Box, Capsule, ConvexPart, Cylinder, Obstacle, Sphere
from brainbench.stimuli.objects.placement import euler_matrix, move_part, scale_part, translating, turning
from brainbench.stimuli.objects.solid import Solid, to_surface

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

__all__ = [
    "COLLISIONS",
    "RODGERS_CONTROL",
    "RODGERS_OFFSET",
    "RODGERS_SPAN",
    "PlacedObject",
    "Solid",
    "box",
    "capsule",
    "cylinder",
    "euler_matrix",
    "mesh_solid",
    "move_part",
    "rodgers_solid",
    "scale_part",
    "shape_solid",
    "shape_solids",
    "sphere",
]

Vector = tuple[float, float, float]

RODGERS_CONTROL = ((-0.720943, 0.195148), (-0.167777, 0.219684), (0.235608, -0.057831), (0.631506, -0.409149))
"""Control points (x, y) of the cubic Bézier curve that is the convex face of the Rodgers solid, in the
units of the published mesh (1 unit = 34.324 mm at a diagonal of 55 mm). Fitted by us; the curve passes
through all 101 published vertices of that face within 6e-7."""
RODGERS_OFFSET = (-0.020447, -0.046006)
"""Displacement (x, y) from the convex to the concave face: the profile is the curve swept along it."""
RODGERS_SPAN = (-0.256589, 0.251290)
"""Lowest and highest z of the extruded profile."""


@dataclass(frozen=True, eq=False)
class PlacedObject:
    """A solid in a scene (world frame)."""

    solid: Solid
    position: Vector = (0.0, 0.0, 0.0)
    """Where the solid's origin lies [m]."""
    rotation: Vector = (0.0, 0.0, 0.0)
    """Angles [rad] about the world's x, then y, then z axis."""
    motion: Still | Translation | Spin | Path = field(default_factory=Still)
    """How it moves from there; it turns about its solid's origin."""
    friction: float | None = None
    """Coulomb coefficient of its contacts; None takes each whisker's own."""

    def obstacle(self, frame: tuple[ArrayLike, ArrayLike] | None = None) -> Obstacle:
        """Return what the physics sees.

        Args:
            frame: rotation [3, 3] and origin [3] (m) of the frame, in the world, in which the
                obstacle and its motion are expressed; the world itself when None.
        """
        axes, origin = (np.eye(3), np.zeros(3)) if frame is None else (np.asarray(frame[0]), np.asarray(frame[1]))
        rotation = axes.T @ euler_matrix(self.rotation)
        place = axes.T @ (np.asarray(self.position) - origin)
        motion = self.motion
        path = None
        if isinstance(motion, (Spin, Path)):
            path = turning(motion, axes, place)
        elif isinstance(motion, Translation):
            path = translating(motion, axes)
        # What turns is expressed about its own origin, which stays near it.
        shift = np.zeros(3) if isinstance(motion, (Spin, Path)) else place
        parts = tuple(move_part(part, rotation, shift) for part in self.solid.parts)
        surface = self.solid.surface and self.solid.surface.moved(rotation, shift)
        return Obstacle(parts=parts, motion=path, friction=self.friction, surface=surface)

    def config(self) -> dict[str, Any]:
        """Plain values that determine the physics."""
        return {
            "solid": self.solid.config(),
            "position": list(self.position),
            "rotation": list(self.rotation),
            "motion": self.motion.config(),
            "friction": self.friction,
        }


def sphere(radius: float) -> Solid:
    """Return a ball about the origin; ``radius`` in metres."""
    return Solid("sphere", (Sphere((0.0, 0.0, 0.0), radius),))


def box(size: Vector) -> Solid:
    """Return a box about the origin with edge lengths ``size`` [m]."""
    half = (size[0] / 2, size[1] / 2, size[2] / 2)
    return Solid("box", (Box((0.0, 0.0, 0.0), half),))


def cylinder(radius: float, height: float) -> Solid:
    """Return an upright (z) cylinder about the origin, such as a pole; metres."""
    return Solid("cylinder", (Cylinder((0.0, 0.0, -height / 2), (0.0, 0.0, height / 2), radius),))


def capsule(radius: float, length: float) -> Solid:
    """Return an upright (z) capsule about the origin; ``length`` [m] between the centres of its caps."""
    return Solid("capsule", (Capsule((0.0, 0.0, -length / 2), (0.0, 0.0, length / 2), radius),))


def rodgers_solid(diagonal: float = 0.055, *, segments: int = 24) -> Solid:
    """Return the crescent of the shape-discrimination task (Rodgers 2022), in the published mesh's frame.

    A cubic Bézier profile of constant offset, extruded along z. Each segment between two points of
    the curve is a parallelogram prism, so the parts are exactly convex, their union is exactly the
    polygonal solid and the concave face stays concave. The concave face looks towards −y.

    Args:
        diagonal: bounding-box diagonal [m]; 55 mm in the published simulation.
        segments: prisms along the curve; 24 leave a sagitta below 0.02 mm at 55 mm.
    """
    if segments < 2:
        raise UsageError(f"The Rodgers solid needs at least 2 segments along its curve; received {segments}.")
    t = np.linspace(0.0, 1.0, segments + 1)[:, None]
    weights = np.hstack([(1 - t) ** 3, 3 * t * (1 - t) ** 2, 3 * t**2 * (1 - t), t**3])
    convex = weights @ np.array(RODGERS_CONTROL)
    concave = convex + np.array(RODGERS_OFFSET)
    # Rings of four corners along the curve: convex low, convex high, concave high, concave low.
    low, high = (np.full(segments + 1, height) for height in RODGERS_SPAN)
    profile = ((convex, low), (convex, high), (concave, high), (concave, low))
    rings = np.stack([np.column_stack([side, height]) for side, height in profile], axis=1)
    corner, following = np.arange(4), np.roll(np.arange(4), -1)
    near = 4 * np.arange(segments)[:, None]
    quads = np.stack([near + corner, near + corner + 4, near + following + 4, near + following], axis=-1).reshape(-1, 4)
    last = 4 * segments
    quads = np.vstack([quads, [[0, 1, 2, 3]], [[last + 3, last + 2, last + 1, last]]])
    faces = np.vstack([quads[:, [0, 2, 1]], quads[:, [0, 3, 2]]])
    mesh = Mesh(rings.reshape(-1, 3), faces, "rodgers")
    parts = tuple(ConvexPart(np.vstack([rings[i], rings[i + 1]])) for i in range(segments))
    return Solid("rodgers", parts, mesh, surface=to_surface(mesh)).to_diagonal(diagonal)
