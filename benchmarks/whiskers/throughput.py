"""Whisker-steps per second of the ``rod`` backend without contact. Run on a GPU, or with --device cpu.

python -m benchmarks.whiskers.throughput [--device cuda] [--only free,peer]

Sweeps over meshes are measured by :mod:`benchmarks.whiskers.public_rate` and, slice by slice, ``slices``.
"""

from __future__ import annotations

import argparse
import itertools
import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from brainbench.core.devices import pick_device, warp
from brainbench.stimuli import Fidelity
from brainbench.stimuli.engines.rod.launch import Launch, WhiskerSolver
from brainbench.stimuli.engines.rod.limits import NOTHING
from brainbench.stimuli.engines.rod.packing import PackedJobs, PackedMotions, still_knots
from brainbench.stimuli.engines.rod.shapes import PackedShapes
from brainbench.stimuli.engines.rod.sweeps import BLOCK
from brainbench.stimuli.whiskers.array import WhiskerArray
from brainbench.stimuli.whiskers.chain import build_chain


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
        given = Launch(jobs, motions, shapes, np.array([steps * step]), (lanes, 1), gravity=gravity)
        result = solver.launch(given)
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
    from brainbench.stimuli.engines.reach import reachable
    from brainbench.stimuli.motion.jobs import Job, StillFollicle

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


def _bounds(words: str) -> tuple[int, int] | None:
    if words == "0":
        return None
    threads, blocks = words.split("x")
    return int(threads), int(blocks)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--only", default="free,peer")
    parser.add_argument("--lanes", type=int, default=262_144)
    parser.add_argument("--blocks", default=str(BLOCK), help="threads of a block, several by commas")
    parser.add_argument("--bounds", default="0", help="CUDA launch bounds such as 64x6, several by commas; 0 = none")
    args = parser.parse_args()
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


if __name__ == "__main__":
    main()
