"""Processor time until a machine that never ran ``rod`` has its kernel, by the number of links.

python -m benchmarks.whiskers.first_kernel --write

For a GPU the kernels are compiled here (``precompile``), which launches nothing.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.report import publish, script_parser, table
from benchmarks.whiskers.precompile import pretend
from brainbench.core.devices import pick_device, warp
from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.engines.rod.compilation import load_kernels
from brainbench.stimuli.engines.rod.limits import MESHES
from brainbench.stimuli.engines.rod.packing import capacity_for
from brainbench.stimuli.engines.rod.sweeps import SLICED_BOUNDS
from brainbench.stimuli.validation.contact_scenes import contact_jobs

LINKS = (8, 12, 24, 40)


def main() -> None:
    parser = script_parser(__doc__)
    parser.add_argument("--links", type=int, help="measure these here, with the cache of kernels as it is")
    parser.add_argument("--device", choices=list(MEASURES), default="processor", help="with --links: for what")
    args = parser.parse_args()
    if args.links:
        print(MEASURES[args.device](args.links))
        return
    rows = []
    for links in LINKS:
        rows.append([str(links)])
        for device in MEASURES:
            with tempfile.TemporaryDirectory() as cache:
                words = [sys.executable, "-m", "benchmarks.whiskers.first_kernel", "--links", str(links)]
                environment = {**os.environ, "WARP_CACHE_PATH": cache}
                told = subprocess.check_output([*words, "--device", device], env=environment, text=True)
            rows[-1].append(f"{float(told.split()[-1]):.1f}")
        print(*rows[-1], flush=True)
    body = (
        "Processor seconds from an empty cache of kernels. On a processor: one whisker that twists in a hollow, two "
        "steps. For a GPU of architecture sm_90: the kernel of scenes with meshes, in single and in double precision, "
        "and the six kernels of sweeps.\n\n"
    )
    body += table(["links", *MEASURES], rows)
    publish(args, "First kernel on a new machine", body)


def on_a_processor(links: int) -> float:
    """Return the processor time [s] of two steps, compiling included."""
    job = contact_jobs(0, each=1, objects=("hollow",))[0]
    before = time.process_time()
    get_engine("rod").run([replace(job, times=job.times[:2])], Fidelity(links=links, twist=True), workers=1)
    return time.process_time() - before


def for_a_gpu(links: int, precision: str = "float32", **options: Any) -> float:
    """Return the processor time [s] in which the kernels of whiskers that twist compile for sm_90."""
    pretend(Path(tempfile.mkdtemp()), arch=90, sm_count=132)
    device, real = pick_device("cuda"), getattr(warp(), precision)
    before = time.process_time()
    load_kernels(device, real, capacity_for(links), MESHES, hinges=3, **options)
    return time.process_time() - before


MEASURES: dict[str, Callable[[int], float]] = {
    "processor": on_a_processor,
    "GPU, scenes": for_a_gpu,
    "GPU, scenes, double": partial(for_a_gpu, precision="float64"),
    "GPU, sweeps": partial(for_a_gpu, sliced=True, bounds=SLICED_BOUNDS),
}


if __name__ == "__main__":
    main()
