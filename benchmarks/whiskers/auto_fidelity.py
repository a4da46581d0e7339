"""Does ``Fidelity.auto`` keep its promise in scenes that it was not measured in?

    python -m benchmarks.whiskers.auto_fidelity --write
    python -m benchmarks.whiskers.auto_fidelity --finer --write      # is the converged simulation converged?
    python -m benchmarks.whiskers.auto_fidelity --engines --write    # the other engines in the same scenes

Scenes of contact of other seeds than the table's, against the converged simulation of the table. A promise is kept when
90 % of the whiskers stay below the error that was asked for.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from benchmarks.report import publish, script_parser, table
from brainbench.core.statistics import wilson_interval
from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.motion.jobs import Job, Trace
from brainbench.stimuli.validation.bench_tests import FRICTIONS, contact_jobs, difference
from brainbench.tradeoffs.whiskers import REFERENCE, SimulationSetting, run_for_cost

ERRORS = (0.4, 0.2, 0.1, 0.07, 0.05)
FINER = (
    Fidelity(links=60, time_step=5e-6, precision="double", contact_tolerance=1e-9),
    Fidelity(links=40, time_step=5e-6, contact_tolerance=1e-6),
)


def main() -> None:
    parser = script_parser(__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--finer", action="store_true", help="compare finer settings with the converged simulation")
    parser.add_argument("--engines", action="store_true", help="compare engines, by friction, in place of settings")
    args = parser.parse_args()
    if args.engines or args.finer:
        (engines if args.engines else finer)(args)
        return
    jobs = contact_jobs(args.seed)
    found = get_engine(REFERENCE.backend).run(jobs, REFERENCE.fidelity.resolved(True))
    kept = [i for i, trace in enumerate(found) if trace.status == "ok" and trace.contact.any()]
    jobs, references = [jobs[i] for i in kept], [found[i] for i in kept]
    rows = []
    for error in ERRORS:
        fidelity = Fidelity.auto(error=error)
        errors, cost = compare(SimulationSetting(fidelity), jobs, references)
        below = np.mean(errors <= error)
        interval = wilson_interval(float(np.sum(errors <= error)), len(errors), over="whiskers")
        setting = f"{fidelity.links} links, {fidelity.time_step * 1e3:g} ms, {fidelity.steps_per_period:g} a period"
        setting += f", {fidelity.links_per_mm:g} links per mm" if fidelity.links_per_mm else ""
        setting += f", contacts to {fidelity.contact_tolerance:g}" if fidelity.contact_tolerance else ""
        share = f"{below:.1%} [{interval.low:.1%}, {interval.high:.1%}]"
        rows.append([f"{error:.0%}", setting, share, f"{np.median(errors):.2%}", f"{cost:.3f}"])
        print(*rows[-1], sep=" | ", flush=True)
    body = (
        f"{len(jobs)} whiskers (seed {args.seed}; {len(found) - len(jobs)} start inside an object or touch nothing): "
        "mouse and rat, post, ball, edge and hollow, friction 0, .4 and .8, whisking at 5, 10 and 20 Hz. Error: root "
        "mean square over time of base force or moment, whichever is larger, relative to the converged simulation "
        "(40 links, 10 µs, double precision, contact forces solved to 1e-9).\n\n"
        + table(["asked for", "`Fidelity.auto`", "whiskers below it", "median error", "processor s / whisker-s"], rows)
    )
    publish(args, "Settings chosen for an error", body)


def finer(args: argparse.Namespace) -> None:
    """Compare finer settings with the converged simulation, in every sixth of the scenes."""
    jobs, rows = contact_jobs(1)[::6], []
    references = get_engine(REFERENCE.backend).run(jobs, REFERENCE.fidelity.resolved(True))
    for fidelity in FINER:
        errors, cost = compare(SimulationSetting(fidelity), jobs, references)
        bounds = [f"{np.quantile(errors, share, method='higher'):.2%}" for share in (0.5, 0.9, 0.95)]
        name = f"{fidelity.links} links, {fidelity.time_step * 1e6:g} µs, {fidelity.precision}"
        rows.append([name, *bounds, f"{cost:.2f}"])
        print(*rows[-1], sep=" | ", flush=True)
    body = (
        f"{len(jobs)} whiskers beside the converged simulation (40 links, 10 µs, double precision); so many per cent "
        "of them stay below.\n\n" + table(["setting", "50 %", "90 %", "95 %", "processor s / whisker-s"], rows)
    )
    publish(args, "Settings finer than the converged simulation", body, "--finer")


def engines(args: argparse.Namespace) -> None:
    """Compare ``mujoco`` and, in some short scenes, ``bullet`` with ``rod`` in double precision, by friction."""
    accurate, rows = Fidelity.preset("accurate"), []
    for friction in FRICTIONS:
        jobs = [job for job in contact_jobs(0, each=1) if job.obstacles[0].friction == friction]
        for backend in ("mujoco", "bullet"):
            some = [job for job in jobs if len(job.times) < 200][:6] if backend == "bullet" else jobs
            twist = get_engine(backend).twists
            references = get_engine("rod").run(some, replace(accurate, precision="double", twist=twist))
            errors, cost = compare(SimulationSetting(accurate, backend), some, references)
            bounds = [f"{np.quantile(errors, share, method='higher'):.1%}" for share in (0.5, 0.9)]
            rows.append([f"{friction:g}", backend, str(len(some)), *bounds, f"{cost:.2f}"])
            print(*rows[-1], sep=" | ", flush=True)
    body = (
        "Difference from `rod` (`accurate`, double precision): base force or moment, root mean square, the larger.\n\n"
    )
    body += table(["friction", "engine", "whiskers", "median", "90 % below", "processor s / whisker-s"], rows)
    publish(args, "Engines in random scenes of contact", body, "--engines")


def compare(setting: SimulationSetting, jobs: Sequence[Job], references: Sequence[Trace]) -> tuple[np.ndarray, float]:
    """Return the errors [n] of a setting, and its cost in processor s per whisker-second."""
    traces, cost = run_for_cost(setting, jobs)
    return np.array([difference(*pair) for pair in zip(traces, references, strict=True)]), cost


if __name__ == "__main__":
    main()
