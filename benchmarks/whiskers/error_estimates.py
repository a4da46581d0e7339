"""Does the estimated error of a whisker cover its true one?

    python -m benchmarks.whiskers.error_estimates [--seeds 11,12] [--every 1] [--write]

Whiskers in contacts of all kinds, single and opposed, against a converged simulation. The estimate covers the error
when it is no smaller.
"""

from __future__ import annotations

import numpy as np

from benchmarks.report import publish, script_parser, table
from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.engines.error_estimates import difference
from brainbench.stimuli.engines.fidelity import Fidelity, list_presets
from brainbench.stimuli.validation.contact_scenes import HARD, contact_jobs

REFERENCE = Fidelity(links=40, time_step=1e-5, precision="double", contact_tolerance=1e-9)
KINDS = (*HARD, "post", "edge")


def main() -> None:
    parser = script_parser(__doc__)
    parser.add_argument("--seeds", default="11,12", help="of the scenes, with commas between them")
    parser.add_argument("--every", type=int, default=1, help="take every so many-th whisker")
    args = parser.parse_args()
    jobs = [
        job for seed in args.seeds.split(",") for job in contact_jobs(int(seed), each=1, objects=KINDS)[:: args.every]
    ]
    references = get_engine("rod").run(jobs, REFERENCE)
    rows = []
    for preset in list_presets():
        traces = get_engine("rod", errors=True).run(jobs, Fidelity.preset(preset))
        pairs = []
        for job, trace, reference in zip(jobs, traces, references, strict=True):
            if trace.status == reference.status == "ok" and reference.contact.any():
                touching, length = trace.contact | reference.contact, job.whisker.arc_length
                pairs.append((difference(trace.wrench, reference.wrench, touching, length).max(), trace.error))
        true, estimated = np.array(pairs).T
        tails = [f"{value:.1%}" for value in np.quantile(true, [0.5, 0.9, 1])]
        ratios = [f"{value:.1f}" for value in np.quantile(estimated / true, [0.5, 0.9])]
        covered = np.sum(estimated >= true)
        rows.append(
            [
                f"`{preset}`",
                f"{len(true)}",
                ", ".join(tails),
                f"{covered} ({covered / len(true):.0%})",
                ", ".join(ratios),
            ]
        )
        print(*rows[-1], sep=" | ", flush=True)
    head = [
        "preset",
        "whiskers",
        "true error: median, 90 %, worst",
        "covered",
        "estimate over true error: median, 90 %",
    ]
    body = f"Kinds of contact: {', '.join(KINDS)}; seeds {args.seeds}.\n\n" + table(head, rows)
    publish(args, "Estimated errors of whiskers", body, f"--seeds {args.seeds} --every {args.every}")


if __name__ == "__main__":
    main()
