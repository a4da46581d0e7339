"""Friction of each engine: whiskers dragged over a peg and a ball, beside a reference that no engine here shares.

python -m benchmarks.whiskers.friction_reference [--whiskers C2,B1,D3] [--links 12] [--write]

The reference is that of ``tests/factories/friction_reference.py``. Per cent of the whisker's own peak, as in
``rod_agreement.py``.
"""

from __future__ import annotations

import time

import numpy as np

from benchmarks.report import publish, script_parser, table
from benchmarks.whiskers.rod_agreement import HOW
from brainbench.stimuli import Fidelity
from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.whiskers.array import WhiskerArray
from tests.factories.friction_reference import CREEP, RELAXATION, SPEED, STIFFNESS, Passing, Penalty, misses, solve

ENGINES = ("rod", 50), ("rod", 100), ("rod", 500), ("mujoco", 50), ("mujoco", 10), ("mujoco", 2), ("bullet", 50)


def main() -> None:
    parser = script_parser(__doc__)
    parser.add_argument("--whiskers", default="C2,B1,D3")
    parser.add_argument("--links", type=int, default=12)
    parser.add_argument("--duration", type=float, default=0.4)
    args = parser.parse_args()
    rows: list[list[str]] = []
    for friction in (0.0, 0.48):
        gathered: dict[str, list[list[float]]] = {}
        for name in args.whiskers.split(","):
            for shape in ("peg", "ball"):
                passing = Passing.of(WhiskerArray.mouse()[name].whisker, shape, friction)
                begun = time.process_time()
                times, truth = solve(Penalty(passing, args.links), args.duration)
                until = f"{name} {shape}, friction {friction:g}: until {1e3 * times[-1]:.0f} ms"
                peak = 1e6 * np.linalg.norm(truth[:, :3], axis=1).max()
                print(f"{until}, peak {peak:.0f} µN, {time.process_time() - begun:.0f} s", flush=True)
                # What the reference itself is worth.
                stiffer = Penalty(passing, args.links, 2.5 * STIFFNESS, RELAXATION / 2, CREEP / 2)
                other, again = solve(stiffer, args.duration)
                both = min(len(times), len(other))
                gathered.setdefault("the reference itself, 2.5 × as stiff, half the creep", []).append(
                    misses(again[:both], truth[:both])
                )
                for backend, step in ENGINES:
                    fidelity = Fidelity(links=args.links, time_step=1e-6 * step)
                    trace = get_engine(backend).run([passing.job(args.duration)], fidelity)[0]
                    key = f"{backend}, {step} µs"
                    gathered.setdefault(key, []).append(misses(trace.wrench[: len(truth)], truth))
        for key, values in gathered.items():
            middle, worst = np.median(values, axis=0), np.max(values, axis=0)
            cells = [f"{a:.2g} ({b:.2g})" for a, b in zip(middle, worst, strict=True)]
            rows.append([key, f"{friction:g}", *cells])
            print(rows[-1], flush=True)
    head = ["", "friction", *(f"{what} {one}" for what in ("force", "moment") for one in HOW)]
    text = (
        f"Mouse whiskers {args.whiskers} of {args.links} links; a tilted peg (radius .5 mm) or a ball (3 mm) passes at "
        f"{1e3 * SPEED:g} mm/s, until the whisker slips off. Per cent of the whisker's own peak, median of the "
        f"{2 * len(args.whiskers.split(','))} passings and in brackets the worst. The reference: BDF, contact "
        f"{STIFFNESS:g} N/m, friction viscous below {1e6 * CREEP:g} µm/s.\n\n" + table(head, rows)
    )
    publish(args, "Friction beside an independent reference", text)


if __name__ == "__main__":
    main()
