"""What adaptive time steps would give ``rod`` in contact: a trial that the engine does not hold.

python -m benchmarks.whiskers.adaptive_steps [--write]

The trial changes a copy of the kernels: the error of a step is ½ h² |a| (mm) with the acceleration a of the tip, the
first term that an implicit Euler step leaves out; the next step is h √(tolerance / error) · 0.9, at most twice as long,
between the longest step and a part of it; a step in contact whose error is more than a few times the tolerance is taken
again. Errors are those of benchmarks/whiskers/rod_steps.py, against steps of .05 ms in double precision.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Literal

import numpy as np

from benchmarks.report import publish, script_parser, table
from benchmarks.whiskers.rod_steps import FELT, Fidelity, errors, pick_sweeps, run

FIXED = (1e-3, 5e-4, 2e-4, 1e-4)
"""Steps (s) without the trial."""
TRIALS = (
    (1e-3, 1e-2, 20, 4),
    (5e-4, 1e-2, 20, 4),
    (2e-3, 1e-3, 16, 4),
    (1e-3, 1e-3, 20, 4),
    (5e-4, 1e-3, 20, 4),
    (2e-3, 3e-4, 40, 2),
)
"""Longest step (s), tolerance (mm), longest over shortest step, and errors over the tolerance that are taken again."""
CHANGES = {
    "state.py": (
        (
            "    largest_change: real\n",
            "    next_step: real\n    largest_change: real\n",
        ),
    ),
    "step.py": (
        ("import warp as wp\n", "import warp as wp\n\nTOLERANCE, RATIO, AGAIN = {tolerance}, {ratio}, {again}\n"),
        (
            "    pace = state.top_speed",
            "    if state.next_step > real(0.0):\n"
            "        wanted = wp.min(wanted, state.next_step)\n"
            "    pace = state.top_speed",
        ),
        (
            "            state.contacts = int(0)\n            touched = int(0)\n",
            "            rate = tip_acceleration\n"
            "            if solved == 1:\n"
            "                rate = problems.solution[index].tip_acceleration\n"
            "            error = wp.max(real(0.5) * h * h * wp.length(rate), real(1e-12))\n"
            "            longest = job.longest_step\n"
            "            least = longest / real(wp.static(RATIO))\n"
            "            share = real(0.9) * wp.sqrt(real(wp.static(TOLERANCE)) / error)\n"
            "            state.next_step = wp.clamp(h * wp.clamp(share, real(0.1), real(2.0)), least, longest)\n"
            "            if count > 0 and error > real(wp.static(AGAIN * TOLERANCE)) and h > real(1.01) * least:\n"
            "                if solved == 1:\n"
            "                    state.contacts = problems.solution[index].contacts\n"
            "                left = left_whole\n"
            "                last = int(0)\n"
            "                continue\n"
            "            state.contacts = int(0)\n            touched = int(0)\n",
        ),
    ),
}
"""Text of the kernels and what stands in its place."""


def measure(step: float, precision: Literal["single", "double"], folder: Path) -> None:
    """Simulate the sweeps in this process and keep what was found in a file of ``folder``."""
    scenes, picked = pick_sweeps(["procedural-24:1"], "thesis-high", 3)
    found = run(scenes, picked, Fidelity(links=12, time_step=step, precision=precision))
    arrays = {name: found.pop(name) for name in ("wrench", "flagged")}
    np.savez(folder / "found.npz", **arrays)
    (folder / "found.json").write_text(json.dumps({**found, "sweeps": sum(map(len, picked.values()))}))


def trial(folder: Path, tolerance: float, ratio: float, again: float) -> Path:
    """Return a copy of this repository's code whose kernels adapt their steps."""
    root = Path(__file__).resolve().parents[2]
    copy = folder / "trial"
    for name in ("brainbench", "benchmarks"):
        shutil.copytree(root / name, copy / name, ignore=shutil.ignore_patterns("__pycache__"), dirs_exist_ok=True)
    for name, changes in CHANGES.items():
        path = copy / "brainbench/stimuli/engines/rod/kernels" / name
        text = path.read_text()
        for old, new in changes:
            if text.count(old) != 1:
                raise SystemExit(f"{name} has changed: {old!r} is no longer found once; the trial must follow it.")
            text = text.replace(old, new.format(tolerance=tolerance, ratio=ratio, again=again))
        path.write_text(text)
    return copy


