"""Processor time until a machine that never ran ``rod`` has its kernel, by the number of links.

python -m benchmarks.whiskers.first_kernel --write
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import replace

from benchmarks.report import table, write_section
from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.validation.contact_scenes import contact_jobs

LINKS = (8, 12, 24, 40)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--links", type=int, help="measure these here, with the cache of kernels as it is")
    parser.add_argument("--write", action="store_true")
    args = parser.parse_args()
    if args.links:
        print(seconds(args.links))
        return
    rows = []
    for links in LINKS:
        with tempfile.TemporaryDirectory() as cache:
            words = [sys.executable, "-m", "benchmarks.whiskers.first_kernel", "--links", str(links)]
            told = subprocess.check_output(words, env={**os.environ, "WARP_CACHE_PATH": cache}, text=True)
        rows.append([str(links), f"{float(told.split()[-1]):.1f}"])
        print(*rows[-1], flush=True)
    body = "One whisker that twists in a hollow, two steps, an empty cache of kernels.\n\n"
    body += table(["links", "processor s"], rows)
    if args.write:
        command = "python -m benchmarks.whiskers.first_kernel --write"
        write_section("First kernel on a new machine", command, body, subject="whiskers")


def seconds(links: int) -> float:
    """Return the processor time [s] of two steps, compiling included."""
    job = contact_jobs(0, each=1, objects=("hollow",))[0]
    before = time.process_time()
    get_engine("rod").run([replace(job, times=job.times[:2])], Fidelity(links=links, twist=True), workers=1)
    return time.process_time() - before


if __name__ == "__main__":
    main()
