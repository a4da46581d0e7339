"""Whiskers in contact: random scenes, in which settings are compared with a converged simulation, and posts that press.

Of the latter it is hard to tell how they press: from opposite sides, and while a whisker slides along.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from brainbench.core.rotations import base_rotation, euler_matrix, to_matrices
from brainbench.stimuli.motion.jobs import Job, StillFollicle, Trace
from brainbench.stimuli.motion.trajectories import ArrayFollicle, Whisking, smooth_step
from brainbench.stimuli.objects.collections import resolve_objects
from brainbench.stimuli.objects.obstacle import Box, Capsule, ConvexPart, Obstacle, Part, Sphere
from brainbench.stimuli.objects.solid import Solid, box, capsule, rodgers_solid, sphere
from brainbench.stimuli.validation.bench_tests import sliding
from brainbench.stimuli.whiskers.array import SPECIES, MountedWhisker, WhiskerArray

OBJECTS = ("post", "ball", "edge", "hollow")
"""One object on one side of a whisker, which stays in contact until it retracts."""
FLAT_OBJECTS = ("face",)
"""A box whose face lies along the whisker where it touches, so that it lies flush and slides over the edges."""
HARD_OBJECTS = ("opposed", "slot", "comb", "slip-off", "release")
"""Contacts from both sides (two posts, the second farther out; two bars; six posts), a post that the whisker slips past
with its tip, and one that is pulled away from it."""
FRICTIONS = (0.0, 0.4, 0.8)
FREQUENCIES = (5.0, 10.0, 20.0)  # whisks per second [Hz]
_RETRACTION = math.radians(12)
_SIDES = 32  # of a post of triangles
_PULL = 0.01
"""Time in which an object of the kind ``release`` is pulled away [s]."""


def contact_jobs(
    seed: int, *, each: int = 3, objects: Sequence[str] = OBJECTS, hollow: Solid | None = None
) -> list[Job]:
    """Return jobs of one whisker that whisks against one object, ``each`` of every combination, in a random order.

    Whisker, point of contact (.4 to .85 of the length; .9 to .97 to slip off), azimuth of first contact (−3° to 3°; .1°
    to .6° between objects on both sides), depth (4° to 14° beyond it; three times as much to slip off), size and turn
    of the object are drawn. Read every ms. Other seeds are other scenes of the same kinds.

    Args:
        objects: kinds of objects, of :data:`OBJECTS`, :data:`FLAT_OBJECTS` and :data:`HARD_OBJECTS`.
        hollow: another solid of the shape and size of :func:`rodgers_solid`, touched in its place.
    """
    random = np.random.default_rng(seed)
    solid = rodgers_solid() if hollow is None else hollow
    cells = [cell for cell in itertools.product(SPECIES, objects, FRICTIONS, FREQUENCIES) for _ in range(each)]
    arrays = {species: WhiskerArray.of(species) for species in SPECIES}
    jobs = [
        _draw(arrays[species].mounts, kind, friction, frequency, solid, random)
        for species, kind, friction, frequency in cells
    ]
    return [jobs[index] for index in random.permutation(len(jobs))]


def meshed(jobs: list[Job], kind: str) -> list[Job]:
    """Return jobs whose objects are surfaces: posts of 32 sides and balls of 320 triangles, with corners on the round
    ones, boxes of 12; of ``procedural``, shapes of the size of their balls, one after another."""
    solids = itertools.cycle([item.load() for item in resolve_objects(["procedural-24:1"], surfaces=True).values()])
    changed = []
    for job in jobs:
        obstacle = job.obstacles[0]
        if kind == "procedural":
            ball = obstacle.parts[0]
            assert isinstance(ball, Sphere)
            solid = next(solids).to_diagonal(2 * np.sqrt(3) * ball.radius)
            assert solid.surface is not None
            middle = solid.surface.bounds.mean(axis=0)
            obstacle = replace(obstacle, surface=solid.surface.transformed(np.eye(3), np.subtract(ball.centre, middle)))
        elif obstacle.surface is None:
            obstacle = replace(
                obstacle, parts=tuple(ConvexPart(np.array([*_corners(part)])) for part in obstacle.parts)
            )
        changed.append(replace(job, obstacles=(obstacle,)))
    return changed


def difference(trace: Trace, reference: Trace) -> float:
    """Return the larger of the relative errors of base force and moment, root mean square over the readings.

    Infinite where the trace cannot be trusted.
    """
    if trace.status != "ok":
        return math.inf
    gap, whole = (np.sqrt(np.mean(part.reshape(-1, 2, 3) ** 2, axis=(0, 2))) for part in (
        trace.wrench - reference.wrench, reference.wrench
    ))  # fmt: skip
    return float(np.max(gap / whole))


def _draw(
    mounts: tuple[MountedWhisker, ...],
    kind: str,
    friction: float,
    frequency: float,
    hollow: Solid,
    random: np.random.Generator,
) -> Job:
    mount = mounts[random.integers(len(mounts))]
    around, past = kind in ("opposed", "slot", "comb"), kind == "slip-off"
    touch, depth = np.radians(random.uniform((0.1 if around else -3, 4), (0.6 if around else 3, 14)))
    # Whiskers between objects rest there.
    whisking = Whisking(frequency, touch + (3 if past else 1) * depth, 0 if around else _RETRACTION, onset=0.025)
    point, axes = _contact(mount, whisking, touch, random.uniform(*((0.9, 0.97) if past else (0.4, 0.85))))
    scale = mount.whisker.arc_length / 0.02
    if kind in HARD_OBJECTS:
        gap = 2 * (abs(touch) * float(np.linalg.norm(point - mount.position)) + mount.whisker.base_radius)
        parts = _hard_parts(kind, scale, gap, random)
        obstacle = Obstacle(parts, friction=friction).moved(axes, point)
        if kind == "release":
            # Against the whisker's way, near the end of the protraction, when it is bent most.
            start, way = 0.4 / frequency, 0.005 * scale * axes[:, 1]
            motion = sliding(lambda times: np.outer(smooth_step(times - start, _PULL), way))
            motion.finest = _PULL  # type: ignore[attr-defined]
            obstacle = replace(obstacle, motion=motion)
    else:
        solid, turn, place = _object(kind, scale, hollow, random)
        rotation = axes @ turn
        body = Obstacle(solid.parts, friction=friction, surface=solid.surface)
        obstacle = body.moved(rotation, point - rotation @ place)
    duration = max(0.15, 1.5 / frequency)
    return Job(mount.whisker, ArrayFollicle(mount, whisking), (obstacle,), np.arange(1e-3, duration, 1e-3))


def _hard_parts(kind: str, scale: float, gap: float, random: np.random.Generator) -> tuple[Part, ...]:
    """Return parts that touch at the origin of the axes of the contact: the whisker comes along y and lies along x."""
    radius, half, way = 2e-4 * scale * random.uniform(1, 3), 0.015 * scale, scale * random.uniform(0.5e-3, 3e-3)
    ahead, behind = radius, -radius - gap
    if kind == "slot":
        return tuple(Box((0.0, y, 0.0), (way, radius, half)) for y in (ahead, behind))
    places = [(0.0, ahead)]
    if kind == "opposed":
        places.append((way, behind))
    elif kind == "comb":
        places = [(x * way, y) for x in (-1, 0, 1) for y in (ahead, behind)]
    return tuple(Capsule((x, y, -half), (x, y, half), radius) for x, y in places)


def _contact(
    mount: MountedWhisker, whisking: Whisking, azimuth: float, fraction: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the point [3] (m) of a whisker turned by an azimuth (rad), and axes there as columns of [3, 3].

    y is where the point moves, z crosses whisker and motion.
    """
    rates = np.array(whisking.rotations.rates(mount))
    arc = fraction * mount.whisker.arc_length + np.array([0.0, 1e-5])
    line = np.column_stack([mount.whisker.centre_line(arc), np.zeros(2)])
    before, now = (
        mount.position + line @ base_rotation(mount.angles + turn * rates).T for turn in (azimuth - 1e-4, azimuth)
    )
    tangent, motion = now[1] - now[0], now[0] - before[0]
    across = np.cross(tangent, motion)
    across /= np.linalg.norm(across)
    ahead = np.cross(across, tangent / np.linalg.norm(tangent))
    # The surface touches the whisker's surface, not its centre line.
    return now[0] + mount.whisker.radius(arc[0]) * ahead, np.column_stack([np.cross(ahead, across), ahead, across])


