"""What the tolerance of contact forces costs in accuracy and time, in the engines ``rod`` and ``mujoco``.

python -m benchmarks.whiskers.contact_tolerance [--each 1] [--write]

Random scenes of contact at the same links and steps, beside the same engine with contact forces solved to 1e-10.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from benchmarks.report import publish, script_parser, table
from brainbench.stimuli import Fidelity
from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.tradeoff import SimulationSetting, run_for_cost
from brainbench.stimuli.validation.contact_scenes import FRICTIONS, contact_jobs, difference

FIDELITY = Fidelity(links=12, time_step=1e-4, precision="double")
SOLVED = 1e-10
TOLERANCES = (None, 1e-4, 1e-6)
SHARES = {"median": 0.5, "90 %": 0.9, "95 %": 0.95}


def main() -> None:
    parser = script_parser(__doc__)
    parser.add_argument("--each", type=int, default=1, help="scenes of each of the 72 combinations")
    args = parser.parse_args()
    jobs = contact_jobs(5, each=args.each)
    friction = np.array([job.obstacles[0].friction for job in jobs])
    settings = [SimulationSetting(replace(FIDELITY, contact_tolerance=each)) for each in TOLERANCES]
    settings += [SimulationSetting(replace(item.fidelity, precision="single")) for item in (settings[0], settings[-1])]
    settings += [replace(item, backend="mujoco") for item in settings[:3]]
    references = {
        name: get_engine(name).run(jobs, replace(FIDELITY, contact_tolerance=SOLVED, twist=True))
        for name in ("rod", "mujoco")
    }
    rows = []
    for setting in settings:
        traces, cost = run_for_cost(setting, jobs)
        pairs = list(zip(traces, references[setting.backend], strict=True))
        trusted = np.array([reference.status == "ok" for _, reference in pairs])
        errors = 100 * np.array([difference(*pair) if pair[1].status == "ok" else np.inf for pair in pairs])
        steps, unsolved = (np.array([getattr(trace, name) for trace in traces]) for name in ("steps", "unsolved"))
        tolerance, words = setting.fidelity.contact_tolerance, (setting.backend, setting.fidelity.precision)
        name = ", ".join(words if setting.backend == "rod" else words[:1])
        for mu in FRICTIONS:
            some = trusted & (friction == mu)
            counted = f"{unsolved[some].sum() / steps[some].sum():.2%}" if setting.backend == "rod" else "–"
            bounds = [f"{np.quantile(errors[some], share, method='higher'):.2g}" for share in SHARES.values()]
            asked = "few iterations" if tolerance is None else f"{tolerance:g}"
            rows.append([name, asked, f"{mu:g}", str(some.sum()), *bounds, counted, f"{cost:.3f}"])
            print(*rows[-1], sep=" | ", flush=True)
    head = ["engine", "`contact_tolerance`", "friction", "scenes", *(f"error %, {name}" for name in SHARES)]
    head += ["steps not solved", "processor s / whisker-s"]
    text = (
        "Difference of base force or moment (root mean square, the larger) from the same engine, links and steps with "
        f"contact forces solved to {SOLVED:g}. 12 links, .1 ms. Few iterations are those of a fidelity without "
        "`contact_tolerance`: sweeps end at 1e-4 as well, but after at most 8, each with at most 8 iterations for the "
        "direction in which a contact slips. Steps that were not solved are those in which either did not suffice. "
        "Cost is that of all frictions together.\n\n" + table(head, rows)
    )
    publish(args, "Contact forces solved to a tolerance", text)


if __name__ == "__main__":
    main()
