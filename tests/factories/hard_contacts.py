"""Random contacts that single ones do not stand for: opposed posts, slots, combs, slips past the tip, meshes."""

import itertools
import math
from dataclasses import replace

import numpy as np

from brainbench.geometry import Mesh
from brainbench.stimuli import WhiskerArray
from brainbench.stimuli.motion.jobs import Job
from brainbench.stimuli.motion.trajectories import ArrayFollicle, Whisking
from brainbench.stimuli.objects.obstacle import Box, Capsule, Obstacle
from brainbench.stimuli.validation import bench_tests

HARD = ("opposed", "slot", "comb", "tip", "mesh", "post")


def hard_jobs(seed, kinds=HARD):
    """Jobs of whiskers that whisk against objects of these kinds, one of each species, friction and frequency."""
    random = np.random.default_rng(seed)
    cells = itertools.product(bench_tests.SPECIES, kinds, bench_tests.FRICTIONS, bench_tests.FREQUENCIES)
    jobs = [_job(*cell, random) for cell in cells]
    return [jobs[index] for index in random.permutation(len(jobs))]


def _job(species, kind, friction, frequency, random):
    mounts = WhiskerArray.of(species).mounts
    mount = mounts[random.integers(len(mounts))]
    # Whiskers rest between what stands on both sides of them.
    around = kind in ("opposed", "slot", "comb")
    touch, depth = np.radians(random.uniform((0.3 if around else -3, 4), (2 if around else 3, 14)))
    whisking = Whisking(frequency, touch + depth * (2 if kind == "tip" else 1), math.radians(12), onset=0.025)
    share = random.uniform(*((0.8, 0.95) if kind == "tip" else (0.4, 0.85)))
    point, axes = bench_tests._contact(mount, whisking, touch, share)
    gap = 2 * abs(touch) * float(np.linalg.norm(point - mount.position))
    body = _body(kind, mount.whisker.arc_length / 0.02, gap, random)
    duration = max(0.15, 1.5 / frequency)
    obstacle = replace(body, friction=friction).moved(axes, point)
    return Job(mount.whisker, ArrayFollicle(mount, whisking), (obstacle,), np.arange(1e-3, duration, 1e-3))


def _body(kind, scale, gap, random):
    """An object that touches at the origin; whiskers come along y and lie along x."""
    radius, half, way = 2e-4 * scale * random.uniform(1, 3), 0.015 * scale, scale * random.uniform(0.5e-3, 3e-3)
    if kind == "mesh":
        import trimesh

        ball = trimesh.creation.icosphere(subdivisions=3, radius=10 * radius)
        return Obstacle((), surface=Mesh(ball.vertices + np.array([0, 10 * radius, 0]), ball.faces.astype(np.int32)))

    def post(x, y):
        return Capsule((x, y, -half), (x, y, half), radius)

    if kind in ("tip", "post"):
        return Obstacle((post(0, radius),))
    if kind == "opposed":
        return Obstacle((post(0, radius), post(float(random.choice([-1, 1])) * way, -radius - gap)))
    if kind == "comb":
        return Obstacle(tuple(post(x * way, y) for x in (-1, 0, 1) for y in (radius, -radius - gap)))
    sizes = (way, radius, half)
    return Obstacle((Box((0, radius, 0), sizes), Box((0, -radius - gap, 0), sizes)))
