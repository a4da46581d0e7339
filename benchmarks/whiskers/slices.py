"""Where the time of sweeps goes on a GPU: how many whiskers are active in each slice, and what its kernels take.

python -m benchmarks.whiskers.slices [--objects procedural-24:2] [--every 1] [--device cuda] [--write]

Each slice is measured by itself, kernel after kernel, so that the sum is longer than the run of recorded slices.
"""

from __future__ import annotations

import multiprocessing
import os
import time
from concurrent.futures import ProcessPoolExecutor
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.report import publish, script_parser, table
from brainbench.core.devices import pick_device, warp
from brainbench.stimuli import Fidelity
from brainbench.stimuli.engines.rod.sweeps import SweepLauncher
from brainbench.stimuli.objects.collections import resolve_objects
from brainbench.stimuli.sweeps.sweep_scenes import GRIDS, SweepScenes

if TYPE_CHECKING:
    from brainbench.stimuli.objects.collections import NamedObject
    from brainbench.stimuli.objects.solid import Solid

PARTS = {"run": "steps", "solve_queue": "contact forces", "measure_distances": "distances", "swap_queues": "queues"}
"""Kernels by the first word of their names, and what they do."""


class Watched:
    """Launches every kernel of a run with a clock around it."""

    def __init__(self, launch: Any, device: Any) -> None:
        self.launch, self.device = launch, device
        self.seconds: dict[str, float] = {}
        self.active: list[int] = []
        self.queries = self.problems = 0

    def __call__(self, kernel: Any, dim: Any, inputs: Any, **options: Any) -> None:
        name = next((known for known in PARTS if kernel.key.startswith(known)), None)
        if name is None:
            self.launch(kernel, dim, inputs, **options)
            return
        paused = inputs[4] if name == "measure_distances" else inputs[-1]
        if name == "run":
            self.active.append(int(paused.queue_size.numpy().sum()))
        warp().synchronize_device(self.device)
        began = time.perf_counter()
        self.launch(kernel, dim, inputs, **options)
        warp().synchronize_device(self.device)
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - began
        if name == "swap_queues":
            self.problems += int(paused.problem_size.numpy().sum())
            self.queries += int(paused.query_count.numpy()[0])


def _load(item: NamedObject) -> Solid:
    return item.load()


def load_objects(words: list[str]) -> dict[str, Solid]:
    """Make objects, many of them on all processors as data generation does."""
    objects = resolve_objects(words, surfaces=True)
    processors = len(os.sched_getaffinity(0))
    if len(objects) < 64 or processors < 4:
        return {name: item.load() for name, item in objects.items()}
    with ProcessPoolExecutor(processors, mp_context=multiprocessing.get_context("spawn")) as pool:
        return dict(zip(objects, pool.map(_load, objects.values(), chunksize=4), strict=True))


def main() -> None:
    parser = script_parser(__doc__)
    parser.add_argument("--objects", default="procedural-24:2", help="208 sweeps of thesis-high each")
    parser.add_argument("--every", type=int, default=1, help="only every n-th sweep of an object")
    parser.add_argument("--fidelity", default="fast,links=12,time_step=1e-3,steps_per_period=none")
    parser.add_argument("--device", default="cuda")
    args = parser.parse_args()
    wp, device = warp(), pick_device(args.device)
    scenes = SweepScenes(GRIDS["thesis-high"], load_objects([args.objects]))
    launcher = SweepLauncher(scenes, Fidelity.parse(args.fidelity).resolved(twist=True), args.device, sliced=True)
    launcher.solver.tuning = {"recorded": False}
    groups = [(name, scenes.grid.sweeps(name)[:: args.every]) for name in scenes.objects]
    launcher.launch(groups[:1])
    watched = Watched(wp.launch, device)
    wp.launch = watched
    try:
        steps = int(launcher.launch(groups).steps.sum())
    finally:
        wp.launch = watched.launch
    name, words = device.name if device.is_cuda else "processor", f"--objects {args.objects} --every {args.every}"
    publish(args, f"Slices of sweeps on a {name}", report(watched, steps), words, where=f"one {name}")


def report(watched: Watched, steps: int) -> str:
    """Return what was seen as text."""
    active, whole = np.array(watched.active, dtype=float), sum(watched.seconds.values())
    rows = [
        [PARTS[name], f"{seconds:.2f}", f"{100 * seconds / whole:.0f}", f"{1e9 * seconds / active.sum():.1f}"]
        for name, seconds in watched.seconds.items()
    ]
    shares = ", ".join(
        f"{100 * active[int(q * len(active))] / active[0]:.1f} % at {q:.0%}" for q in (0.1, 0.25, 0.5, 0.75)
    )
    return (
        f"{active[0]:,.0f} whiskers, {steps:,} steps in {len(active):,} slices. A whisker that moves is in a slice "
        f"{active.sum() / steps:.2f} times a step, asks for {watched.queries / steps:.2f} distances a step, and has "
        f"contact forces solved in {100 * watched.problems / steps:.0f} % of its steps. Active are {shares} of the "
        f"slices; {100 * active.mean() / active[0]:.0f} % in the mean.\n\n"
        + table(["kernel", "s", "%", "ns per active whisker and slice"], rows)
    )


if __name__ == "__main__":
    main()
