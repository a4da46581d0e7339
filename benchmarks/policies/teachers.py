"""Table and learning curves of teachers that ``policy.py --part teacher`` trained, from new weights or another's.

    brainbench policy evaluate in_palm_rotate RUN --config careful --episodes 128 --envs 64 -o processor/careful.json
    python -m benchmarks.policies.teachers --runs NAME=FOLDER … --after NAME=NAME … \
        --processor NAME=FILE … [--notes FILE] [--write]

A folder is what ``--out`` named. ``--after`` names the run whose networks another began with; its curve follows.

    python -m benchmarks.policies.teachers --first TASK=FOLDER … [--notes FILE] [--write]

is the section of first teachers, one run per task, with what their episodes of training were like on the way.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.report import table, write_section

PICTURE = Path(__file__).resolve().parents[2] / "docs" / "images" / "policy-learning.png"
_SMOOTH = 8
"""Iterations over whose episodes a curve's point is the mean."""
STEP = 0.025
"""Seconds of a control step."""


def lines(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def pairs(words: list[str]) -> dict[str, str]:
    return {name: value for name, _, value in (word.partition("=") for word in words)}


def share(found: dict[str, Any]) -> str:
    return "{:.3f} [{:.3f}, {:.3f}]".format(found["success_rate"], *found["success_interval"])


def body(runs: dict[str, Path], after: dict[str, str], processor: dict[str, Path]) -> str:
    """One row per run and agent, on the GPU's engine and on C MuJoCo."""
    found = []
    for name, folder in runs.items():
        rows = lines(folder / "policy.jsonl")
        (log,) = folder.glob("teacher-*/log.jsonl")
        minutes = sum(row["collect_s"] + row["learn_s"] for row in lines(log)) / 60
        own = json.loads(processor[name].read_text(encoding="utf-8")) if name in processor else []
        there = {item["agent"] if item["agent"] in ("zero", "random") else "teacher": item for item in own}
        for row in (row for row in rows if row["part"] == "evaluation"):
            if row["agent"] != "teacher" and (name != list(runs)[-1]):
                continue
            trained = row["agent"] == "teacher"
            steps = [f"{row['control_steps'] / 1e6:.1f}e6", f"{minutes:.1f}"] if trained else ["–", "–"]
            other = there.get(row["agent"])
            found.append(
                [
                    name if trained else row["agent"], after.get(name, "new weights") if trained else "–",
                    *steps, share(row),
                    f"{row['metric']:.2f} ± {row['metric_half_width']:.2f}",
                    f"{row['returns']:.1f} ± {row['returns_half_width']:.1f}", "–" if other is None else share(other),
                    "–" if other is None else f"{other['metric']:.2f} ± {other['metric_half_width']:.2f}",
                ]
            )  # fmt: skip
    columns = ["agent", "begun from", "control steps", "minutes", "success", "goals an episode", "return"]
    return table([*columns, "success on C MuJoCo", "goals on C MuJoCo"], found)


def first(runs: dict[str, Path]) -> str:
    """One row per task and agent, and one per task and moment of training."""
    found, way = [], []
    for task, folder in runs.items():
        (log,) = folder.glob("teacher-*/log.jsonl")
        logged = lines(log)
        minutes = sum(row["collect_s"] + row["learn_s"] for row in logged) / 60
        for row in (row for row in lines(folder / "policy.jsonl") if row["part"] == "evaluation"):
            trained = row["agent"] == "teacher"
            steps = [f"{row['control_steps'] / 1e6:.1f}e6", f"{minutes:.1f}"] if trained else ["–", "–"]
            names = ("metric", "seconds", "returns")
            found.append(
                [task, row["agent"], *steps, share(row)]
                + [f"{row[name]:.2f} ± {row[f'{name}_half_width']:.2f}" for name in names]
            )
        rows = [row for row in logged if row.get("episode/episodes")]
        # Powers of two show where it stopped changing.
        numbers = [2**power for power in range(3, 12) if 2**power < len(rows) - _SMOOTH / 2] + [len(rows)]
        for number in numbers:
            own = rows[max(number - _SMOOTH, 0) : number]
            weights = [row["episode/episodes"] for row in own]
            keys = ("episode/success", "episode/metric", "episode/length", "episode/return")
            means = [float(np.average([row[key] for row in own], weights=weights)) for key in keys]
            means[2] *= STEP
            way.append(
                [task, f"{own[-1]['steps'] / 1e6:.1f}e6", f"{means[0]:.3f}"]
                + [f"{value:.2f}" for value in (*means[1:], own[-1]["std"])]
            )
    columns = ["task", "agent", "control steps", "minutes", "success", "goals, or rad turned", "s", "return"]
    moments = ["task", "control steps", "success in training", "goals, or rad turned", "s", "return", "action std"]
    return f"{table(columns, found)}\n\n{table(moments, way)}"


def draw(runs: dict[str, Path], after: dict[str, str], path: Path) -> None:
    """Draw success and goals of the episodes that ended, and the goal's width, over control steps."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(9, 3.2), constrained_layout=True)
    width = axes[0].twinx()
    ends: dict[str, float] = {}
    for index, (name, folder) in enumerate(runs.items()):
        (log,) = folder.glob("teacher-*/log.jsonl")
        rows = [row for row in lines(log) if row.get("episode/episodes")]
        first = ends.get(after.get(name, ""), 0.0)
        steps = first + np.array([row["steps"] for row in rows]) / 1e6
        ends[name] = steps[-1]
        weights = np.array([row["episode/episodes"] for row in rows])
        for axis, key in ((axes[0], "episode/success"), (axes[1], "episode/metric")):
            values = weights * np.array([row[key] for row in rows])
            total = np.convolve(weights, np.ones(_SMOOTH), "valid")
            axis.plot(
                steps[_SMOOTH - 1 :],
                np.convolve(values, np.ones(_SMOOTH), "valid") / total,
                color=f"C{index}",
                label=name,
            )
        if "threshold" in rows[0]:
            width.plot(steps, [row["threshold"] for row in rows], color=f"C{index}", lw=0.8, ls=":")
    axes[0].set(ylabel="success in training", ylim=(0, 0.8))
    axes[1].set(ylabel="goals an episode", ylim=(0, None))
    width.set(ylabel="dotted: width of the goal (rad)", ylim=(0, 0.5))
    axes[1].legend(frameon=False)
    for axis in axes:
        axis.set_xlabel("control steps (millions)")
        axis.spines["top"].set_visible(False)
    width.spines["top"].set_visible(False)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", nargs="+", default=[])
    parser.add_argument("--first", nargs="+", default=[], help="one run per task, in place of --runs")
    parser.add_argument("--after", nargs="*", default=[])
    parser.add_argument("--processor", nargs="*", default=[])
    parser.add_argument("--notes", type=Path, help="text that follows the table")
    parser.add_argument("--device", default="one NVIDIA H200 per run")
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    if bool(options.runs) == bool(options.first):
        parser.error("give --runs or --first")
    runs = {name: Path(folder) for name, folder in pairs(options.runs or options.first).items()}
    after = pairs(options.after)
    if options.first:
        text = first(runs)
    else:
        text = body(runs, after, {name: Path(file) for name, file in pairs(options.processor).items()})
    if options.notes:
        text += "\n\n" + options.notes.read_text(encoding="utf-8").strip()
    print(text)
    if options.write and options.first:
        command = (
            f"python -m benchmarks.policies.tasks --part teacher --device cuda --tasks {' '.join(runs)} --envs 8192 …"
        )
        write_section("First teachers of other tasks", command, text, where=options.device, subject="policies")
    elif options.write:
        draw(runs, after, PICTURE)
        command = "python -m benchmarks.policies.tasks --part teacher --device cuda --tasks in_palm_rotate …"
        write_section("Teachers of in_palm_rotate", command, text, where=options.device, subject="policies")


if __name__ == "__main__":
    main()
