"""Whiskers whose contacts touch the bent rod, beside the same on straight links, in scenes no table was measured on.

``python -m benchmarks.whiskers.contact_line [--seeds 11,12] [--meshes] [--write]``

The truth has 50 links, 20 µs, contact forces solved to 1e-6, and contacts on the rod; whiskers for which straight links
differ from it by more than 5 % there do not converge and are left out, counted. With ``--meshes`` objects are surfaces.
"""

from __future__ import annotations

import time

import numpy as np

from benchmarks.report import publish, script_parser, table
from brainbench.core.statistics import wilson_interval
from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.engines.fidelity import Fidelity
from tests.factories.contact_scenes import FLAT_OBJECTS, HARD_OBJECTS, contact_jobs, difference, meshed

TRUTH = "accurate,links=50,time_step=2e-5,steps_per_period=400,contact_tolerance=1e-6"
LINES = "links", "rod"
KINDS = ("post", "ball", "edge", *FLAT_OBJECTS, *HARD_OBJECTS)


def main() -> None:
    parser = script_parser(__doc__)
    parser.add_argument("--seeds", default="11,12")
    parser.add_argument("--meshes", action="store_true")
    options = parser.parse_args()
    engine, rows = get_engine("rod"), []
    for kind in (*KINDS, "hollow", "procedural") if options.meshes else KINDS:
        drawn = ("ball" if kind == "procedural" else kind,)
        jobs = [job for seed in options.seeds.split(",") for job in contact_jobs(int(seed), each=1, objects=drawn)]
        jobs = meshed(jobs, kind) if options.meshes else jobs
        truth, straight = (
            engine.run(jobs, Fidelity.parse(f"{TRUTH},contact_line={line}")) for line in ("rod", "links")
        )
        sound = [a.status == b.status == "ok" and difference(b, a) < 0.05 for a, b in zip(truth, straight, strict=True)]
        for preset in ("fast", "balanced", "accurate"):
            errors, spent = [], []
            for line in LINES:
                fidelity = Fidelity.parse(f"{preset},contact_line={line}")
                engine.run(jobs[:1], fidelity)
                start = time.process_time()
                traces = engine.run(jobs, fidelity)
                spent.append(time.process_time() - start)
                errors.append([difference(*pair) for pair, kept in zip(zip(traces, truth), sound) if kept])  # noqa: B905
            nearer = int(np.sum(np.less(errors[1], errors[0])))
            interval = wilson_interval(nearer, len(errors[0]))
            quantiles = (f"{np.median(some):.1%}, {np.quantile(some, 0.9):.1%}" for some in errors)
            share = f"{nearer}/{len(errors[0])} [{interval.low:.0%}, {interval.high:.0%}]"
            rows.append([kind, f"`{preset}`", f"{len(errors[0])}", *quantiles, share, f"{spent[1] / spent[0]:.2f}"])
        print(rows[-3:], f"{len(jobs) - sum(sound)} left out", flush=True)
    head = ["objects", "preset", "whiskers", "straight links: median, 90 %", "bent rod", "nearer [95 %]", "time"]
    title = "Contacts of meshes on the bent rod" if options.meshes else "Contacts on the bent rod, in random scenes"
    publish(options, title, table(head, rows), f"--seeds {options.seeds}" + " --meshes" * options.meshes)


if __name__ == "__main__":
    main()
