"""Processor time of ``rod`` in contact before a change and after it, side by side, and whether a single bit differs.

python -m benchmarks.whiskers.contact_step --before CHECKOUT [--rounds 3] [--write]

``CHECKOUT`` is a folder with another version of this repository (``git worktree add CHECKOUT COMMIT``). Both simulate
the sweeps of benchmarks/whiskers/rod_steps.py, in turn, each in processes of its own.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path

from benchmarks.report import table, write_section

STEPS = (1e-3, 5e-4, 2e-4)
MEASURE = """
import hashlib, json, sys
import numpy as np
from benchmarks.whiskers.rod_steps import GRIDS, Fidelity, SweepScenes, resolve_objects, run

objects = resolve_objects(["procedural-24:1"], surfaces=True)
scenes = SweepScenes(GRIDS["thesis-high"], {name: item.load for name, item in objects.items()})
picked = {}
for name in scenes.objects:
    sweeps = scenes.grid.sweeps(name)
    picked[name] = [sweeps[k] for k in np.linspace(3, len(sweeps) - 4, 3).astype(int)]
    scenes.solid(name)
found = run(scenes, picked, Fidelity(links=12, time_step=float(sys.argv[1])))
bits = hashlib.sha256(found["wrench"].tobytes() + found["flagged"].tobytes()).hexdigest()
numbers = {name: found[name] for name in ("steps", "touching", "seconds")}
print(json.dumps({"sweeps": sum(map(len, picked.values())), "bits": bits, **numbers}))
"""


def measure(checkout: Path, step: float) -> dict:
    """Steps, processor seconds and the hash of all numbers of one version."""
    command = [sys.executable, "-c", MEASURE, f"{step:g}"]
    done = subprocess.run(
        command,
        check=False,
        cwd=checkout,
        env={**os.environ, "PYTHONPATH": str(checkout)},
        capture_output=True,
        text=True,
    )
    if done.returncode:
        raise SystemExit(done.stderr)
    return json.loads(done.stdout.splitlines()[-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--before", type=Path, required=True, help="checkout of the version to compare with")
    parser.add_argument("--rounds", type=int, default=3, help="the least processor time of so many runs counts")
    parser.add_argument("--write", action="store_true")
    args = parser.parse_args()
    versions = args.before.resolve(), Path(__file__).resolve().parents[2]
    rows = []
    for step in STEPS:
        runs = [[measure(version, step) for version in versions] for _ in range(args.rounds)]
        old, new = (min((pair[k] for pair in runs), key=lambda one: one["seconds"]) for k in range(2))
        costs = [1e6 * one["seconds"] / one["steps"] for one in (old, new)]
        costs += [one["sweeps"] / one["seconds"] for one in (old, new)]
        ratio = old["seconds"] / new["seconds"]
        same = "yes" if old["bits"] == new["bits"] else "no"
        numbers = [f"{x:.1f}" for x in costs]
        rows.append([f"{step * 1e3:g}", f"{new['touching'] / new['steps']:.0%}", *numbers, f"{ratio:.2f}", same])
        print(rows[-1], flush=True)
    head = [
        "step ms", "in contact", "µs / whisker step before", "now", "sweeps / processor s before", "now", "ratio",
        "same to the last bit",
    ]  # fmt: skip
    commit = subprocess.run(
        ["git", "rev-parse", "--short=8", "HEAD"], cwd=versions[0], capture_output=True, text=True, check=True
    ).stdout.strip()
    text = (
        f"{old['sweeps']} sweeps of thesis-high over procedural-24:1 (30 whiskers × 12 links), one thread; placing and "
        f"ordering the objects is included, compiling is not. Before: commit {commit}. The least of {args.rounds} runs "
        "of each, in turn.\n\n" + table(head, rows)
    )
    print(text)
    if args.write:
        write_section(
            "What a step in contact costs a processor",
            "python -m benchmarks.whiskers.contact_step --before CHECKOUT --write",
            text,
            subject="whiskers",
        )


if __name__ == "__main__":
    main()
