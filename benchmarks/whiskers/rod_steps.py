"""What a longer time step of ``rod`` costs in accuracy, and saves, on published sweeps over procedural objects.

python -m benchmarks.whiskers.rod_steps [--objects procedural-24:1] [--each 3] [--links 12] [--write]
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from benchmarks.report import publish, script_parser, table
from brainbench.stimuli import Fidelity
from brainbench.stimuli.engines.rod.sweeps import SweepLauncher
from brainbench.stimuli.objects.collections import resolve_objects
from brainbench.stimuli.sweeps.sweep_scenes import GRIDS, SweepScenes

STEPS = (5e-5, 1e-4, 2e-4, 5e-4, 1e-3)
FELT = 2e-7
"""Peak force (N) from which a whisker counts."""


def pick_sweeps(objects: list[str], recipe: str, each: int) -> tuple[SweepScenes, dict[str, list[Any]]]:
    """Make the objects of a recipe and pick so many sweeps of each, evenly and none of the first or last three."""
    found = resolve_objects(objects, surfaces=True)
    scenes, picked = SweepScenes(GRIDS[recipe], {name: item.load for name, item in found.items()}), {}
    for name in scenes.objects:
        sweeps = scenes.grid.sweeps(name)
        picked[name] = [sweeps[k] for k in np.linspace(3, len(sweeps) - 4, each).astype(int)]
        scenes.solid(name)
    return scenes, picked


def run(scenes: SweepScenes, picked: dict[str, list[Any]], fidelity: Fidelity) -> dict[str, Any]:
    """All picked sweeps at one fidelity: wrench, what was flagged, and processor seconds."""
    launcher = SweepLauncher(scenes, fidelity, "cpu")
    name = next(iter(picked))
    launcher.launch([(name, picked[name][:1])])
    started = time.process_time()
    results = [launcher.launch([(name, sweeps)]) for name, sweeps in picked.items()]
    spent = time.process_time() - started
    return {
        "wrench": np.concatenate([result.wrench for result in results]),
        "flagged": np.concatenate([result.verdict.unstable for result in results]),
        "steps": int(sum(result.steps.sum() for result in results)),
        "touching": int(sum(result.counts["touching"].sum() for result in results)),
        "seconds": spent,
    }


def errors(found: dict[str, Any], reference: dict[str, Any]) -> dict[str, np.ndarray]:
    """Root mean square over time of what force and moment miss, of the whisker's own peak; whiskers in good order."""
    misses = {}
    truth = reference["wrench"]
    felt = np.abs(truth[..., :3]).max(axis=(1, 3)) > FELT
    good = felt & ~reference["flagged"] & ~found["flagged"]
    for name, part in (("force", slice(0, 3)), ("moment", slice(3, 6))):
        miss = np.linalg.norm((found["wrench"] - truth)[..., part], axis=-1)
        peak = np.abs(truth[..., part]).max(axis=(1, 3))
        misses[name] = (np.sqrt((miss**2).mean(axis=1)) / np.maximum(peak, 1e-30))[good]
    return misses


def main() -> None:
    parser = script_parser(__doc__)
    parser.add_argument("--objects", default="procedural-24:1")
    parser.add_argument("--recipe", default="thesis-high")
    parser.add_argument("--each", type=int, default=3, help="sweeps of each object")
    parser.add_argument("--links", type=int, default=12)
    args = parser.parse_args()
    scenes, picked = pick_sweeps(args.objects.split(","), args.recipe, args.each)
    count = sum(map(len, picked.values()))
    rows, reference = [], None
    for step in STEPS:
        found = run(scenes, picked, Fidelity(links=args.links, time_step=step))
        reference = reference or found
        miss = errors(found, reference)
        rows.append(
            [
                f"{step * 1e3:g}",
                f"{count / found['seconds']:.1f}",
                f"{1e6 * found['seconds'] / found['steps']:.1f}",
                f"{found['touching'] / found['steps']:.0%}",
                *(f"{100 * np.quantile(miss[name], q):.2g}" for name in ("moment", "force") for q in (0.5, 0.9)),
                f"{found['flagged'].mean():.1%}",
                f"{found['flagged'].any(axis=1).mean():.0%}",
            ]
        )
        print(rows[-1], flush=True)
    head = [
        "step ms", "sweeps / processor s", "µs / whisker step", "in contact", "moment % median", "90th",
        "force % median", "90th", "whiskers flagged", "sweeps with one",
    ]  # fmt: skip
    text = (
        f"{count} sweeps of {args.recipe} over {args.objects} (30 whiskers × {args.links} links, 1 s each); root mean "
        f"square of what differs from the first row, of each whisker's own peak, whiskers of more than {FELT * 1e6:g} "
        "µN.\n\n" + table(head, rows)
    )
    publish(args, "Time steps of the rod backend", text)


if __name__ == "__main__":
    main()
