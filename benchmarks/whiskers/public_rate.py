"""Sweeps per second that users get: ``brainbench stimuli sweep --device cuda`` itself.

python -m benchmarks.whiskers.public_rate [--objects procedural-24:2] [--gpus 1,2] [--cold] [--write]

The command runs in a process of its own, timed from its start to its end: Python's start, objects, kernels, whiskers
that are simulated again, hashing and writing; with ``--cold`` also with an empty cache of kernels.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.report import script_parser, table, write_section

TITLE = "Sweeps on {}, by the public command"


def main() -> None:
    parser = script_parser(__doc__)
    parser.add_argument("--recipe", default="thesis-high")
    parser.add_argument("--objects", default="procedural-24:2", help="208 sweeps of thesis-high each")
    parser.add_argument("--fidelity", action="append", help="can be repeated")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--limit", type=int, help="only the first sweeps of each object")
    parser.add_argument("--gpus", default="1", help="numbers of GPUs, by commas")
    parser.add_argument("--cold", action="store_true", help="first with an empty cache of kernels")
    args = parser.parse_args()
    args.fidelity = args.fidelity or ["fast,links=12,time_step=1e-3"]
    body = commands(args)
    if args.write:
        kind = "processor" if args.device == "cpu" else "GPU" if args.gpus == "1" else "several GPUs"
        title = TITLE.format(kind if kind.startswith("several") else f"a {kind}")
        about = f"`brainbench stimuli sweep {' '.join(options(args, 'FIDELITY', Path('DIR')))}`\n\n"
        command = "python -m benchmarks.whiskers.public_rate " + " ".join(sys.argv[1:])
        where = "" if args.device == "cpu" else machine()
        write_section(title, command, about + body, subject="whiskers", where=where)


def commands(args: argparse.Namespace) -> str:
    """Return the table of the command's runs: with every fidelity, cold, then warm on each number of GPUs."""
    counts, rows = [int(word) for word in args.gpus.split(",")], []
    runs = [(counts[0], True)] * args.cold + [(count, False) for count in counts]
    with tempfile.TemporaryDirectory() as cache:
        # The runs after a cold one are warm because of it.
        environment = {**os.environ, **({"WARP_CACHE_PATH": cache} if args.cold else {})}
        for fidelity, (gpus, cold) in [(each, pair) for each in args.fidelity for pair in runs]:
            rows.append(row := run(args, fidelity, gpus, cold, environment))
            print(" | ".join(row), flush=True)
    names = ["fidelity", "run", "sweeps", "s", "sweeps/s", "processor s", "steps computed", "in full", "unstable"]
    return table([*names, "hash"], rows)


def options(args: argparse.Namespace, fidelity: str, out: Path) -> list[str]:
    """Return the arguments of the command."""
    limit = [] if args.limit is None else ["--limit", str(args.limit)]
    return [
        args.recipe, "--objects", args.objects, "--device", args.device, "--fidelity", fidelity, *limit,
        "--out", str(out),
    ]  # fmt: skip


def run(args: argparse.Namespace, fidelity: str, gpus: int, cold: bool, environment: dict[str, str]) -> list[str]:
    """Return a row of the table for one run of the command on so many GPUs."""
    folder = Path(tempfile.mkdtemp())
    if args.device != "cpu":
        # This process may itself see only some of the GPUs.
        seen = os.environ.get("CUDA_VISIBLE_DEVICES", ",".join(map(str, range(gpus)))).split(",")[:gpus]
        environment = {**environment, "CUDA_VISIBLE_DEVICES": ",".join(seen)}
    started, busy = time.perf_counter(), processor_seconds()
    made = subprocess.run(
        [sys.executable, "-m", "brainbench", "stimuli", "sweep", *options(args, fidelity, folder / "set"), "--json"],
        env=environment, stdout=subprocess.PIPE, text=True, check=False,
    )  # fmt: skip
    seconds, busy = time.perf_counter() - started, processor_seconds() - busy
    shutil.rmtree(folder)
    where = "" if args.device == "cpu" else f", {gpus} GPU{'s' * (gpus > 1)}"
    row = [f"`{fidelity}`", f"{'cold' if cold else 'warm'}{where}"]
    if made.returncode:
        return [*row, f"failed with {made.returncode}", f"{seconds:.1f}", *[""] * 6]
    data = json.loads(made.stdout)
    return [
        *row, f"{data['sweeps']:,}", f"{seconds:.1f}", f"{data['sweeps'] / seconds:,.1f}", f"{busy:.1f}",
        f"{data['steps']:,}", f"{data['steps_in_full']:,}", str(data["unstable"]), data["content_hash"],
    ]  # fmt: skip


def processor_seconds() -> float:
    """Return the processor time (s) of all processes that ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def machine() -> str:
    """Return the GPU and how many processors there are."""
    from brainbench.core.devices import usable_processors, warp

    names = [device.name for device in warp().get_cuda_devices()] or ["no GPU"]
    return f"{len(names)} × {names[0]}, {usable_processors()} processors"


if __name__ == "__main__":
    main()
