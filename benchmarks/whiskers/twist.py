"""Cost of twist, and what it changes: ``python -m benchmarks.whiskers.twist [--sweeps 8] [--write]``."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from benchmarks.report import publish, script_parser, table
from brainbench.stimuli import Fidelity, get_recipe
from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.objects.collections import resolve_objects
from brainbench.stimuli.simulation import simulate
from brainbench.stimuli.sweeps.simulation import simulate_sweeps
from brainbench.stimuli.sweeps.sweep_scenes import GRIDS, SweepScenes

WITHOUT, WITH = (Fidelity.parse(f"balanced,twist={word}") for word in ("false", "true"))


def cost(run: Callable[[Fidelity], object], repeats: int) -> tuple[float, float]:
    """Median processor seconds without and with twist, in turns, after a first run that compiles."""
    spent: dict[Fidelity, list[float]] = {WITHOUT: [], WITH: []}
    for fidelity in spent:
        run(fidelity)
    for _ in range(repeats):
        for fidelity, seconds in spent.items():
            started = time.process_time()
            run(fidelity)
            seconds.append(time.process_time() - started)
    without, twisting = (statistics.median(seconds) for seconds in spent.values())
    return without, twisting


def main() -> None:
    parser = script_parser(__doc__)
    parser.add_argument("--sweeps", type=int, default=8)
    parser.add_argument("--repeats", type=int, default=3)
    args = parser.parse_args()
    recipe, engine = get_recipe("rodgers").scenes, get_engine("rod")
    jobs = recipe[0].select("C1-C3").jobs()
    free = [replace(job, obstacles=()) for job in jobs]
    objects = resolve_objects(["procedural-24:2"], collision="hull")
    sweeps = SweepScenes(GRIDS["thesis-high"], {name: item.load for name, item in objects.items()})
    chosen = np.linspace(0, len(sweeps) - 1, args.sweeps).astype(int).tolist()
    runs: dict[str, Callable[[Fidelity], object]] = {
        "whisking in air (C1–C3, 1 s)": lambda f: engine.run(free, f, workers=1),
        "whisking against a crescent (`rodgers`, C1–C3, 1 s)": lambda f: engine.run(jobs, f, workers=1),
        f"{args.sweeps} sweeps of thesis-high (30 whiskers)": lambda f: simulate_sweeps(sweeps, chosen, fidelity=f),
    }
    rows = []
    for name, run in runs.items():
        without, twisting = cost(run, args.repeats)
        rows.append([name, f"{without:.3f}", f"{twisting:.3f}", f"{100 * (twisting / without - 1):+.0f}"])
        print(rows[-1], flush=True)
    both = [simulate(recipe, fidelity=f, cache=False)["wrench"].values for f in (WITHOUT, WITH)]
    changes = []
    for k, scene in enumerate(recipe):
        without, twisting = (wrench[k] for wrench in both)
        row = [scene.label]
        for part in (slice(0, 3), slice(3, 6)):
            change = np.linalg.norm((twisting - without)[..., part], axis=-1)
            size = np.linalg.norm(without[..., part], axis=-1)
            row += [
                f"{100 * np.sqrt((change**2).mean() / (size**2).mean()):.2f}",
                f"{100 * change.max() / size.max():.2f}",
            ]
        changes.append(row)
        print(row, flush=True)
    text = "Processor seconds at `balanced`, median; compiling left out.\n\n"
    text += table(["scene", "without twist", "with twist", "more %"], rows)
    text += (
        "\n\nWhat twist changes in the stimuli of `rodgers` (30 whiskers), which is computed without by default.\n\n"
    )
    heads = [f"{name} %" for part in ("force", "moment") for name in (f"{part} rms/rms", f"{part} largest/largest")]
    text += table(["stimulus", *heads], changes)
    publish(args, "What twist costs and changes", text)


if __name__ == "__main__":
    main()
