"""Whisker-steps per second of the ``rod`` backend: free, and sweeping over meshes. Run on a GPU, or with --device cpu.

python -m benchmarks.whiskers.throughput [--device cuda] [--only free,peer,sweep]
"""

from __future__ import annotations

import argparse
import itertools
import multiprocessing
import os
import statistics
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from typing import TYPE_CHECKING, Any

import numpy as np

from brainbench.core.devices import pick_device, warp
from brainbench.stimuli import Fidelity
from brainbench.stimuli.engines.rod.launch import WhiskerSolver
from brainbench.stimuli.engines.rod.limits import NOTHING
from brainbench.stimuli.engines.rod.packing import PackedJobs, PackedMotions, still_knots
from brainbench.stimuli.engines.rod.shapes import PackedShapes
from brainbench.stimuli.engines.rod.sweeps import BLOCK, SweepLauncher, pack_object
from brainbench.stimuli.engines.trust import LARGEST_RESIDUAL
from brainbench.stimuli.objects.collections import resolve_objects
from brainbench.stimuli.sweeps.sweep_scenes import GRIDS, SweepScenes
from brainbench.stimuli.whiskers.array import WhiskerArray
from brainbench.stimuli.whiskers.chain import build_chain

if TYPE_CHECKING:
    from brainbench.stimuli.objects.collections import NamedObject
    from brainbench.stimuli.objects.solid import Solid


def timed(wp: Any, device: Any, run: Callable[[], None], repeats: int = 3) -> float:
    """Median seconds of a launch, warmed up."""
    run()
    wp.synchronize_device(device)
    seconds = []
    for _ in range(repeats):
        started = time.perf_counter()
        run()
        wp.synchronize_device(device)
        seconds.append(time.perf_counter() - started)
    return statistics.median(seconds)


def free(
    device_name: str,
    lanes: int,
    links: int,
    steps: int,
    block: int,
    bounds: tuple[int, int] | None = None,
    precision: str = "single",
    twists: bool = False,
) -> None:
    """Whiskers that swing under gravity, nothing near: pure integration; in their plane, or out of it, which twists."""
    step = 1e-4
    fidelity = Fidelity(links=links, time_step=step, precision=precision)
    chains = [build_chain(mount.whisker, links) for mount in WhiskerArray.mouse()]
    device, gravity = pick_device(device_name), (0.0, 0.0, -9.81) if twists else (0.0, -9.81, 0.0)
    solver = WhiskerSolver(chains, fidelity, device, NOTHING, twists=twists, block=block, bounds=bounds)
    motions, shapes = PackedMotions(), PackedShapes()
    motions.add_straight(still_knots(np.zeros(3), np.array([1.0, 0, 0, 0])))
    shapes.first.append(0)
    which, zeros = np.sort(np.arange(lanes, dtype=np.int32) % len(chains)), np.zeros(lanes, dtype=np.int32)
    jobs = PackedJobs(which, zeros, zeros, np.arange(lanes, dtype=np.int32), zeros, zeros + 1)
    kernels = []
    for _ in range(4):
        result = solver.launch(jobs, motions, shapes, np.array([steps * step]), (lanes, 1), gravity=gravity)
        kernels.append(result.seconds["kernel"])
    seconds = statistics.median(kernels[1:])
    print(
        f"free  N={links} {'twist' if twists else 'bending'} {precision} lanes={lanes} block={block} bounds={bounds}: "
        f"{int(result.steps.astype(np.int64).sum()) / seconds:.3e} whisker-steps/s "
        f"({seconds:.3f} s, {int((result.counts['status'] != 0).sum())} failed)",
        flush=True,
    )


def peer(device_name: str, worlds: int, links: int, steps: int) -> None:
    """MuJoCo Warp on the same free whisker, one a world: its own steps, recorded as a CUDA graph where there is one."""
    import mujoco
    import mujoco_warp

    from brainbench.stimuli.engines.mujoco.model import build_model
    from brainbench.stimuli.engines.protocol import Job, StillFollicle
    from brainbench.stimuli.engines.reach import reachable

    wp = warp()
    whisker = next(mount.whisker for mount in WhiskerArray.mouse() if mount.name == "C2")
    job = Job(whisker, StillFollicle(), (), np.array([1e-2]), gravity=(0.0, 0.0, -9.81))
    times = np.arange(101) * 1e-4
    reach = reachable(whisker, np.zeros((len(times), 3)), (), times, surfaces=False)
    model = build_model(job, build_chain(whisker, links), reach, 1e-4, times).model
    # These flags serve contacts; MuJoCo Warp does not know them.
    model.opt.disableflags, model.opt.enableflags = 0, 0
    device = wp.get_device(device_name)
    with wp.ScopedDevice(device):
        m = mujoco_warp.put_model(model)
        d = mujoco_warp.put_data(model, mujoco.MjData(model), nworld=worlds, nconmax=1, njmax=1)
        run: Callable[[], None]
        if device.is_cuda:
            mujoco_warp.step(m, d)
            with wp.ScopedCapture() as capture:
                for _ in range(steps):
                    mujoco_warp.step(m, d)

            def run() -> None:
                wp.capture_launch(capture.graph)
        else:

            def run() -> None:
                for _ in range(steps):
                    mujoco_warp.step(m, d)

        seconds = timed(wp, device, run)
        bad = int((~np.isfinite(d.qpos.numpy()).all(axis=1)).sum())
    print(
        f"peer  MuJoCo Warp N={links} worlds={worlds}: {worlds * steps / seconds:.3e} whisker-steps/s "
        f"({seconds:.3f} s, {bad} failed)",
        flush=True,
    )