def _object(
    kind: str, scale: float, hollow: Solid, random: np.random.Generator
) -> tuple[Solid, NDArray[np.float64], NDArray[np.float64]]:
    """Return a solid, its turn in the axes of the contact [3, 3], and which point of it touches [3] (m)."""
    size = scale * random.uniform(1, 2)
    roll = random.uniform(-0.4, 0.4)
    turn = euler_matrix((0.0, roll, 0.0))
    if kind == "post":
        return capsule(4e-4 * size, 0.03 * scale), turn, np.array([0.0, -4e-4 * size, 0.0])
    if kind == "ball":
        return sphere(2e-3 * size), np.eye(3), np.array([0.0, -2e-3 * size, 0.0])
    if kind == "edge":
        # The edge at −x, −y looks backwards once the box is turned by 45° about z.
        width = 6e-3 * size
        turn = turn @ euler_matrix((0.0, 0.0, math.pi / 4))
        return box((width, width, 0.03 * scale)), turn, np.array([-width / 2, -width / 2, 0.0])
    if kind == "face":
        width = 6e-3 * size
        return box((width, width, 0.03 * scale)), turn, width / 2 * np.array([random.uniform(-0.8, 0.8), -1.0, 0.0])
    # The trough lies along the whisker: its axis z becomes the contact's −x.
    factor = 0.36 * size
    turn = euler_matrix((0.0, roll - math.pi / 2, 0.0))
    # A point of the hollow face, a fraction of the way along its curve.
    along = round(random.uniform(0.35, 0.65) * (len(_faces()) - 1))
    return hollow.scaled(factor), turn, factor * _faces()[along, 2:].mean(axis=0)


