"""A 24-class data set of procedural objects made by the ``rod`` backend, and how separable its classes are.

python -m benchmarks.whiskers.gpu_dataset [--device cuda] [--objects procedural-24:5] [--out DIR]
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import shutil
import tempfile
import time
from pathlib import Path

from brainbench.datasets import WhiskingDataset
from brainbench.datasets.whisking.separability import separability
from brainbench.stimuli import Fidelity
from brainbench.stimuli.objects.collections import resolve_objects
from brainbench.stimuli.sweeps.generation import generate
from brainbench.stimuli.sweeps.plan import GenerationPlan, GenerationSettings
from brainbench.stimuli.sweeps.sweep_scenes import GRIDS


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--recipe", default="thesis-high")
    parser.add_argument("--objects", default="procedural-24:5")
    parser.add_argument("--links", type=int, default=12)
    parser.add_argument("--step", type=float, default=1e-3)
    parser.add_argument("--limit", type=int)
    parser.add_argument("--shard", type=int, default=6240)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    folder = args.out or Path(tempfile.mkdtemp())
    settings = GenerationSettings(
        fidelity=Fidelity(links=args.links, time_step=args.step),
        backend="rod",
        device=args.device,
        limit=args.limit,
        shard_size=args.shard,
    )
    objects = resolve_objects([args.objects], surfaces=True)
    plan = GenerationPlan(args.recipe, GRIDS[args.recipe], objects, settings)
    started = time.perf_counter()
    manifest = generate(plan, folder)
    seconds = time.perf_counter() - started
    size = sum(path.stat().st_size for path in folder.rglob("*.h5"))
    data = json.loads(json.dumps(manifest, default=str))
    counts = {key: value for key, value in data.items() if isinstance(value, (int, float, str))}
    rate = size / seconds / 1e6
    print(f"{args.objects} {args.recipe}: {size / 1e9:.2f} GB in {seconds:.1f} s ({rate:.0f} MB/s)", counts, flush=True)
    for result in separability(WhiskingDataset(folder, split="all", view="raw", unstable="skip")):
        print("separability", json.dumps(dataclasses.asdict(result), default=str)[:800])
    if args.out is None:
        shutil.rmtree(folder)


if __name__ == "__main__":
    main()
