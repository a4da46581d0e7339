"""Small grids of quick sweeps, with which the machinery around the physics is tested."""

from __future__ import annotations

import atexit
import dataclasses
import functools
import math
import shutil
import tempfile
from pathlib import Path

from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.objects.collections import resolve_objects
from brainbench.stimuli.scenes.scene import Frames
from brainbench.stimuli.sweeps.generation import generate
from brainbench.stimuli.sweeps.plan import GenerationPlan, GenerationSettings
from brainbench.stimuli.sweeps.sweep_scenes import GRIDS, SweepGrid

GRID = dataclasses.replace(
    GRIDS["thesis-low"],
    speed=(0.060,),
    height=(-0.002, 0.0),
    rotation=(0.0, math.pi / 4),
    distance=(0.005,),
    start=-0.001,
    frames=Frames(count=10, interval=0.01),
    published="",
)
"""Four sweeps of .1 s per object, which C2 and C3 feel; from ``start`` = −2 mm C3 would begin inside the brick."""


class _Smooth(SweepGrid):
    """The same past objects without friction, which soft contacts would lose."""

    def scene(self, *args, **options):
        scene = super().scene(*args, **options)
        return dataclasses.replace(
            scene, objects=tuple(dataclasses.replace(item, friction=0.0) for item in scene.objects)
        )


def small_plan(objects=("brick:2", "cone:2"), *, whiskers="C3", grid=GRID, fidelity=None, **settings):
    found = resolve_objects(objects, collision="hull")
    # An engine that takes sweeps as any other scenes, and refuses none of these.
    chosen = GenerationSettings(fidelity or Fidelity.preset("fast"), **{"backend": "mujoco", **settings})
    if chosen.backend == "mujoco":
        grid = _Smooth(**{item.name: getattr(grid, item.name) for item in dataclasses.fields(grid) if item.init})
    return GenerationPlan("small", grid, found, chosen, whiskers)


def forty_sweeps():
    """The plan of :func:`small_set`."""
    return small_plan(("brick:5", "cone:5"), whiskers="C2,C3,D1", shard_size=10)


@functools.cache
def small_set():
    """The folder of forty sweeps, generated once in a process; a test that changes it copies it before."""
    folder = Path(tempfile.mkdtemp())
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    generate(forty_sweeps(), folder, workers=1)
    return folder


def killed_plan():
    """Sixteen shards, which take about a second: long enough to be killed in between."""
    return small_plan(("brick:8", "cone:8"), shard_size=2, limit=2)


def files_of(folder):
    """Name → bytes of every file of a folder, hidden ones too."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}