def sweep(
    device_name: str,
    recipe: str,
    words: list[str],
    fidelity: Fidelity,
    sweeps: int,
    sliced: bool | None = None,
    tuning: dict[str, Any] | None = None,
    timers: bool = False,
) -> None:
    """Sweeps of a recipe over procedural objects: steps, sweeps per second, and what that means for whole sets."""
    wp = warp()
    started = time.perf_counter()
    objects = load_objects(words)
    loaded = time.perf_counter() - started
    scenes = SweepScenes(GRIDS[recipe], objects)
    packed = {name: pack_object(solid) for name, solid in objects.items()}
    launcher = SweepLauncher(scenes, fidelity, device_name, sliced=sliced, packed=packed)
    launcher.solver.tuning = tuning or {}
    groups = [(name, scenes.grid.sweeps(name)[: max(1, sweeps // len(objects))]) for name in scenes.objects]
    launcher.launch(groups[:1])
    started = time.perf_counter()
    if timers:
        wp.timing_begin(cuda_filter=wp.TIMING_KERNEL)
    result = launcher.launch(groups)
    if timers:
        spent: dict[str, list[float]] = {}
        for one in wp.timing_end():
            spent.setdefault(one.name, []).append(one.elapsed)
        for name, each in sorted(spent.items()):
            print(
                f"      {name[:90]}: {sum(each):.1f} ms in {len(each)}, median {statistics.median(each):.3f}, "
                f"most {max(each):.3f}",
                flush=True,
            )
    wp.synchronize_device(launcher.device)
    seconds = time.perf_counter() - started
    count = sum(len(some) for _, some in groups)
    steps, full = int(result.steps.astype(np.int64).sum()), launcher.steps_in_full * count
    # Delivered: every whisker at every time step of the recording, as a solver without skipping would compute them.
    print(
        f"sweep {recipe} {count} sweeps of {len(objects)} objects, {fidelity.links} links, "
        f"dt {1e3 * fidelity.time_step:g} ms: {seconds:.2f} s "
        f"(kernels {launcher.seconds.get('kernel', float('nan')):.2f} s); whisker-steps/s computed "
        f"{steps / seconds:.3e}, delivered {full / seconds:.3e} (in kernels alone "
        f"{steps / launcher.seconds['kernel']:.3e}, {full / launcher.seconds['kernel']:.3e}); "
        f"{1 - steps / full:.1%} of the steps saved, {result.counts['touching'].sum() / max(steps, 1):.1%} of the "
        f"others in contact; {count / seconds:.0f} sweeps/s: 159,696 in {159696 / count * seconds:.0f} s, 2,076,048 in "
        f"{2076048 / count * seconds / 60:.1f} min (objects made before, in {loaded:.1f} s, not counted)",
        flush=True,
    )
    print(
        f"      tuning {tuning}; {launcher.solver.slices} slices, most steps {result.steps.max()}; failed "
        f"{int((result.counts['status'] != 0).sum())}, unsolved steps {int(result.counts['unsolved'].sum())}, "
        f"large residual {int((result.residual > LARGEST_RESIDUAL).sum())}; "
        f"phases { ({k: round(v, 3) for k, v in launcher.seconds.items()}) }",
        flush=True,
    )


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


def _bounds(words: str) -> tuple[int, int] | None:
    if words == "0":
        return None
    threads, blocks = words.split("x")
    return int(threads), int(blocks)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--only", default="free,peer,sweep")
    parser.add_argument("--lanes", type=int, default=262_144)
    parser.add_argument("--blocks", default=str(BLOCK), help="threads of a block, several by commas")
    parser.add_argument("--bounds", default="0", help="CUDA launch bounds such as 64x6, several by commas; 0 = none")
    parser.add_argument("--objects", default="procedural-24:2")
    parser.add_argument("--sweeps", type=int, default=768)
    parser.add_argument("--sliced", action=argparse.BooleanOptionalAction, help="pause whiskers for looks at meshes")
    parser.add_argument("--links", type=int, default=12)
    parser.add_argument("--recipes", default="thesis-low,thesis-high")
    parser.add_argument("--steps", default="2e-4,5e-4,1e-3", help="time steps of the sweeps (s)")
    parser.add_argument("--budget", type=int, help="steps of a whisker in one slice")
    parser.add_argument("--recorded", action=argparse.BooleanOptionalAction, help="slices as CUDA graphs")
    parser.add_argument("--timers", action="store_true", help="time of each kernel (only without graphs)")
    args = parser.parse_args()
    tuning = {name: value for name in ("budget", "recorded") if (value := getattr(args, name)) is not None}
    small = args.device == "cpu"
    chosen = args.only.split(",")
    if "free" in chosen:
        blocks = [int(words) for words in args.blocks.split(",")]
        limits = [_bounds(words) for words in args.bounds.split(",")]
        lanes, steps = (60, 200) if small else (args.lanes, 100)
        for links, twists, block, bounds in itertools.product((10, 20), (False, True), blocks, limits):
            # CUDA refuses blocks of more threads than a kernel was compiled for.
            if bounds is None or block <= bounds[0]:
                free(args.device, lanes, links, steps, block, bounds, twists=twists)
    if "peer" in chosen:
        for links in (10, 20):
            peer(args.device, 16 if small else 32_768, links, 20)
    if "sweep" in chosen:
        for step in map(float, args.steps.split(",")):
            fidelity = Fidelity(links=args.links, time_step=step)
            for recipe in args.recipes.split(","):
                sweep(
                    args.device,
                    recipe,
                    args.objects.split(","),
                    fidelity,
                    args.sweeps,
                    args.sliced,
                    tuning,
                    args.timers,
                )


if __name__ == "__main__":
    main()
