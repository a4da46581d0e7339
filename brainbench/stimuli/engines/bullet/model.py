"""One whisker among obstacles as a Bullet multi-body, in mg, mm and ms, so in mN and µN·m.

Joint tree: world → three slides along x, y, z → three turns (θ − π/2 about z, φ about −y, ζ + π/2 about x)
→ link 0 → … → link N − 1, each link on two hinges: like WHISKiT's, these whiskers do not twist. The first six joints
are the follicle, whose motion is prescribed; their reactions are the base wrench. Letters: n time step, N link.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.errors import MissingDependencyError, UsageError, install_command, missing_dependency
from brainbench.core.rotations import from_z_axis
from brainbench.stimuli.engines.stepping import LEAST_TAPER, cone_vertices
from brainbench.stimuli.engines.units import MICRO, MILLI
from brainbench.stimuli.objects.obstacle import Box, Capsule, ConvexPart, Cylinder, Obstacle, Part, Sphere
from brainbench.stimuli.whiskers.chain import Chain

FOLLICLE = 6
"""Joints of the follicle, which come first."""
MOST_LINKS = 60
"""Links per whisker: PyBullet moves fewer than 128 degrees of freedom through its interface."""
HULL_MARGIN = 1e-3
"""Margin (mm) that PyBullet wraps around convex hulls; subtracted again from the distances."""

_NOTHING = 1e-12
"""Mass (mg) and inertia (mg·mm²) of carriers between joints: far below those of any tip."""
_STILL = (0.0, 0.0, 0.0, 1.0)


def engine() -> Any:
    """Return the ``pybullet`` module, or raise a :class:`MissingDependencyError`."""
    try:
        return import_module("pybullet")
    except ImportError as error:
        if sys.version_info >= (3, 12):
            raise MissingDependencyError(
                "The whisker backend 'bullet' needs PyBullet, which is made for Python below 3.12; "
                f"use Python 3.11 with {install_command('bullet')}, or the backend 'mujoco'."
            ) from error
        raise missing_dependency("pybullet", extra="bullet", purpose="The whisker backend 'bullet'") from error


@dataclass(eq=False)
class BulletWorld:
    """A Bullet world with one whisker of at most :data:`MOST_LINKS`, and its obstacles; a context manager ends it."""

    chain: Chain
    obstacles: Sequence[Obstacle]
    nearest: float
    """Least distance of any obstacle from the base (m): links that end before cannot touch and get no shape."""
    gravity: NDArray[np.float64]
    """Gravitational acceleration [3] (m/s²)."""
    whisker: int = field(init=False)
    """Bullet's number of the whisker's body."""
    parts: list[list[int]] = field(init=False, default_factory=list)
    """Bullet's numbers of the bodies of each obstacle's parts."""

    def __post_init__(self) -> None:
        if self.chain.links > MOST_LINKS:
            raise UsageError(
                f"The backend 'bullet' simulates at most {MOST_LINKS} links per whisker, because PyBullet "
                f"moves fewer than 128 degrees of freedom; received {self.chain.links}. Choose fewer links or the "
                "backend 'mujoco'."
            )
        self.bullet = engine()
        radii = self.chain.whisker.radius(self.chain.nodes) * MILLI
        cores, thin = np.abs(np.diff(radii)), np.minimum(radii[:-1], radii[1:])
        self._cores = np.where(cores >= LEAST_TAPER, cores, 0.0)
        # Bullet's own margin of a hull is part of the link's.
        self._margins = np.where(self._cores > 0, thin - HULL_MARGIN, 0.0)

    def __enter__(self) -> BulletWorld:
        # The module, with the number of this world in every call.
        self.bullet = import_module("pybullet_utils.bullet_client").BulletClient(self.bullet.DIRECT)
        self.bullet.setGravity(*(self.gravity / MILLI))
        self.whisker = self._add_whisker()
        bodies = self.bullet.createMultiBody
        self.parts = [[bodies(0, self._shape(part)) for part in obstacle.parts] for obstacle in self.obstacles]
        return self

    def __exit__(self, *_: object) -> None:
        self.bullet.disconnect()

    def mass_matrix(self, q: Sequence[float]) -> NDArray[np.float64]:
        """Return the joint-space inertia [6 + 2N, 6 + 2N] at the joint positions ``q``."""
        return np.array(self.bullet.calculateMassMatrix(self.whisker, q))

    def inverse_dynamics(
        self, q: Sequence[float], rate: Sequence[float], acceleration: Sequence[float]
    ) -> NDArray[np.float64]:
        """Return the joint forces [6 + 2N] that cause the accelerations without contacts, gravity included."""
        return np.array(self.bullet.calculateInverseDynamics(self.whisker, q, rate, acceleration))

    def place(self, q: Sequence[float]) -> None:
        """Put the whisker's joints at ``q`` [6 + 2N]."""
        joints = range(len(q))
        self.bullet.resetJointStatesMultiDof(self.whisker, joints, [[value] for value in q], [[0.0]] * len(q))

    def place_obstacle(self, number: int, position: NDArray[np.float64], quaternion: NDArray[np.float64]) -> None:
        """Put an obstacle at ``position`` [3] (mm) turned by ``quaternion`` [4] (w, x, y, z)."""
        w, x, y, z = quaternion
        for body in self.parts[number]:
            self.bullet.resetBasePositionAndOrientation(body, position, (x, y, z, w))

    def closest(self, margin: float) -> Iterator[tuple[int, int, NDArray, NDArray, float]]:
        """Yield link, obstacle, point on the whisker [3], normal into the whisker [3] and distance (mm).

        Only pairs nearer than ``margin`` (mm) are found; negative distances are overlaps. Bullet measures from the
        cores of the links; what surrounds a core is everywhere as thick, so it only shifts distance and point.
        """
        # Bullet searches between cores, so the margin is added to the distance that is searched.
        margin += float(self._margins.max())
        for number, bodies in enumerate(self.parts):
            for body, part in zip(bodies, self.obstacles[number].parts, strict=True):
                extra = HULL_MARGIN if isinstance(part, ConvexPart) else 0.0
                points = self.bullet.getClosestPoints(self.whisker, body, distance=margin)
                for point in points:
                    link, normal = (point[3] - FOLLICLE) // 2, np.array(point[7])
                    # Closest points of the cores, moved by the margin along the normal, are those of the thickened
                    # links.
                    around = float(self._margins[link])
                    yield link, number, np.array(point[5]) - around * normal, normal, point[8] + extra - around

    def jacobian(self, link: int, q: Sequence[float]) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """Return a link's start [3], its axis [3], and how joint rates move the start [3, 6 + 2N] and turn the link."""
        joint, zero = self._joint(link), [0.0] * len(q)
        state = self.bullet.getLinkState(self.whisker, joint)
        linear, angular = self.bullet.calculateJacobian(self.whisker, joint, (0.0, 0.0, 0.0), q, zero, zero)
        axis = np.array(self.bullet.getMatrixFromQuaternion(state[5])).reshape(3, 3)[:, 0]
        return np.array(state[4]), axis, np.array(linear), np.array(angular)

    def shape(self) -> NDArray[np.float64]:
        """Return joints and tip [N + 1, 3] (mm) as the whisker was last placed."""
        joints = [self._joint(link) for link in range(self.chain.links)]
        states = self.bullet.getLinkStates(self.whisker, joints, computeForwardKinematics=1)
        axis = np.array(self.bullet.getMatrixFromQuaternion(states[-1][5])).reshape(3, 3)[:, 0]
        points = [np.array(state[4]) for state in states]
        return np.array([*points, points[-1] + axis * self.chain.lengths[-1] * MILLI])

    def _joint(self, link: int) -> int:
        """Return Bullet's number of the second hinge of a link, which carries its mass and its shape."""
        return FOLLICLE + 2 * link + 1

    def _add_whisker(self) -> int:
        bullet, chain = self.bullet, self.chain
        slide, hinge = bullet.JOINT_PRISMATIC, bullet.JOINT_REVOLUTE
        kinds = [slide] * 3 + [hinge] * (3 + 2 * chain.links)
        axes = [(1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, 1), (0, -1, 0), (1, 0, 0)]
        count = len(kinds)
        masses, inertias = [_NOTHING] * count, [(_NOTHING,) * 3] * count
        shapes = [-1] * count
        places, turns, centres = [(0.0, 0.0, 0.0)] * count, [_STILL] * count, [(0.0, 0.0, 0.0)] * count
        for i in range(chain.links):
            first, second = FOLLICLE + 2 * i, self._joint(i)
            axes += [(0, 1, 0), (0, 0, 1)]
            if i:
                places[first] = (chain.lengths[i - 1] * MILLI, 0.0, 0.0)
            # Rest bend about z as a fixed turn before the two hinges, of which only the second carries mass.
            turns[first] = (0.0, 0.0, np.sin(chain.rest_angles[i] / 2), np.cos(chain.rest_angles[i] / 2))
            centres[second] = (chain.centres[i] * MILLI, 0.0, 0.0)
            masses[second] = chain.masses[i] * MICRO
            axial, transverse = chain.inertias[i] * MICRO * MILLI**2
            inertias[second] = (axial, transverse, transverse)
            thickest = float(chain.whisker.radius(chain.nodes[i : i + 2]).max())
            if chain.nodes[i + 1] + thickest >= self.nearest:
                shapes[second] = self._link(i)
        body = bullet.createMultiBody(
            baseMass=0,
            linkMasses=masses,
            linkCollisionShapeIndices=shapes,
            linkVisualShapeIndices=[-1] * count,
            linkPositions=places,
            linkOrientations=turns,
            linkInertialFramePositions=centres,
            linkInertialFrameOrientations=[_STILL] * count,
            linkParentIndices=list(range(count)),
            linkJointTypes=kinds,
            linkJointAxis=axes,
        )
        for joint, inertia in enumerate(inertias):
            # Bullet would derive the inertia from the collision shape.
            bullet.changeDynamics(body, joint, localInertiaDiagonal=inertia)
        return body

    def _link(self, link: int) -> int:
        """Add the collision shape of a link, less its margin: the slim cone inside a tapered link, or a capsule."""
        core, length = self._cores[link], self.chain.lengths[link] * MILLI
        # A capsule keeps its own radius; a cone is built without the thickness that its margin adds.
        if core == 0:
            ends = np.zeros(3), np.array([length, 0, 0])
            return self._segment("CAPSULE", *ends, self.chain.radii[link] * MILLI)
        radii = self.chain.whisker.radius(self.chain.nodes[link : link + 2])
        cone = cone_vertices(core, length, narrows=bool(radii[0] > radii[1]))
        return self._collision("MESH", vertices=cone.tolist())

    def _shape(self, part: Part) -> int:
        match part:
            case Sphere():
                return self._collision("SPHERE", np.multiply(part.centre, MILLI), radius=part.radius * MILLI)
            case Box():
                w, x, y, z = part.quaternion
                centre, halves = np.multiply(part.centre, MILLI), np.multiply(part.half_sizes, MILLI)
                return self._collision("BOX", centre, halfExtents=halves, collisionFrameOrientation=(x, y, z, w))
            case ConvexPart():
                # Without faces Bullet takes the convex hull of the vertices.
                return self._collision("MESH", vertices=(part.vertices * MILLI).tolist())
            case Capsule() | Cylinder():
                ends = np.multiply(part.start, MILLI), np.multiply(part.end, MILLI)
                return self._segment(type(part).__name__.upper(), *ends, part.radius * MILLI)

    def _segment(self, kind: str, start: NDArray, end: NDArray, radius: float) -> int:
        """Add a capsule or a cylinder from ``start`` to ``end`` (mm)."""
        length = float(np.linalg.norm(end - start))
        turn = {"collisionFrameOrientation": np.roll(from_z_axis((end - start) / length), -1)}
        return self._collision(kind, (start + end) / 2, radius=radius, height=length, **turn)

    def _collision(self, kind: str, centre: ArrayLike = (0.0, 0.0, 0.0), **options: Any) -> int:
        """Add a collision shape around ``centre`` (mm)."""
        kind = getattr(self.bullet, f"GEOM_{kind}")
        return self.bullet.createCollisionShape(kind, collisionFramePosition=centre, **options)
