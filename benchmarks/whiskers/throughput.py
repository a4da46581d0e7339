"""Whisker-steps per second of the ``rod`` backend without contact. Run on a GPU, or with --device cpu.

python -m benchmarks.whiskers.throughput [--device cuda]

Sweeps over meshes are measured by :mod:`benchmarks.whiskers.public_rate` and, slice by slice, ``slices``.
"""

from __future__ import annotations

import argparse
import itertools
import statistics

import numpy as np

from brainbench.core.devices import pick_device
from brainbench.stimuli import Fidelity
from brainbench.stimuli.engines.rod.launch import Launch, WhiskerSolver
from brainbench.stimuli.engines.rod.limits import NOTHING
from brainbench.stimuli.engines.rod.packing import PackedJobs, PackedMotions, PackedShapes, still_knots
from brainbench.stimuli.engines.rod.sweeps import BLOCK
from brainbench.stimuli.whiskers.array import WhiskerArray
from brainbench.stimuli.whiskers.whisker import build_chain


def free(device_name: str, lanes: int, links: int, steps: int, twists: bool) -> None:
    """Whiskers that swing under gravity, nothing near: pure integration; in their plane, or out of it, which twists."""
    step = 1e-4
    fidelity = Fidelity(links=links, time_step=step, precision="single")
    chains = [build_chain(mount.whisker, links) for mount in WhiskerArray.mouse()]
    device, gravity = pick_device(device_name), (0.0, 0.0, -9.81) if twists else (0.0, -9.81, 0.0)
    solver = WhiskerSolver(chains, fidelity, device, NOTHING, twists=twists, block=BLOCK)
    motions, shapes = PackedMotions(), PackedShapes()
    motions.add_straight(still_knots(np.zeros(3), np.array([1.0, 0, 0, 0])))
    shapes.first.append(0)
    which, zeros = np.sort(np.arange(lanes, dtype=np.int32) % len(chains)), np.zeros(lanes, dtype=np.int32)
    jobs = PackedJobs(which, zeros, zeros, np.arange(lanes, dtype=np.int32), zeros, zeros + 1)
    kernels = []
    for _ in range(4):
        given = Launch(jobs, motions, shapes, np.array([steps * step]), (lanes, 1), gravity=gravity)
        result = solver.launch(given)
        kernels.append(result.seconds)
    seconds = statistics.median(kernels[1:])
    print(
        f"free  N={links} {'twist' if twists else 'bending'} single lanes={lanes}: "
        f"{int(result.steps.astype(np.int64).sum()) / seconds:.3e} whisker-steps/s "
        f"({seconds:.3f} s, {int((result.counts['status'] != 0).sum())} failed)",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--lanes", type=int, default=262_144)
    args = parser.parse_args()
    small = args.device == "cpu"
    lanes, steps = (60, 200) if small else (args.lanes, 100)
    for links, twists in itertools.product((10, 20), (False, True)):
        free(args.device, lanes, links, steps, twists)


if __name__ == "__main__":
    main()
