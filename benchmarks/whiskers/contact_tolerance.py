"""What the tolerance of contact forces costs in accuracy: ordinary runs beside runs solved to rounding.

python -m benchmarks.whiskers.contact_tolerance [--each 1] [--write]

Runs of gradients solve the contact forces of each step to rounding (``rod/kernels/contact_solver.py``), ordinary runs
to .1 µm or 1e-4 of the forces. Two controls, both solved to rounding, tell whether a difference matters: steps shorter
by .1 %, which show how far any small change is carried by sticking and slipping, and half the steps.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import replace

import numpy as np

from benchmarks.report import table, write_section
from brainbench.stimuli import Fidelity
from brainbench.stimuli.engines.protocol import Job, Trace
from brainbench.stimuli.engines.rod.engine import RodEngine
from brainbench.stimuli.gradients import GradientRun
from brainbench.stimuli.validation.contact_scenes import FRICTIONS, contact_jobs, difference

FIDELITY = Fidelity(links=12, time_step=1e-4, precision="double")
RUNS = {"ordinary": None, "to rounding, steps × .999": 0.999, "to rounding, steps / 2": 0.5}
"""Share of the time step of each run that is solved to rounding."""


def exact(job: Job, share: float = 1.0) -> Trace:
    """Return the run of a job whose contact forces are solved to rounding."""
    fidelity = replace(FIDELITY, time_step=share * FIDELITY.time_step)
    return GradientRun(lambda _: [job], [1.0], fidelity=fidelity).traces[0]


def largest(trace: Trace, reference: Trace) -> float:
    """Return the largest difference of the base force over the largest force."""
    gap = np.linalg.norm(trace.wrench[:, :3] - reference.wrench[:, :3], axis=1).max()
    return float(gap / np.linalg.norm(reference.wrench[:, :3], axis=1).max()) if trace.status == "ok" else math.inf


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--each", type=int, default=1, help="scenes of each of the 72 combinations")
    parser.add_argument("--write", action="store_true")
    args = parser.parse_args()
    jobs, engine = contact_jobs(5, each=args.each), RodEngine("cpu", retry=1)
    references = [exact(job) for job in jobs]
    rows = []
    for name, share in RUNS.items():
        traces = [engine.run([job], FIDELITY)[0] if share is None else exact(job, share) for job in jobs]
        for friction in FRICTIONS:
            pairs = [
                (trace, reference)
                for job, trace, reference in zip(jobs, traces, references, strict=True)
                if job.obstacles[0].friction == friction and reference.status == "ok"
            ]
            cells = [str(len(pairs))]
            for measure in (difference, largest):
                found = [100 * measure(*pair) for pair in pairs]
                cells += [f"{np.quantile(found, q, method='higher'):.2g}" for q in (0.5, 0.9, 1.0)]
            rows.append([name, f"{friction:g}", *cells])
            print(*rows[-1], sep=" | ", flush=True)
    head = ["run", "friction", "scenes"] + [
        f"{what} %, {q}" for what in ("rms", "peak") for q in ("median", "90 %", "worst")
    ]
    text = (
        "Base force and moment of random scenes of contact beside the same steps with contact forces solved to "
        "rounding: rms difference over the rms, and largest difference of the force over the largest force. 12 links, "
        ".1 ms, "
        "double precision, without second tries; inf: not trusted.\n\n" + table(head, rows)
    )
    if args.write:
        write_section(
            "Contact forces solved to rounding",
            "python -m benchmarks.whiskers.contact_tolerance --write",
            text,
            subject="whiskers",
        )


if __name__ == "__main__":
    main()