@cache
def _faces() -> NDArray[np.float64]:
    """Corners [ring, 4, 3] (m) of the Rodgers solid: convex low, convex high, concave high, concave low."""
    mesh = rodgers_solid().mesh
    assert mesh is not None
    return mesh.vertices.reshape(-1, 4, 3)


def _corners(part: Part) -> Iterator[NDArray[np.float64]]:
    """Return the corners of the polyhedron that stands for a part."""
    from trimesh import creation

    if isinstance(part, Sphere):
        yield from np.asarray(part.centre) + part.radius * creation.icosphere(subdivisions=2).vertices
    elif isinstance(part, Capsule):
        along = np.subtract(part.end, part.start)
        along /= np.linalg.norm(along)
        across = np.cross(along, np.eye(3)[np.argmin(np.abs(along))])
        across /= np.linalg.norm(across)
        turns = np.arange(_SIDES)[:, None] * 2 * np.pi / _SIDES
        ring = part.radius * (np.cos(turns) * across + np.sin(turns) * np.cross(along, across))
        yield from np.concatenate([part.start + ring, part.end + ring])
    else:
        assert isinstance(part, Box)
        signs = np.array(list(itertools.product((-1, 1), repeat=3)))
        yield from np.asarray(part.centre) + (signs * part.half_sizes) @ to_matrices(part.quaternion).T


STRAIGHT = replace(WhiskerArray.of("rat")["C2"].whisker, curvature=0.0, friction=0.0)


def held_job(
    *,
    radius: float = 1e-4,
    apart: float = 2e-3,
    turn: float = 0.3,
    shape: Part | None = None,
    about_x: float = 0.0,
    friction: float = 0.0,
    frames: int = 100,
) -> Job:
    """Return the job of a whisker between two posts on opposite sides of its middle, which turn together in 40 ms."""
    middle = STRAIGHT.arc_length / 2
    away = float(STRAIGHT.radius(middle)) + 5e-5 + radius

    def post(side: int) -> Obstacle:
        def motion(times: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
            angle = turn * smooth_step(times, 0.04)
            x, y = side * apart / 2, -side * away
            place = np.stack([middle + np.cos(angle) * x - np.sin(angle) * y, np.sin(angle) * x + np.cos(angle) * y])
            tilt = Rotation.from_rotvec([about_x, 0, 0])
            turned = (tilt * Rotation.from_rotvec(np.outer(angle, [0, 0, 1]))).as_quat()
            return tilt.apply(np.pad(place.T, ((0, 0), (0, 1)))), np.roll(turned, 1, axis=-1)

        motion.finest = 0.04  # type: ignore[attr-defined]
        return Obstacle((shape or Capsule((0, 0, -4e-3), (0, 0, 4e-3), radius),), motion, friction)

    return Job(STRAIGHT, StillFollicle(), (post(-1), post(1)), np.linspace(1e-3, frames * 1e-3, frames))


def sliding_job(*, friction: float = 0.0, frames: int = 460) -> Job:
    """Return the job of a whisker along which a post slides at constant depth, from 60 ms to 460 ms."""
    length, radius = STRAIGHT.arc_length, 3e-4

    def motion(times: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        times = np.asarray(times, float)
        risen = smooth_step(times, 0.06)
        x = (0.45 + 0.3 * np.clip((times - 0.06) / 0.4, 0, 1)) * length
        low = -(radius + STRAIGHT.base_radius + 1e-4)
        return np.stack([x, low * (1 - risen) + 0.1 * length * risen, 0 * x], -1), np.tile([1.0, 0, 0, 0], (len(x), 1))

    motion.finest = 0.06  # type: ignore[attr-defined]
    post = Obstacle((Capsule((0, 0, -4e-3), (0, 0, 4e-3), radius),), motion, friction)
    return Job(STRAIGHT, StillFollicle(), (post,), np.linspace(1e-3, frames * 1e-3, frames))