def simulate(root: Path, step: float, folder: Path, precision: str = "single") -> dict:
    """Return what the code in ``root`` finds, in a process of its own."""
    command = [sys.executable, "-m", "benchmarks.whiskers.adaptive_steps"]
    command += ["--step", f"{step:g}", "--precision", precision, "--folder", str(folder)]
    subprocess.run(command, cwd=root, env={**os.environ, "PYTHONPATH": str(root)}, check=True, capture_output=True)
    return {**np.load(folder / "found.npz"), **json.loads((folder / "found.json").read_text())}


def speed_gains(fixed: np.ndarray, trial: np.ndarray) -> list[float]:
    """Return the speed of a trial over that of equal steps with each of its errors; logarithms of speed and errors.

    ``fixed`` [step, 1 + error] are those of equal steps, from the longest on.
    """
    order = fixed[::-1]
    return [float(np.exp(trial[0] - np.interp(trial[k], order[:, k], order[:, 0]))) for k in range(1, len(trial))]


def main() -> None:
    parser = script_parser(__doc__)
    parser.add_argument("--step", type=float, help=argparse.SUPPRESS)
    parser.add_argument("--precision", default="single", help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.step is not None:
        measure(args.step, args.precision, args.folder)
        return
    root = Path(__file__).resolve().parents[2]
    rows, fixed = [], []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        reference = simulate(root, 5e-5, folder, "double")

        def add(first: list[str], found: dict) -> None:
            misses = errors(found, reference)
            miss = [100 * np.quantile(misses[name], q) for name in ("moment", "force") for q in (0.5, 0.9)]
            speed = found["sweeps"] / found["seconds"]
            gains = ["–"] * 4
            if first[1] == "–":
                fixed.append([speed, *miss])
            else:
                gains = [f"{gain:.2f}" for gain in speed_gains(np.log(fixed), np.log([speed, *miss]))]
            numbers = (f"{x:.2g}" for x in miss)
            flagged = f"{found['flagged'].mean():.1%}"
            rows.append([*first, f"{speed:.1f}", f"{found['steps'] / 1e6:.2f}", *numbers, flagged, *gains])
            print(rows[-1], flush=True)

        for step in FIXED:
            add([f"{step * 1e3:g}", "–", "–"], simulate(root, step, folder))
        for step, tolerance, ratio, again in TRIALS:
            found = simulate(trial(folder, tolerance, ratio, again), step, folder)
            add([f"{step * 1e3:g}", f"{step / ratio * 1e3:.3g}", f"{tolerance * 1e3:g}"], found)
    head = [
        "longest step ms", "shortest", "tolerance µm", "sweeps / processor s", "million steps", "moment % median",
        "90th", "force % median", "90th", "whiskers flagged", "speed at equal moment median", "90th",
        "at equal force median", "90th",
    ]  # fmt: skip
    text = (
        "72 sweeps of thesis-high over procedural-24:1 (30 whiskers × 12 links, 1 s each); root mean square of what "
        "differs from steps of 0.05 ms in double precision, of each whisker's own peak, whiskers of more than "
        f"{FELT * 1e6:g} µN. Rows without a tolerance have equal steps; the last columns are the speed over that of "
        "equal steps with the same error, between these rows (beyond them, over the nearest). A trial: the engine has "
        "no such option.\n\n" + table(head, rows)
    )
    publish(args, "A trial of adaptive time steps in rod", text)


if __name__ == "__main__":
    main()
