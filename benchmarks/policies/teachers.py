"""Tables and picture of teachers: of in_palm_rotate with three seeds, and first ones of other tasks.

    brainbench policy evaluate in_palm_rotate RUN --config careful --episodes 102 --envs 34 --seeds 3 --out FILE
    python -m benchmarks.policies.teachers --evaluated ENGINE=FILE … [--curves SEED=LOG.csv …] [--notes FILE] [--write]

is the section of the teacher of in_palm_rotate: its evaluations, kept in ``records``, and how it learned.

    python -m benchmarks.policies.teachers --first TASK=FOLDER … [--notes FILE] [--write]

is the section of first teachers, one run per task, with what their episodes of training were like on the way. A folder
is what ``--out`` named.
"""

from __future__ import annotations

import argparse
import csv
import json
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.report import table, write_section
from brainbench.core.figures.style import COLORS, panels, save_figure

PICTURE = Path(__file__).resolve().parents[2] / "docs" / "images" / "policy-teachers.png"
_SMOOTH = 8
"""Iterations over whose episodes a curve's point is the mean."""
STEP = 0.025
"""Seconds of a control step."""
GOALS = {"success": 0.85, "quarter turns": 5.0, "dropped": 0.15}
"""What the teacher should reach, as the picture marks it."""


def lines(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def pairs(words: list[str]) -> dict[str, str]:
    return {name: value for name, _, value in (word.rpartition("=") for word in words)}


def share(found: dict[str, Any]) -> str:
    return "{:.3f} [{:.3f}, {:.3f}]".format(found["success_rate"], *found["success_interval"])


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


def evaluated(files: dict[str, Path]) -> str:
    """One row per engine and agent; blocks and cylinders beside all objects."""
    names = ("goals", "turn_rate", "seconds", "dropped")
    rows = []
    for engine, file in files.items():
        for row in json.loads(file.read_text(encoding="utf-8")):
            kinds = [sum_of(row, kind) for kind in ("box", "cylinder")]
            rows.append(
                [engine, row["agent"], str(row["episodes"]), share(row)]
                + [f"{row[name]:.2f} ± {row[f'{name}_half_width']:.2f}" for name in names]
                + [f"{won:.2f}" for won in kinds]
            )
    columns = ["engine", "agent", "episodes", "success", "quarter turns", "rad/s", "s", "dropped"]
    return table([*columns, "success with blocks", "with cylinders"], rows)


def sum_of(row: dict[str, Any], kind: str) -> float:
    """Return the success with all objects of a kind."""
    own = [one for name, one in row["objects"].items() if name.startswith(kind)]
    return sum(one["success_rate"] * one["episodes"] for one in own) / sum(one["episodes"] for one in own)


def draw(curves: dict[str, Path]) -> None:
    """Draw success, quarter turns and drops of the episodes of training over control steps, a line a seed."""
    figure, (axes,) = panels(1, 3, (11.0, 3.2))
    for color, (seed, path) in zip(COLORS, curves.items(), strict=False):
        with path.open(encoding="utf-8", newline="") as stream:
            rows = [{key: float(value or "nan") for key, value in row.items()} for row in csv.DictReader(stream)]
        parts = [rows[at : at + _SMOOTH] for at in range(0, len(rows) - _SMOOTH + 1, _SMOOTH)]
        steps = [part[-1]["steps"] / 1e6 for part in parts]
        # The penalty of a drop, -200, is counted as a sum over the episode in control steps of 25 ms.
        for panel, (key, factor) in zip(
            axes, (("success", 1.0), ("metric", 1.0), ("reward/is_dropped", -1 / (200.0 * STEP))), strict=True
        ):
            means = [
                np.average([row[f"episode/{key}"] for row in part], weights=[row["episode/episodes"] for row in part])
                for part in parts
            ]
            panel.plot(steps, factor * np.array(means), color=color, label=f"seed {seed}", linewidth=1.4)
    for panel, (name, goal) in zip(axes, GOALS.items(), strict=True):
        panel.axhline(goal, color="#6c757d", linewidth=0.8, linestyle="--")
        panel.set(xlabel="control steps (millions)", title=name, ylim=(0, None))
    axes[0].legend(frameon=False, fontsize=9)
    save_figure(figure, PICTURE, dpi=120)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--evaluated", nargs="+", default=[])
    parser.add_argument("--first", nargs="+", default=[], help="one run per task, in place of --evaluated")
    parser.add_argument("--curves", nargs="*", default=[], help="log.csv of each seed")
    parser.add_argument("--notes", type=Path, help="text that follows the table")
    parser.add_argument("--device", default="one NVIDIA H200 per run")
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    if bool(options.evaluated) == bool(options.first):
        parser.error("give --evaluated or --first")
    found = {name: Path(path) for name, path in pairs(options.evaluated or options.first).items()}
    text = evaluated(found) if options.evaluated else first(found)
    if options.notes:
        text += "\n\n" + options.notes.read_text(encoding="utf-8").strip()
    print(text)
    if options.write and options.evaluated:
        draw({seed: Path(path) for seed, path in pairs(options.curves).items()})
        command = (
            "brainbench policy evaluate in_palm_rotate in_palm_rotate.teacher --config careful --out FILE; "
            "python -m benchmarks.policies.teachers --evaluated ENGINE=FILE … --curves SEED=LOG.csv … --write"
        )
        write_section("Teacher of in_palm_rotate", command, text, where=options.device, subject="policies")
    elif options.write:
        command = (
            f"python -m benchmarks.policies.tasks --part teacher --device cuda --tasks {' '.join(found)} --envs 8192 …"
        )
        write_section("First teachers of other tasks", command, text, where=options.device, subject="policies")


if __name__ == "__main__":
    main()
