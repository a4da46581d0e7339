"""Whiskers whose contacts touch the bent rod, beside the same on straight links, in scenes no table was measured on.

``python -m benchmarks.whiskers.contact_line [--seeds 11,12] [--meshes] [--write]``

The truth has 50 links, 20 µs, contact forces solved to 1e-6, and contacts on the rod; whiskers for which straight links
differ from it by more than 5 % there do not converge and are left out, counted. With ``--meshes`` the objects are
surfaces: posts of 32 sides and balls of 320 triangles in place of round ones, boxes of 12 triangles, the hollow solid,
and procedural shapes of the size of the balls.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from benchmarks.report import publish, script_parser, table
from brainbench.core.rotations import to_matrices
from brainbench.core.statistics import wilson_interval
from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.motion.jobs import Job
from brainbench.stimuli.objects.collections import resolve_objects
from brainbench.stimuli.objects.obstacle import Box, Capsule, ConvexPart, Part, Sphere
from tests.factories.contact_scenes import HARD_OBJECTS, contact_jobs, difference

TRUTH = "accurate,links=50,time_step=2e-5,steps_per_period=400,contact_tolerance=1e-6"
LINES = "links", "rod"
KINDS = ("post", "ball", "edge", *HARD_OBJECTS)
MESHES = ("post", "ball", "edge", "hollow", *HARD_OBJECTS, "procedural")
SIDES = 32


def meshed(jobs: list[Job], kind: str) -> list[Job]:
    """Return jobs whose objects are surfaces; of ``procedural``, shapes of the size of their balls, one after another.

    Corners lie on the round surface.
    """
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
            obstacle = replace(obstacle, parts=tuple(ConvexPart(np.array([*corners(part)])) for part in obstacle.parts))
        changed.append(replace(job, obstacles=(obstacle,)))
    return changed


def corners(part: Part) -> Iterator[np.ndarray]:
    """Return the corners of the polyhedron that stands for a part."""
    from trimesh import creation

    if isinstance(part, Sphere):
        yield from np.asarray(part.centre) + part.radius * creation.icosphere(subdivisions=2).vertices
    elif isinstance(part, Capsule):
        along = np.subtract(part.end, part.start)
        along /= np.linalg.norm(along)
        across = np.cross(along, np.eye(3)[np.argmin(np.abs(along))])
        across /= np.linalg.norm(across)
        turns = np.arange(SIDES)[:, None] * 2 * np.pi / SIDES
        ring = part.radius * (np.cos(turns) * across + np.sin(turns) * np.cross(along, across))
        yield from np.concatenate([part.start + ring, part.end + ring])
    else:
        assert isinstance(part, Box)
        signs = np.array(list(itertools.product((-1, 1), repeat=3)))
        yield from np.asarray(part.centre) + (signs * part.half_sizes) @ to_matrices(part.quaternion).T


def main() -> None:
    parser = script_parser(__doc__)
    parser.add_argument("--seeds", default="11,12")
    parser.add_argument("--meshes", action="store_true")
    options = parser.parse_args()
    engine, rows = get_engine("rod"), []
    for kind in MESHES if options.meshes else KINDS:
        drawn = ("ball" if kind == "procedural" else kind,)
        jobs = [job for seed in options.seeds.split(",") for job in contact_jobs(int(seed), each=1, objects=drawn)]
        if options.meshes:
            jobs = meshed(jobs, kind)
        truth, straight = (
            engine.run(jobs, Fidelity.parse(f"{TRUTH},contact_line={line}")) for line in ("rod", "links")
        )
        sound = [a.status == b.status == "ok" and difference(b, a) < 0.05 for a, b in zip(truth, straight, strict=True)]
        for preset in ("fast", "balanced", "accurate"):
            errors, spent = [], []
            for line in LINES:
                fidelity = Fidelity.parse(f"{preset},contact_line={line}")
                engine.run(jobs[:1], fidelity)
                start = time.process_time()
                traces = engine.run(jobs, fidelity)
                spent.append(time.process_time() - start)
                errors.append([difference(*pair) for pair, kept in zip(zip(traces, truth), sound) if kept])  # noqa: B905
            nearer = int(np.sum(np.less(errors[1], errors[0])))
            interval = wilson_interval(nearer, len(errors[0]))
            quantiles = (f"{np.median(some):.1%}, {np.quantile(some, 0.9):.1%}" for some in errors)
            share = f"{nearer}/{len(errors[0])} [{interval.low:.0%}, {interval.high:.0%}]"
            rows.append([kind, f"`{preset}`", f"{len(errors[0])}", *quantiles, share, f"{spent[1] / spent[0]:.2f}"])
        print(rows[-3:], f"{len(jobs) - sum(sound)} left out", flush=True)
    head = ["objects", "preset", "whiskers", "straight links: median, 90 %", "bent rod", "nearer [95 %]", "time"]
    title = "Contacts on the bent rod, in random scenes" + " of meshes" * options.meshes
    publish(options, title, table(head, rows), f"--seeds {options.seeds}" + " --meshes" * options.meshes)


if __name__ == "__main__":
    main()
