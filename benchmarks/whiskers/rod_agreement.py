"""How far ``rod`` and ``mujoco`` agree on whole scenes: random sweeps over ten shapes, whisker by whisker.

python -m benchmarks.whiskers.rod_agreement [--sweeps 50] [--whiskers 6] [--bullet] [--write]

All touch the same convex hulls, at preset ``accurate``. Of every whisker that one of two engines bends, readings
at 1 kHz give three numbers, of that whisker's own peak (force and moment apart): how much the peaks differ; the median
difference of a reading in contact; and the root mean square over the whole sweep, in which a slip that comes a few
milliseconds sooner counts as full error. Each engine is held against itself at steps of 10 µs as well, which tells
whose error a difference is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks.report import publish, script_parser, table
from brainbench.stimuli import Fidelity, Frames, Scene, simulate
from brainbench.stimuli.objects.collections import resolve_objects
from brainbench.stimuli.sweeps.sweep_scenes import GRIDS, SweepScenes
from tests.stimuli.engines.rod.test_friction import differences

SHAPES = "ellipsoid-1,brick-2,torus-3,cone-1,bumpy-1,cylinder-1,superquadric-1,pyramid-1,vase-1,wedge-1"
ACCURATE = Fidelity.preset("accurate")
FINER = replace(ACCURATE, time_step=1e-5, steps_per_period=None)
FELT = 1e-6, 5e-9
"""Peak force (N) and moment (N m) from which a whisker counts."""
GOAL = 0.03
SLOW = 0.02
"""Speed (m/s) of the sweeps that are solved without inertia."""


def draw(objects: dict[str, Any], count: int, whiskers: int, speed: float | None, friction: float) -> list[Scene]:
    """Random sweeps of the high-variation grid, as many of each object, each past whiskers drawn for it."""
    generator = np.random.default_rng(0)
    frames = Frames(1e-3, 1e-3, 990 if speed is None else 2490)
    grid = replace(GRIDS["thesis-high"], frames=frames, draws=208)
    scenes = SweepScenes(grid, {name: item.load for name, item in objects.items()})
    names = [mount.name for mount in scenes.array]
    drawn = []
    for k in range(count):
        name = scenes.objects[k % len(scenes.objects)]
        sweep = scenes.grid.sweeps(name)[generator.integers(scenes.grid.count)]
        sweep = sweep if speed is None else replace(sweep, speed=speed)
        some = scenes.array.select(",".join(generator.choice(names, whiskers, replace=False)))
        scene = grid.scene(scenes.solid(name), sweep, label=f"{k}", array=some)
        drawn.append(replace(scene, objects=tuple(replace(item, friction=friction) for item in scene.objects)))
    return drawn


def wrenches(scenes: Sequence[Scene], fidelity: Fidelity, backend: str, *, cache: bool | None = None) -> np.ndarray:
    """[whisker of a sweep, reading, 6] (N, N m), NaN where a whisker was unstable; ``rod`` is computed anew."""
    keep = backend != "rod" if cache is None else cache
    found = [simulate([scene], fidelity=fidelity, backend=backend, cache=keep)["wrench"].values[0] for scene in scenes]
    return np.concatenate([np.moveaxis(wrench, 1, 0) for wrench in found]).astype(float)


def compare(found: np.ndarray, truth: np.ndarray) -> list[str]:
    """A row of the table: whiskers, left out, and of force and moment peaks, readings in contact, root mean square."""
    bad = ~(np.isfinite(found).all(axis=(1, 2)) & np.isfinite(truth).all(axis=(1, 2)))
    cells: list[str] = []
    felt = np.zeros(len(found), dtype=bool)
    for part, least in zip((slice(0, 3), slice(3, 6)), FELT, strict=True):
        on = (np.linalg.norm(truth[..., part], axis=-1).max(axis=1) > least) & ~bad
        felt |= on
        cells += [
            f"{100 * np.median(some):.2g} ({np.mean(some <= GOAL):.0%})" if on.any() else ""
            for some in differences(found[on][..., part], truth[on][..., part])
        ]
    return [f"{felt.sum()}", f"{bad.sum()}", *cells]


def main() -> None:
    parser = script_parser(__doc__)
    parser.add_argument("--sweeps", type=int, default=50)
    parser.add_argument("--whiskers", type=int, default=6)
    parser.add_argument("--shapes", default=SHAPES)
    parser.add_argument("--bullet", action="store_true", help="a third engine, which takes some 17 minutes")
    args = parser.parse_args()
    objects = resolve_objects(args.shapes.split(","), collision="hull")
    rows = []

    def row(what: str, found: np.ndarray, truth: np.ndarray) -> None:
        rows.append([what, *compare(found, truth)])
        print(rows[-1], flush=True)

    still = replace(ACCURATE, solver="quasistatic", time_step=1e-4, steps_per_period=None)
    for friction in (0.0, 0.48):
        scenes = draw(objects, args.sweeps, args.whiskers, None, friction)
        rod, fine_rod = (wrenches(scenes, fidelity, "rod") for fidelity in (ACCURATE, FINER))
        row(f"rod at 10 µs and at `accurate`, friction {friction:g}", fine_rod, rod)
        mujoco = wrenches(scenes, ACCURATE, "mujoco")
        row(f"**rod and mujoco**, friction {friction:g}", rod, mujoco)
        few = slice(0, len(scenes) // 5 * args.whiskers)
        fine = wrenches(scenes[: len(scenes) // 5], FINER, "mujoco")
        row(f"mujoco at 10 µs and at `accurate`, a fifth of them, friction {friction:g}", fine, mujoco[few])
        row(f"rod and mujoco at 10 µs, a fifth of them, friction {friction:g}", fine_rod[few], fine)
        if args.bullet:
            bullet = wrenches(scenes[: len(scenes) // 5], ACCURATE, "bullet")
            row(f"**rod and bullet**, a fifth of them, friction {friction:g}", rod[few], bullet)
            row(f"mujoco and bullet, a fifth of them, friction {friction:g}", mujoco[few], bullet)
        slow = draw(objects, args.sweeps, args.whiskers, SLOW, friction)
        balance = wrenches(slow, still, "rod")
        moving = wrenches(slow, ACCURATE, "rod")
        row(f"quasi-static and dynamic rod at {SLOW * 1e3:g} mm/s, friction {friction:g}", balance, moving)
        mujoco = wrenches(slow, ACCURATE, "mujoco")
        row(f"**quasi-static rod and mujoco** at {SLOW * 1e3:g} mm/s, friction {friction:g}", balance, mujoco)
    head = ["", "whiskers bent", "left out", *(f"{what} {how}" for what in ("force", "moment") for how in HOW)]
    text = (
        f"{args.sweeps} random sweeps of thesis-high over the hulls of {len(objects)} shapes ({args.shapes}), "
        f"{args.whiskers} whiskers drawn for each. Per cent of the whisker's own peak, median over whiskers; in "
        f"brackets the share of whiskers within {GOAL:.0%}.\n\n" + table(head, rows)
    )
    publish(args, "Agreement of rod and mujoco", text)


HOW = "peak", "reading", "rms"

if __name__ == "__main__":
    main()
