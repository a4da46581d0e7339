"""What gradients of many whiskers in contact cost on a device, and whether they are those of a processor.

``python -m benchmarks.whiskers.gradient_cost [--device cuda] [--each 1] [--links 11] [--readings 100]
[--write-input FILE] [--input FILE] [--write]``

``--write-input`` keeps the gradients of a processor, with which a machine compares that has no compiler for its own.
Every part is told as it ends. ``--compile-only`` compiles the kernels and says how long each takes; without a GPU too:

    python -m benchmarks.whiskers.precompile --pack FILE benchmarks/whiskers/gradient_cost.py --device cuda
    --compile-only

Times are those of the second round, when kernels are compiled; the first round stands beside it.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.report import publish, script_parser, table
from benchmarks.whiskers.gradients import BASE, FIDELITY, OBJECT
from brainbench.core.devices import pick_device
from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.engines.protocol import Job
from brainbench.stimuli.engines.rod.compilation import load_kernels
from brainbench.stimuli.engines.rod.kernels import BUILDING, build_adjoint
from brainbench.stimuli.engines.rod.launch import real_type
from brainbench.stimuli.engines.rod.packing import capacity_for
from brainbench.stimuli.engines.rod.tasks import PackedTasks, make_task
from brainbench.stimuli.gradients import GradientRun, JobParameters
from brainbench.stimuli.validation.contact_scenes import contact_jobs

NAMES = (*BASE[:3], *OBJECT[:3])
PARTS = ("ordinary run", "recorded run", "going back", "forward, all parameters")


def compile_kernels(jobs: list[Job], fidelity: Fidelity, device: str) -> None:
    """Compile what a measurement launches, and print how long each kernel takes."""
    where = pick_device(device)
    tasks = [task for job in jobs if (task := make_task(job, fidelity, {}, silent=True))]
    needs = PackedTasks.of(tasks, shared=False).shapes.needs
    capacity, hinges = capacity_for(fidelity.links), 3 if any(task.twists for task in tasks) else 2
    for recorded in (False, True):
        began = time.perf_counter()
        options = {"hinges": hinges, "recorded": recorded}
        kernels = load_kernels(where, real_type(fidelity), capacity, needs, **options)
        print(f"compiling: {PARTS[recorded]} {time.perf_counter() - began:.3g} s", flush=True)
    for part, module, name in (
        (PARTS[2], "chain", "reverse_segment"),
        (PARTS[3], "tangent", "tangent_segment"),
    ):
        began = time.perf_counter()
        with BUILDING:
            adjoint = build_adjoint(kernels, module)
        getattr(adjoint, name).module.load(where)
        print(f"compiling: {part} {time.perf_counter() - began:.3g} s", flush=True)


def measure(
    jobs: list[Job], fidelity: Fidelity, device: str
) -> tuple[dict[str, np.ndarray], dict[str, float], dict[str, float]]:
    """Return gradients by job and whether they hold on both sides, and the times (s) of :data:`PARTS` of both rounds.

    What is known is printed at once: a part may take minutes while kernels compile.
    """
    parameters = JobParameters(jobs, NAMES)
    rng = np.random.default_rng(0)
    weights = [rng.normal(size=(len(job.times), 6)) for job in jobs]
    engine = get_engine("rod", device=device)
    options = {"scales": parameters.scales, "fidelity": fidelity, "device": device}
    rounds: list[dict[str, float]] = []

    def timed(part: str, work: Callable[[], Any]) -> Any:
        began = time.perf_counter()
        found = work()
        rounds[-1][part] = time.perf_counter() - began
        print(f"round {len(rounds)}: {part} {rounds[-1][part]:.3g} s", flush=True)
        return found

    print(f"{len(jobs)} whiskers, {fidelity.links} links, {len(NAMES)} parameters on {device}", flush=True)
    for _ in range(2):
        rounds.append({})
        timed(PARTS[0], lambda: engine.run(jobs, fidelity, record_shape=True))
        run = timed(PARTS[1], lambda: GradientRun(parameters.build, parameters.values, **options))
        if len(rounds) == 1:
            print(f"         {run.describe()}", flush=True)
        gradient = timed(PARTS[2], lambda run=run: run.gradient(weights))
        timed(PARTS[3], run.tangents)
    smooth = np.array([event.status == "smooth" for event in gradient.events])
    return {"by_job": gradient.by_job, "smooth": smooth}, rounds[0], rounds[1]


def main() -> None:
    parser = script_parser(__doc__)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--each", type=int, default=1, help="scenes of each of the 72 combinations")
    parser.add_argument("--links", type=int, default=FIDELITY.links)
    parser.add_argument("--readings", type=int, help="keep so many readings, 1 ms apart, of each scene")
    parser.add_argument("--compile-only", action="store_true")
    parser.add_argument("--write-input", type=Path)
    parser.add_argument("--input", type=Path)
    args = parser.parse_args()
    jobs = [replace(job, times=job.times[: args.readings]) for job in contact_jobs(11, each=args.each)]
    fidelity = replace(FIDELITY, links=args.links)
    if args.compile_only:
        return compile_kernels(jobs, fidelity, args.device)
    found, first, seconds = measure(jobs, fidelity, args.device)
    if args.write_input:
        np.savez_compressed(args.write_input, allow_pickle=False, **found)
    where = pick_device(args.device)
    name = where.name if where.is_cuda else "2 shared cores"
    rows = [
        [part, f"{seconds[part]:.3g}", f"{seconds[part] / seconds[PARTS[0]]:.2f}", f"{first[part]:.3g}"]
        for part in PARTS
    ]
    length = f", first {args.readings} ms" if args.readings else ""
    text = f"{len(jobs)} whiskers in contact{length}, {args.links} links, .1 ms, double precision, "
    text += f"{len(NAMES)} parameters; "
    text += f"{name}.\n\n"
    text += table(["part", "s", "× ordinary run", "first time, s"], rows)
    if args.input:
        with np.load(args.input) as kept:
            both = kept["smooth"] & found["smooth"] & np.isfinite(kept["by_job"] + found["by_job"]).all(axis=1)
            error = np.abs(found["by_job"][both] - kept["by_job"][both]) / np.abs(kept["by_job"][both]).max(
                axis=1, keepdims=True
            )
        text += (
            f"\n\n{both.sum()} whiskers are smooth here and on a processor; their gradients differ by "
            f"{np.median(error.max(axis=1)):.2g} of the largest component in the median, {error.max():.2g} at most."
        )
    words = f"--device {args.device} --each {args.each}"
    words += f" --links {args.links}" * (args.links != FIDELITY.links)
    words += f" --readings {args.readings}" * bool(args.readings)
    publish(args, f"Gradients of many whiskers on a {name}", text, words, where=f"one {name}")


if __name__ == "__main__":
    main()
