"""What gradients of many whiskers in contact cost on a device, and whether they are those of a processor.

``python -m benchmarks.whiskers.gradient_cost [--device cuda] [--each 1] [--write-input FILE] [--input FILE] [--write]``

``--write-input`` keeps the gradients of a processor, with which a machine compares that has no compiler for its own.
Times are those of a second round, when kernels are compiled.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from benchmarks.report import table, write_section
from benchmarks.whiskers.gradients import BASE, FIDELITY, OBJECT
from brainbench.core.devices import pick_device
from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.gradients import GradientRun, JobParameters
from brainbench.stimuli.validation.contact_scenes import contact_jobs

NAMES = (*BASE[:3], *OBJECT[:3])
PARTS = ("ordinary run", "recorded run", "going back", "forward, all parameters")


def measure(each: int, device: str) -> tuple[dict[str, np.ndarray], list[float]]:
    """Return gradients by job and whether they hold on both sides, and the times (s) of :data:`PARTS`."""
    jobs = contact_jobs(11, each=each)
    parameters = JobParameters(jobs, NAMES)
    rng = np.random.default_rng(0)
    weights = [rng.normal(size=(len(job.times), 6)) for job in jobs]
    engine = get_engine("rod", device=device)
    for _ in range(2):
        clock = [time.perf_counter()]
        engine.run(jobs, FIDELITY, record_shape=True)
        clock.append(time.perf_counter())
        options = {"scales": parameters.scales, "fidelity": FIDELITY, "device": device}
        run = GradientRun(parameters.build, parameters.values, **options)
        clock.append(time.perf_counter())
        gradient = run.gradient(weights)
        clock.append(time.perf_counter())
        run.tangents()
        clock.append(time.perf_counter())
    smooth = np.array([event.status == "smooth" for event in gradient.events])
    return {"by_job": gradient.by_job, "smooth": smooth}, np.diff(clock).tolist()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--each", type=int, default=1, help="scenes of each of the 72 combinations")
    parser.add_argument("--write-input", type=Path)
    parser.add_argument("--input", type=Path)
    parser.add_argument("--write", action="store_true")
    args = parser.parse_args()
    found, seconds = measure(args.each, args.device)
    if args.write_input:
        np.savez_compressed(args.write_input, allow_pickle=False, **found)
    where = pick_device(args.device)
    name = where.name if where.is_cuda else "2 shared cores"
    rows = [[part, f"{value:.3g}", f"{value / seconds[0]:.2f}"] for part, value in zip(PARTS, seconds, strict=True)]
    text = f"{len(found['smooth'])} whiskers in contact, 11 links, .1 ms, double precision, {len(NAMES)} parameters; "
    text += f"{name}.\n\n"
    text += table(["part", "s", "× ordinary run"], rows)
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
    print(text)
    if args.write:
        command = f"python -m benchmarks.whiskers.gradient_cost --device {args.device} --each {args.each} --write"
        write_section(f"Gradients of many whiskers on a {name}", command, text, subject="whiskers", where=f"one {name}")


if __name__ == "__main__":
    main()
