"""PyBullet as a whisker engine: the lineage of WHISKiT, and an independent check of ``mujoco``.

Bullet holds the whisker as a Featherstone multi-body and the obstacles as its convex shapes; it provides
kinematics, joint-space inertia M, inverse dynamics and closest points. Its own time step, which takes spring torques as
constant, is not used (benchmarks/RESULTS.md says what it makes of a whisker). Instead each step solves springs, dampers
and contacts together in M + h d + h² k, the linearly implicit step:

    (M + h D + h² K) v⁺ = M v − h (c + K q) + h Jᵀ f,    q⁺ = q + h v⁺,

with c the forces of inverse dynamics for the prescribed motion of the follicle, and f the contact forces that leave
every gap at the end of the step ≥ 0 and obey Coulomb's law. The step damps, so the first mode comes out slow as in
``mujoco``; a tip that flicks further than its thickness in one step may overlap an obstacle for that step.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.errors import MissingDependencyError, UsageError, install_command, missing_dependency
from brainbench.core.rotations import base_rotation, from_z_axis, to_matrices
from brainbench.stimuli.engines.stepping import LEAST_TAPER, SteppedEngine, SteppedJob, cone_vertices, drive_scalars
from brainbench.stimuli.engines.trust import state_fault
from brainbench.stimuli.motion.jobs import MICRO, MILLI, Trace
from brainbench.stimuli.objects.obstacle import Box, Capsule, ConvexPart, Cylinder, Obstacle, Part, Sphere
from brainbench.stimuli.whiskers.whisker import Chain

FOLLICLE = 6  # joints of the follicle, which come first
MOST_LINKS = 60  # links per whisker: PyBullet moves fewer than 128 degrees of freedom through its interface
HULL_MARGIN = 1e-3  # margin (mm) that PyBullet wraps around convex hulls; subtracted again from the distances

_NOTHING = 1e-12  # mass (mg) and inertia (mg·mm²) of carriers between joints: far below those of any tip
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


MOST_SWEEPS = 3000  # gauss–Seidel sweeps over the contacts of one step before they count as unsolved
SWEEPS = 12
"""Sweeps between two attempts to finish by Newton's method, which needs to know what touches and what slides."""
MOST_ITERATIONS = 12  # Newton iterations of one attempt
TOLERANCE = 1e-9  # relative change of the forces in one sweep at which they count as solved


# Contacts of one step with Coulomb friction are solved together with the implicit springs. Rows of a contact are its
# normal and two tangents; m contact.
def contact_axes(normal: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return rows [3, 3]: the unit ``normal`` and two tangents that complete a right-handed frame.

    After Duff et al. (2017), Building an orthonormal basis, revisited.
    """
    x, y, z = normal.tolist()
    sign = math.copysign(1.0, z)
    a = -1.0 / (sign + z)
    b = x * y * a
    return np.array([[x, y, z], [1 + sign * x * x * a, sign * b, -sign * x], [b, sign + y * y * a, -y]])


def cross_matrix(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the matrix [3, 3] that, applied to u, gives u × ``vector``."""
    x, y, z = vector.tolist()
    return np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])


