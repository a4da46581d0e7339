"""What the rule of trust finds in sweeps, and what it costs: whiskers inside objects, and forces that change at half
the step.

python -m benchmarks.whiskers.trust [--objects 8] [--each 6] [--write]
"""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks.report import publish, script_parser, table
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.engines.rod.sweeps import SweepLauncher
from brainbench.stimuli.engines.trust import LARGEST_CHANGE, LARGEST_STRAIN, force_change
from brainbench.stimuli.objects.collections import resolve_objects
from brainbench.stimuli.objects.procedural import list_families
from brainbench.stimuli.sweeps.sweep_scenes import GRIDS, SweepScenes

CASES = (
    ("thesis-high", "clear", "fast"),
    ("thesis-high", "clear", "balanced"),
    ("thesis-low", "released", "fast"),
)


def run(recipe: str, placing: str, fidelity: str, objects: int, each: int) -> list[str]:
    """One row: sweeps at a fidelity with and without the comparison, and every whisker at half the step."""
    grid = replace(GRIDS[recipe], placing=placing)
    solids = {name: item.load for name, item in resolve_objects(list_families()).items()}
    names = list(solids)[:: len(solids) // objects][:objects]
    launcher = SweepLauncher(SweepScenes(grid, {name: solids[name] for name in names}), Fidelity.of(fidelity))
    picked: dict[str, list[Any]] = {}
    for name in names:
        sweeps = grid.sweeps(name)
        picked[name] = [sweeps[k] for k in np.linspace(0, len(sweeps) - 1, each).astype(int)]
    launcher.launch([(names[0], picked[names[0]][:1])])
    started = time.process_time()
    first = {name: launcher.launch([(name, sweeps)]) for name, sweeps in picked.items()}
    once = time.process_time() - started
    found: Counter[str] = Counter()
    strain, compared, depth = 0.0, 0.0, []
    for name, result in first.items():
        verdict, touching = result.verdict, result.counts["touching"] > 0
        good = touching & ~verdict.unstable
        half = launcher.launch([(name, picked[name])], [(good, 2)])
        row, column = good.nonzero()
        change = force_change(result.wrench[row, :, column, None, :3], half.wrench[..., :3])
        changed = good.copy()
        changed[good] = ~((change <= LARGEST_CHANGE) & ~half.verdict.unstable)[:, 0]
        found += Counter(
            {
                "whiskers": touching.size,
                "touching": int(touching.sum()),
                "inside": sum("starts" in words for words in verdict.reasons.ravel()),
                "suspicious": int((verdict.suspicious & good).sum()),
                "changed": int(changed.sum()),
                "found": int((changed & verdict.suspicious).sum()),
            }
        )
        compared += 2 * float(result.steps[verdict.suspicious].sum())
        force = np.linalg.norm(result.wrench[..., :3], axis=-1).max(axis=1)
        strain = max(strain, float((force / launcher.solver.strongest)[~verdict.unstable].max()) * LARGEST_STRAIN)
        depth.append(result.depth[good])
    started = time.process_time()
    lost = sum(int(launcher.trusted([item], 5).unstable.sum()) for item in picked.items()) - found["inside"]
    whole = time.process_time() - started
    steps = sum(int(result.steps.sum()) for result in first.values())
    return [
        f"`{recipe}`, {placing}, `{fidelity}`",
        *(f"{found[name]}" for name in ("whiskers", "touching", "inside")),
        f"{np.percentile(np.concatenate(depth), 99) * 1e3:.2f} / {np.concatenate(depth).max() * 1e3:.2f}",
        f"{strain:.1e}",
        f"{found['suspicious']}",
        f"{compared / steps:.1%}",
        f"{found['found']} of {found['changed']}",
        f"{lost}",
        f"{whole / once:.2f}",
    ]


def main() -> None:
    parser = script_parser(__doc__)
    parser.add_argument("--objects", type=int, default=8)
    parser.add_argument("--each", type=int, default=6, help="sweeps of each object")
    args = parser.parse_args()
    rows = [run(*case, args.objects, args.each) for case in CASES]
    head = [
        "sweeps", "whiskers", "touching", "start inside", "overlap, 99 % / largest (mm)", "largest force over E A",
        "suspicious", "further steps to compare them", "of those that change by 20 %", "left unstable, others",
        "time with retries and comparisons over one run",
    ]  # fmt: skip
    text = (
        f"{args.each} sweeps of {args.objects} procedural objects past 30 mouse whiskers each. *Start inside*: flagged"
        " at the first step, whatever their depth. Overlap and force are those of whiskers in good order at first."
        " *Of those that change*: whiskers whose base force changes by more than 20 % (root mean square over the"
        " readings) at half the step, when every touching whisker is simulated so, and how many of them are suspicious,"
        " so that the rule compares them.\n\n" + table(head, rows)
    )
    publish(
        args, "What the rule of trust finds, and what it costs", text, f"--objects {args.objects} --each {args.each}"
    )


if __name__ == "__main__":
    main()
