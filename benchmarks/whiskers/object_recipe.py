"""Write the recipe ``objects``: procedural objects swept past the right whiskers of a mouse, screened for contact.

One object of each family, in alphabetical order, with size, turn, height, distance and speed drawn from a seed that
its name gives. A draw is kept if the sweep touches at least :data:`FEWEST` whiskers; else the next is tried. The first
:data:`OBJECTS` families make the recipe.

    python -m benchmarks.whiskers.object_recipe > brainbench/stimuli/data/recipes/objects.toml
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterator

import numpy as np

from brainbench.stimuli import simulate
from brainbench.stimuli.objects.mesh_solids import shape_solid
from brainbench.stimuli.objects.procedural import list_families, make
from brainbench.stimuli.scenes.frames import Frames
from brainbench.stimuli.scenes.scene import Scene
from brainbench.stimuli.sweeps.grid import Sweep, SweepGrid
from brainbench.stimuli.sweeps.sweep_scenes import GRIDS
from brainbench.stimuli.whiskers.array import WhiskerArray

OBJECTS = 40
FEWEST = 5
WHISKERS = "B0-B3,C0-C3,D0-D3"
FRAMES = Frames(first=0.001, interval=0.009, count=50, average=18)
DRAWS = 3
"""Draws tried of each family; one without a touching draw is left out."""
DETAIL = 2_000

HEAD = '''description = """
Forty procedural objects, one of each of 40 families, swept past twelve right whiskers of a mouse for 0.45 seconds."""

# Written by benchmarks/whiskers/object_recipe.py, which draws size, turn, height, distance and speed of each object and
# keeps a draw that touches at least {fewest} whiskers. The head is that of the published sweeps (recipe thesis-low).
# Whiskers touch the convex hull of each object: all forty are simulated within seconds.

[array]
species = "mouse"
side = "right"
whiskers = "{whiskers}"

[head]
position_mm = {position}
rotation_deg = {rotation}

[whisking]
kind = "still"

[frames]
first_ms = {first:g}
interval_ms = {interval:g}
count = {count}
average = {average}
'''

ENTRY = """
[[scene]]
label = "{label}"
[[scene.object]]
shape = "family:{label}"
seed = {seed}
detail = {detail}
diagonal_mm = {size:g}
collision = "hull"
position_mm = {position}
rotation_deg = [0, 0, {turn:g}]
velocity_mm_s = [0, -{speed:g}, 0]
"""


def draws(family: str) -> Iterator[tuple[int, Sweep]]:
    """Yield seeds and sweeps of a family, always the same ones."""
    random = np.random.default_rng([zlib.crc32(family.encode()), 18])
    for seed in range(DRAWS):
        yield (
            seed,
            Sweep(
                speed=1e-3 * float(random.integers(50, 71)),
                height=1e-3 * float(random.integers(-3, 4)),
                rotation=math.radians(5 * int(random.integers(72))),
                distance=1e-3 * float(random.integers(4, 9)),
                size=1e-3 * float(random.integers(20, 31)),
            ),
        )


def main() -> None:
    """Simulate every draw, keep the first that touches enough, and print the recipe."""
    grid = SweepGrid(start=0.010, head=GRIDS["thesis-low"].head, frames=FRAMES)
    array = WhiskerArray.of("mouse").select(WHISKERS)
    tried: dict[str, tuple[str, int, Sweep, Scene]] = {}
    for family in list_families():
        for seed, sweep in draws(family):
            solid = shape_solid(make(family, seed, detail=DETAIL), collision="hull")
            tried[f"{family}-{seed}"] = (
                family,
                seed,
                sweep,
                grid.scene(solid, sweep, label=f"{family}-{seed}", array=array),
            )
    touched = simulate([scene for *_, scene in tried.values()])["contact"].any("time").sum("whisker")
    kept: dict[str, tuple[int, Sweep, Scene]] = {}
    for label, (family, seed, sweep, scene) in tried.items():
        if len(kept) < OBJECTS and family not in kept and int(touched.sel(stimulus=label)) >= FEWEST:
            kept[family] = (seed, sweep, scene)
    head = grid.head
    print(
        HEAD.format(
            fewest=FEWEST,
            whiskers=WHISKERS,
            position=[round(1e3 * value, 4) for value in head.position],
            rotation=[round(math.degrees(value), 3) for value in head.rotation],
            first=1e3 * FRAMES.first,
            interval=1e3 * FRAMES.interval,
            count=FRAMES.count,
            average=FRAMES.average,
        ),
        end="",
    )
    for family, (seed, sweep, scene) in kept.items():
        place = [round(1e3 * value, 4) for value in scene.objects[0].position]
        turn, speed, size = math.degrees(sweep.rotation), 1e3 * sweep.speed, 1e3 * sweep.size
        entry = {"label": family, "seed": seed, "detail": DETAIL, "size": size, "position": place}
        print(ENTRY.format(**entry, turn=round(turn, 6), speed=round(speed, 6)), end="")


if __name__ == "__main__":
    main()