def solve_contacts(
    yielding: NDArray[np.float64], free: NDArray[np.float64], friction: NDArray[np.float64]
) -> tuple[NDArray[np.float64], bool]:
    """Find the forces [3m] that keep gaps open and obey Coulomb's law, and whether they were found.

    At the end of the step row r has moved to ``free[r] + yielding[r] · f``, with the symmetric ``yielding`` [3m, 3m]. A
    normal row is a gap: it stays ≥ 0, its force is ≥ 0 and acts only at 0. Tangent rows are slips: they are 0 while the
    tangential force is at most ``friction`` [m] times the normal one, which otherwise opposes the slip.
    """
    force = np.zeros(len(free))
    for _ in range(MOST_SWEEPS // SWEEPS):
        if _sweep(yielding, free, friction, force):
            return force, True
        finished = _finish(yielding, free, friction, force)
        if finished is not None:
            return finished, True
    return force, False


def _sweep(yielding: NDArray, free: NDArray, friction: NDArray, force: NDArray) -> bool:
    """Improve ``force`` in place, one contact after the other; return whether it is solved."""
    moved = free + yielding @ force
    for _ in range(SWEEPS):
        change = 0.0
        for contact, limit in enumerate(friction.tolist()):
            n = 3 * contact
            # At the base point a force has no lever and moves nothing.
            if not yielding[n, n]:
                continue
            # Exact solution of the one normal row, held at a force of zero: one step of projected Gauss–Seidel.
            step = max(-force[n], -moved[n] / yielding[n, n])
            if step:
                force[n] += step
                moved += yielding[:, n] * step
                change = max(change, abs(step))
            if not limit:
                continue
            tangents = slice(n + 1, n + 3)
            # Both tangents together, within the disc of Coulomb's law for the present normal force.
            block = yielding[tangents, tangents]
            pair = hold_or_slide(block, moved[tangents] - block @ force[tangents], limit * force[n])
            difference = pair - force[tangents]
            if difference.any():
                force[tangents] = pair
                moved += yielding[:, tangents] @ difference
                change = max(change, float(np.abs(difference).max()))
        if change <= TOLERANCE * np.abs(force).max():
            return True
    return False


def _finish(yielding: NDArray, free: NDArray, friction: NDArray, start: NDArray) -> NDArray[np.float64] | None:
    """Solve by a semi-smooth Newton method from ``start``; None when it does not converge.

    The unknown zero is f − P(f − w/ρ), P being the projection on Coulomb's cone taken row by row (Alart and
    Curnier 1991), written as w = 0 where a contact holds and as the law of its force elsewhere.
    """
    force, scale = start.copy(), 1 / yielding.diagonal()
    for _ in range(MOST_ITERATIONS):
        moved = free + yielding @ force
        residual, slope = force.copy(), np.eye(len(force))
        missed = 0.0
        for contact, limit in enumerate(friction.tolist()):
            n, tangents = 3 * contact, slice(3 * contact + 1, 3 * contact + 3)
            # Sign of f − w/ρ tells which branch of the projection holds: open, sticking or sliding. Rows of an open
            # contact stay as the identity, which sets its force to zero.
            pressed = force[n] - scale[n] * moved[n]
            missed = max(missed, abs(force[n] - max(pressed, 0.0)))
            if pressed <= 0:
                missed = max(missed, float(np.abs(force[tangents]).max()))
                continue
            residual[n], slope[n] = moved[n], yielding[n]
            if not limit:
                continue
            rate = float(scale[tangents].min())
            pushed = force[tangents] - rate * moved[tangents]
            size, most = float(np.hypot(*pushed)), limit * max(force[n], 0.0)
            if size <= most:
                residual[tangents], slope[tangents] = moved[tangents], yielding[tangents]
                missed = max(missed, rate * float(np.abs(moved[tangents]).max()))
                continue
            way = pushed / size
            residual[tangents] = force[tangents] - most * way
            missed = max(missed, float(np.abs(residual[tangents]).max()))
            # Derivative of the projection on the disc: turning with the slip, growing with the normal force.
            across = most / size * (np.eye(2) - np.outer(way, way))
            slope[tangents] += rate * across @ yielding[tangents]
            slope[tangents, tangents] -= across
            slope[tangents, n] -= limit * way
        if missed <= TOLERANCE * np.abs(force).max():
            rows = force.reshape(-1, 3)
            rows[rows[:, 0] <= 0] = 0.0
            return force
        try:
            force -= np.linalg.solve(slope, residual)
        except np.linalg.LinAlgError:
            return None
        if not np.isfinite(force).all():
            return None
    return None


def hold_or_slide(yielding: NDArray[np.float64], slip: NDArray[np.float64], most: float) -> NDArray[np.float64]:
    """Return the tangential force [2] of at most ``most`` that stops the slip, or that opposes what slip remains.

    It minimises ½ f·Y f + s·f over the disc of radius ``most``, Y [2, 2] being the ``yielding`` and s [2] the
    ``slip`` without force. A whisker yields a thousand times less along itself than across, so both
    directions are solved at once.
    """
    if not most:
        return np.zeros(2)
    (a, b), (_, c) = yielding.tolist()
    # Axes of the 2 × 2 matrix: there the law for a multiplier λ reads f = −s / (Y + λ), one scalar equation for |f| =
    # most.
    turn = 0.5 * math.atan2(2 * b, a - c)
    cosine, sine = math.cos(turn), math.sin(turn)
    middle, half = (a + c) / 2, math.hypot((a - c) / 2, b)
    stiff = (middle + half, max(middle - half, 1e-15 * middle))
    s = (cosine * slip[0] + sine * slip[1], cosine * slip[1] - sine * slip[0])
    shift = 0.0
    # Newton's method on 1/|f(shift)| = 1/most rises to the root from below and never passes it.
    for _ in range(60):
        f = [-s[0] / (stiff[0] + shift), -s[1] / (stiff[1] + shift)]
        size = math.hypot(*f)
        if size <= most * (1 + 1e-14):
            break
        slope = f[0] ** 2 / (stiff[0] + shift) + f[1] ** 2 / (stiff[1] + shift)
        shift += (size / most - 1) * size**2 / slope
    return np.array([cosine * f[0] - sine * f[1], sine * f[0] + cosine * f[1]])


SEARCH = 0.02  # distance (mm), beside the way that the whisker may move in the step, within which contacts are sought


@dataclass(frozen=True)
class BulletEngine(SteppedEngine):
    """Runs whisker jobs, of at most 60 links, in PyBullet one after the other: it holds Python's interpreter lock."""

    name = "bullet"
    package = "pybullet"

    def threads(self, workers: int | None) -> int:
        """Return one, however many workers there are."""
        return 1

    def session(self) -> AbstractContextManager[None]:
        """See :meth:`SteppedEngine.session`."""
        return nullcontext(engine())

    def simulate(self, stepped: SteppedJob) -> Trace:
        """See :meth:`SteppedEngine.simulate`."""
        gravity = np.asarray(stepped.job.gravity, float)
        shape = stepped.frames(len(stepped.times)).nearest.tolist() if stepped.record_shape else []
        with BulletWorld(stepped.chain, stepped.reach.obstacles, stepped.reach.nearest, gravity) as world:
            run = _Run(stepped, world, frozenset(shape))
            run.integrate()
        failed, reason = stepped.end(run.failed, run.reason)
        frames = stepped.frames(failed)
        nearest = frames.nearest
        return stepped.trace(
            frames,
            frames.interpolate(lambda steps: run.wrench[steps]),
            np.isfinite(run.arc[nearest]),
            run.arc[nearest],
            np.stack([run.shapes[step] for step in nearest.tolist()]) / MILLI if stepped.record_shape else np.zeros(0),
            penetration=run.penetration / MILLI,
            reason=reason,
            steps=min(failed, run.steps),
        )


@dataclass(frozen=True, eq=False)
class _Rows:
    """Possible contacts of one step; lengths in mm, world axes."""

    axes: NDArray[np.float64]  # [m, 3, 3] normal into the whisker and two tangents
    jacobian: NDArray[np.float64]  # [3m, 6 + 2N] displacement along the axes per joint displacement
    free: NDArray[np.float64]
    """[3m] gap, and slip by the prescribed motion alone, at the end of the step with the hinges where they are."""
    friction: NDArray[np.float64]  # [m]
    arc: NDArray[np.float64]  # [m] arc length of the point on the whisker (m)
    overlap: float  # deepest overlap at the start of the step


class _Run:
    """State and results of one whisker; mm, ms, mg inside."""

    def __init__(self, stepped: SteppedJob, world: BulletWorld, shapes_at: frozenset[int]) -> None:
        job, chain, reach, times = stepped.job, stepped.chain, stepped.reach, stepped.times
        self.chain, self.world, self.times, self.loads = chain, world, times, job.loads
        self.step = float(times[1] - times[0]) * MILLI
        self.steps = len(times) - 1
        self.stiffness = np.repeat(chain.stiffness, 2) * MICRO
        self.damping = np.repeat(chain.damping(self.step / MILLI), 2) * MICRO * MILLI
        position, euler = stepped.pose
        path = np.concatenate([position * MILLI, euler + np.array([-np.pi / 2, 0.0, np.pi / 2])], axis=1)
        self.path, self.drive = path, drive_scalars(path, self.step)
        self.frames = base_rotation(euler)
        still = np.zeros((len(times), 3)), np.tile([1.0, 0, 0, 0], (len(times), 1))
        poses = [still if item.motion is None else item.motion(times) for item in reach.obstacles]
        self.poses = [(np.asarray(where, dtype=float) * MILLI, np.asarray(turn, dtype=float)) for where, turn in poses]
        self.turns = [to_matrices(turn) for _, turn in self.poses]
        self.travels = [item.motion is not None for item in reach.obstacles]
        self.friction = np.array([item.friction_beside(job.whisker.friction) for item in reach.obstacles])
        self.hinges, self.rates = np.zeros(2 * chain.links), np.zeros(2 * chain.links)
        self.wrench = np.zeros((self.steps, 6))
        self.arc = np.full(self.steps, np.nan)
        self.penetration = 0.0
        self.failed, self.reason = self.steps, ""
        # From there on nothing is used, and contact at the base point has no lever.
        self.last = stepped.overlap[0]
        self.shapes: dict[int, NDArray] = {}
        self._shapes_at = shapes_at
        self._beyond = (chain.whisker.arc_length - np.repeat(chain.nodes[:-1], 2)) * MILLI

    def integrate(self) -> None:
        """Compute all steps, fewer when the state stops making sense; then ``reason`` says why."""
        for n in range(self.steps):
            if n in self._shapes_at or not n:
                self.world.place([*self.path[n], *self.hinges])
                self.shapes[n] = self.world.shape()
            if n == self.last:
                return
            problem = self._advance(n)
            if problem:
                self.failed, self.reason = n, f"at {self.times[n]:.6g} s {problem}"
                return

    def _advance(self, n: int) -> str:
        """Compute step n; return what went wrong, empty when all went well."""
        h, world = self.step, self.world
        q = [*self.path[n], *self.hinges]
        rates = [*self.drive.velocity[n], *self.rates]
        # Without contacts, gravity included.
        accelerations = [*self.drive.acceleration[n], *([0.0] * len(self.rates))]
        forces = np.array(world.bullet.calculateInverseDynamics(world.whisker, q, rates, accelerations))
        mass = world.mass_matrix(q)
        # (M + h D + h² K) v⁺ = M v − h (c + K q): springs and dampers at the end of the step, inertia and bias at its
        # start. The follicle's rows are left out since its motion is prescribed.
        hinged = mass[FOLLICLE:, FOLLICLE:]
        system = hinged + np.diag(h * self.damping + h * h * self.stiffness)
        forces = forces - self._loads(n, q)
        impulse = hinged @ self.rates - h * (forces[FOLLICLE:] + self.stiffness * self.hinges)
        solved = True
        rows = self._rows(n, h * _solve(system, impulse)) if world.parts else None
        if rows is None:
            after = _solve(system, impulse)
        else:
            # One factorisation serves the free motion and the compliance of every contact row.
            both = _solve(system, np.column_stack([impulse, rows.jacobian[:, FOLLICLE:].T]))
            after, yielding = both[:, 0], h * both[:, 1:]
            to_rows = rows.jacobian[:, FOLLICLE:] * h
            force, solved = solve_contacts(to_rows @ yielding, rows.free + to_rows @ after, rows.friction)
            after = after + yielding @ force
            forces = forces - rows.jacobian.T @ force
            strength = np.linalg.norm(force.reshape(-1, 3), axis=1)
            if strength.any():
                self.arc[n] = float(strength @ rows.arc / strength.sum())
            self.penetration = max(self.penetration, rows.overlap)
        # Reaction of the prescribed joints: inverse dynamics was taken with hinges that do not accelerate, so the
        # coupling inertia times their acceleration is added.
        follicle = forces[:FOLLICLE] + mass[:FOLLICLE, FOLLICLE:] @ ((after - self.rates) / h)
        # Moment of the first two springs and dampers at the end of the step, as the implicit step applied it.
        moments = -(self.stiffness[:2] * (self.hinges[:2] + h * after[:2]) + self.damping[:2] * after[:2])
        self.wrench[n] = self._action(n, follicle, moments)
        self.hinges, self.rates = self.hinges + h * after, after
        if not solved:
            return "the contact forces could not be solved; choose a smaller time step"
        return state_fault(self.hinges, self.wrench[n], self.chain.whisker)

    def _loads(self, n: int, q: list[float]) -> NDArray[np.float64]:
        """Return the joint forces [6 + 2N] of the loads of the job at step n."""
        total = np.zeros(len(q))
        for load in self.loads:
            if self.times[n] >= load.stop:
                continue
            link, share = self.chain.locate(load.arc)
            self.world.place(q)
            _, axis, linear, angular = self.world.jacobian(link, q)
            # Jᵀ F with J the velocity of the loaded point: that of the link's start plus ω × arm.
            arm = share * self.chain.lengths[link] * MILLI * axis
            total += (linear + cross_matrix(arm) @ angular).T @ np.multiply(load.force, MILLI)
        return total

    def _rows(self, n: int, moved: NDArray) -> _Rows | None:
        """Find what may touch in step n, in which the hinges would turn by ``moved`` without contact."""
        world = self.world
        # With follicle and obstacles where the step ends, a gap says what the hinges still have to do.
        q = [*self.path[n + 1], *self.hinges]
        world.place(q)
        for number, (where, turn) in enumerate(self.poses):
            if self.travels[number] or not n:
                world.place_obstacle(number, where[n + 1], turn[n + 1])
        # Farthest that any point can move: each hinge's turn times the length of whisker beyond it.
        margin = SEARCH + float(np.abs(moved) @ self._beyond)
        if not math.isfinite(margin):
            return None
        rows = list(world.closest(margin))
        if not rows:
            return None
        axes, jacobian, gaps, arcs, overlap = [], [], [], [], 0.0
        bodies = {link: world.jacobian(link, q) for link in {item[0] for item in rows}}
        for link, number, point, normal, distance in rows:
            start, axis, linear, angular = bodies[link]
            frame = contact_axes(normal)
            arm = point - start
            axes.append(frame)
            jacobian.append(frame @ (linear + cross_matrix(arm) @ angular))
            # Way of the follicle less the way of the obstacle at the point: what friction feels while the hinges rest.
            carried = _way(n, self.path[:, :3], self.frames, point)
            pushed = _way(n, self.poses[number][0], self.turns[number], point - distance * normal)
            slip = frame @ (carried - pushed)
            gaps.append([distance, slip[1], slip[2]])
            overlap = max(overlap, slip[0] - distance)
            share = np.clip(axis @ arm, 0, self.chain.lengths[link] * MILLI)
            low, high = self.chain.nodes[link], self.chain.nodes[link + 1]
            arcs.append(low + share / (self.chain.lengths[link] * MILLI) * (high - low))
        return _Rows(
            np.array(axes),
            np.concatenate(jacobian),
            np.concatenate(gaps),
            self.friction[[item[1] for item in rows]],
            np.array(arcs),
            overlap,
        )

    def _action(self, n: int, follicle: NDArray, moments: NDArray) -> NDArray[np.float64]:
        """Return the whisker's action on its base [6] (N, N·m) from the reactions of follicle and first two hinges."""
        base = self.frames[n]
        rest, first = self.chain.rest_angles[0], self.hinges[0]
        bent = base @ np.array(
            [
                [-math.sin(rest), math.cos(rest) * math.sin(first)],
                [math.cos(rest), math.sin(rest) * math.sin(first)],
                [0.0, math.cos(first)],
            ]
        )
        # Moments are known about three axes through the base point: the whisker's own, which only the last
        # joint of the follicle holds, and those of the first two hinges.
        axes = np.stack([base[:, 0], bent[:, 0], bent[:, 1]])
        moment = np.linalg.solve(axes, [follicle[5], *moments])
        return -np.concatenate([follicle[:3] / MILLI, moment / MICRO])


def _way(n: int, where: NDArray, turns: NDArray, point: NDArray) -> NDArray[np.float64]:
    """Return the way [3] in step n of a point, given at its end, that goes with a frame (``where``, ``turns``)."""
    return point - where[n] - turns[n] @ (turns[n + 1].T @ (point - where[n + 1]))


def _solve(system: NDArray, right: NDArray) -> NDArray[np.float64]:
    """Solve a symmetric positive definite system; NaN where it is not."""
    # Without the checks of scipy's own functions, which would cost more than the solution.
    lapack = import_module("scipy.linalg.lapack")
    factor, failed = lapack.dpotrf(system, lower=1)
    return np.full_like(right, np.nan) if failed else lapack.dpotrs(factor, right, lower=1)[0]
