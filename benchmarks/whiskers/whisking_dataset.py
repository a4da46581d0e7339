"""How fast data sets of sweeps are planned, written and read: ``python -m benchmarks.whiskers.whisking_dataset``.

Physics is left out: a made-up engine returns random forces at once, so what is measured is everything around it. The
files are removed afterwards. ``--sweeps N`` sets the size (80 kB a sweep), ``--device cuda`` reads onto a GPU.
"""

from __future__ import annotations

import argparse
import os
import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
import torch

from benchmarks.report import table, write_section
from brainbench.core.files import hash_arrays
from brainbench.datasets.whisking.dataset import WhiskingDataset
from brainbench.stimuli import Fidelity
from brainbench.stimuli.engines.sweep_batch import SweepBatch
from brainbench.stimuli.objects.collections import NamedObject, resolve_objects
from brainbench.stimuli.objects.primitives import box
from brainbench.stimuli.sweeps import running, shards
from brainbench.stimuli.sweeps.generation import generate
from brainbench.stimuli.sweeps.plan import GenerationPlan, GenerationSettings, ShardTask
from brainbench.stimuli.sweeps.shards import BuiltObject, _conditions, _write_all, build_object, shard_tables
from brainbench.stimuli.sweeps.sweep_scenes import GRIDS

WHISKERS, FRAMES = 30, 110
BLOCK = np.random.default_rng(0).normal(size=(64, FRAMES, WHISKERS, 6)).astype(np.float32)
WRENCH = np.resize(BLOCK, (2048, FRAMES, WHISKERS, 6))
PER_SWEEP = WHISKERS * FRAMES * 24


def made_up(scenes: object, indices: Sequence[int], **options: object) -> SweepBatch:
    """Stand-in for an engine: always the same random numbers."""
    count = len(indices)
    quiet = np.zeros((count, WHISKERS))
    return SweepBatch(WRENCH[:count], quiet.astype(np.float32), quiet.astype(bool), ("",) * count, count, count)


def seconds(work: Callable[[], object], repeats: int = 5) -> tuple[float, float]:
    """Median of elapsed and of processor seconds, of all threads together."""
    times = []
    for _ in range(repeats):
        elapsed, busy = time.perf_counter(), time.process_time()
        work()
        times.append((time.perf_counter() - elapsed, time.process_time() - busy))
    first, second = zip(*times, strict=True)
    return statistics.median(first), statistics.median(second)


def rate(what: str, size: float, took: tuple[float, float]) -> list[str]:
    """Row of a rate in GB/s; ``size`` in bytes."""
    return [what, *(f"{size / 1e9 / each:.2f} GB/s" for each in took)]


def plan_published() -> list[list[str]]:
    """Plan the published high-variation set: 9981 objects, 208 sweeps each."""
    items = list(resolve_objects(["procedural-24:416"], surfaces=True).items())[:9981]
    plan = GenerationPlan(
        "thesis-high", GRIDS["thesis-high"], dict(items), GenerationSettings(Fidelity(), backend="rod", device="cuda")
    )
    took = seconds(lambda: plan.shards, 1)
    return [
        [f"plan 2,076,048 sweeps of 9981 objects in {len(plan.shards)} shards", *(f"{each:.1f} s" for each in took)]
    ]


def build_objects() -> list[list[str]]:
    found = list(resolve_objects(["procedural-24:3"], surfaces=True).values())
    found[0].load()
    times = np.array([seconds(item.load, 1) for item in found]) * 1e3
    each = [
        f"{mean:.0f} ms, at most {most:.0f} ms"
        for mean, most in zip(times.mean(axis=0), times.max(axis=0), strict=True)
    ]
    return [["build an object of procedural-24 (2,000–20,000 triangles)", *each]]


def write_parts(folder: Path) -> list[list[str]]:
    """Hash and write one shard's forces, one thread."""
    path = folder / "raw"

    def write(sync: bool) -> None:
        with path.open("wb", buffering=0) as stream:
            _write_all(stream, WRENCH)
            if sync:
                os.fsync(stream.fileno())

    rows = [
        rate("hash (SHA-256), one thread", WRENCH.nbytes, seconds(lambda: hash_arrays({"wrench": WRENCH}), 3)),
        rate("write into the page cache, one thread", WRENCH.nbytes, seconds(lambda: write(False))),
        rate("write and wait for the disk, one thread", WRENCH.nbytes, seconds(lambda: write(True), 3)),
    ]
    path.unlink()
    return rows


