"""Sweeps per processor second of ``rod``, ``mujoco`` and ``bullet`` at each setting, beside the error of that setting.

python -m benchmarks.whiskers.rod_cpu [--sweeps 10] [--whiskers 6] [--write]

The sweeps of benchmarks/whiskers/rod_agreement.py with friction. Each engine's error is against itself at 10 µs
(``rod`` with 40
links as well), so that the engines' different laws of friction do not count: root mean square of the moment over the
sweep, of the whisker's own peak, median over the whiskers that are bent.
"""

from __future__ import annotations

import time

import numpy as np

from benchmarks.report import publish, script_parser, table
from benchmarks.whiskers.rod_agreement import FELT, FINER, SHAPES, draw, wrenches
from brainbench.stimuli import Fidelity, simulate
from brainbench.stimuli.objects.collections import resolve_objects

SETTINGS = {
    "rod": (
        "balanced,links=8,time_step=1e-3,steps_per_period=none",
        "balanced,links=12,time_step=1e-3,steps_per_period=none",
        "balanced,links=12,time_step=5e-4,steps_per_period=none",
        "balanced,links=20,time_step=5e-4,steps_per_period=none",
        "balanced,links=20,time_step=2e-4,steps_per_period=none",
        "fast",
        "balanced",
        "accurate",
    ),
    "mujoco": ("fast", "balanced", "accurate"),
    "bullet": ("fast", "balanced"),
}
FEW = 2
"""Sweeps for ``bullet``, which takes the longest."""


def main() -> None:
    parser = script_parser(__doc__)
    parser.add_argument("--sweeps", type=int, default=10)
    parser.add_argument("--whiskers", type=int, default=6)
    args = parser.parse_args()
    objects = resolve_objects(SHAPES.split(","), collision="hull")
    drawn = draw(objects, args.sweeps, args.whiskers, None, 0.48)
    rows = []
    for backend, settings in SETTINGS.items():
        scenes = drawn[:FEW] if backend == "bullet" else drawn
        finest = Fidelity.parse("accurate,links=40,time_step=1e-5,steps_per_period=none") if backend == "rod" else FINER
        finest = Fidelity(links=10, time_step=2e-5) if backend == "bullet" else finest
        truth = wrenches(scenes, finest, backend)[..., 3:]
        peak = np.linalg.norm(truth, axis=-1).max(axis=1)
        for text in settings:
            fidelity = Fidelity.parse(text)
            simulate(scenes[:1], fidelity=fidelity, backend=backend, cache=False)
            started = time.process_time()
            found = wrenches(scenes, fidelity, backend, cache=False)[..., 3:]
            spent = time.process_time() - started
            miss = np.sqrt((np.linalg.norm(found - truth, axis=-1) ** 2).mean(axis=1)) / np.maximum(peak, 1e-30)
            some = miss[(peak > FELT[1]) & np.isfinite(miss)]
            bad = int((~np.isfinite(found).all(axis=(1, 2))).sum())
            whisker_seconds = len(scenes) * args.whiskers * 0.99
            errors = [f"{100 * np.quantile(some, q):.2g}" for q in (0.5, 0.9)]
            costs = [f"{1e3 * spent / whisker_seconds:.3g}", f"{whisker_seconds / 30 / spent:.3g}"]
            rows.append([backend, text, *errors, f"{bad}", *costs])
            print(rows[-1], flush=True)
    head = ["engine", "setting", "moment error %", "90th", "unstable whiskers", "processor ms / whisker s"]
    text = (
        f"{args.sweeps} sweeps of thesis-high over hulls, {args.whiskers} whiskers each ({FEW} for bullet, whose error "
        "is against 10 links at 20 µs); compiling left out.\n\n"
        + table([*head, "sweeps of 30 whiskers / processor s"], rows)
    )
    publish(args, "rod, mujoco and bullet on a processor", text)


if __name__ == "__main__":
    main()