def write_set(folder: Path, sweeps: int) -> list[list[str]]:
    """Write a data set through the path that a GPU takes, its objects built before."""
    shards.simulate_sweeps = made_up
    objects = {
        name: NamedObject(name, "box", "made up", partial(box, (1.0, 1.0, 1.0)))
        for name in (f"box-{index}" for index in range(sweeps // 16))
    }
    plan = GenerationPlan(
        "thesis-low", GRIDS["thesis-low"], objects, GenerationSettings(Fidelity(), backend="mujoco", shard_size=2048)
    )
    run, running.run_here = (
        running.run_here,
        lambda tasks, where, workers, done: running.run_pipelined(tasks, where, 1, done),
    )
    # What other processes do while the GPU works is measured by itself.
    built = [[build_object(item, task.settings, task.grid) for item in task.objects] for task in plan.shards]

    def tables(task: ShardTask, objects: list[BuiltObject]) -> None:
        shard_tables(task, plan.array, task.grid.frames.times, [one.hash for one in objects])
        _conditions(task)

    ready = list(zip(plan.shards, built, strict=True))
    each = [seconds(lambda pair=pair: tables(*pair), 1) for pair in ready]
    ahead, running._built_ahead = running._built_ahead, lambda tasks, pool, ahead: iter(ready)
    pool, running.worker_pool = running.worker_pool, ThreadPoolExecutor  # type: ignore[assignment]
    try:
        took = seconds(lambda: generate(plan, folder), 1)
    finally:
        running.run_here, running.worker_pool, running._built_ahead = run, pool, ahead
    means = [sum(item) / plan.sweeps * 2048 * 1e3 for item in zip(*each, strict=True)]
    what = f"{plan.sweeps:,} sweeps in {len(plan.shards)} shards: {running.WRITERS} threads hash, write, wait"
    prepare = [
        "prepare a shard of 2048 sweeps of 128 objects, beside building them",
        *(f"{one:.0f} ms" for one in means),
    ]
    return [prepare, rate(what, plan.sweeps * PER_SWEEP, took)]


def read(folder: Path, device: str) -> list[list[str]]:
    data = WhiskingDataset(folder, split="all")
    took = seconds(lambda: WhiskingDataset(folder, split="all"))
    rows = [[f"open {len(data.manifest['shards'])} shards", *(f"{each * 1e3:.0f} ms" for each in took)]]
    data.verify()  # which also brings the files into the page cache
    for view, what in (("raw", "[B, frame, whisker, channel]"), ("grid", "[B, T, S·C, H, W]")):
        data = WhiskingDataset(folder, split="all", batch_size=256, view=view, device=device)

        def epoch(data: WhiskingDataset = data) -> None:
            for _ in data:
                pass
            if device != "cpu":
                torch.cuda.synchronize()

        what = f"read shuffled batches of 256, {what}, to {device}"
        rows.append(rate(what, data.sweeps * PER_SWEEP, seconds(epoch, 3)))
    return rows


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--sweeps", type=int, default=16_384)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads(), help="threads of torch")
    parser.add_argument("--no-write", action="store_true", help="print, but leave RESULTS.md alone")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    with tempfile.TemporaryDirectory(dir=".") as name:
        folder = Path(name)
        rows = [*plan_published(), *build_objects(), *write_parts(folder), *write_set(folder / "set", options.sweeps)]
        rows += read(folder / "set", options.device)
    body = table(["", "elapsed", "per processor"], rows)
    print(body)
    if not options.no_write:
        note = (
            "Rates count the stored forces (float32), by elapsed time and by processor time of all threads; others "
            "used the machine too. Reading is from the page cache. Writing is bound by hashing (per thread) and by the "
            "disk."
        )
        write_section(
            "Data sets of sweeps",
            "python -m benchmarks.whiskers.whisking_dataset",
            f"{note}\n\n{body}",
            subject="whiskers",
        )


if __name__ == "__main__":
    main()
