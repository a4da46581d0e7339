"""Table and picture of teachers that ``policy.py --part teacher`` trained, from new weights or another's.

    brainbench policy evaluate in_palm_rotate RUN --config careful --episodes 128 --envs 64 -o processor/careful.json
    python -m benchmarks.policies.teachers --runs NAME=FOLDER … --after NAME=NAME … \
        --processor NAME=FILE … [--notes FILE] [--write]

A folder is what ``--out`` named. ``--after`` names the run whose networks another began with.

    python -m benchmarks.policies.teachers --first TASK=FOLDER … [--notes FILE] [--write]

is the section of first teachers, one run per task, with what their episodes of training were like on the way.

    python -m benchmarks.policies.teachers --evaluated ENGINE=FILE … [--notes FILE] [--write]

is the section of the teacher under firm contacts: files of ``brainbench policy evaluate --out``, kept in ``records``.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.report import table, write_section
from brainbench.core.figures.style import COLORS, PALE, panels, save_figure

PICTURE = Path(__file__).resolve().parents[2] / "docs" / "images" / "policy-teachers.png"
NAMES = {
    "zero": "no movement",
    "random": "random movement",
    "from the early teacher": "continued from a teacher that threw the block",
    "default": "new weights, reward for coming nearer",
    "drop penalty": "the one above, higher penalty for drops",
    "careful": "the same, also higher reward for goals (shipped)",
}
"""Agent of the table → what the picture calls it."""
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


def evaluated(files: dict[str, Path]) -> str:
    """One row per engine and agent."""
    names = ("goals", "turn_rate", "seconds", "dropped")
    rows = [
        [engine, row["agent"], str(row["episodes"]), share(row)]
        + [f"{row[name]:.2f} ± {row[f'{name}_half_width']:.2f}" for name in names]
        for engine, file in files.items()
        for row in json.loads(file.read_text(encoding="utf-8"))
    ]
    columns = ["engine", "agent", "episodes", "success", "goals an episode", "rad/s", "s", "dropped"]
    return table(columns, rows)


def draw(section: str) -> None:
    """Draw success and goals of each agent of the section's table, with 95 % intervals."""
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in section.splitlines() if line[:1] == "|"]
    agents = [row for row in rows[2:] if row[0] in NAMES][::-1]
    figure, ((left, right),) = panels(1, 2, (9.5, 3.4), sharey=True)
    for height, row in enumerate(agents):
        color = COLORS[0] if row[2] != "–" else PALE
        value, low, high = (float(word.strip("[],")) for word in row[4].split())
        left.errorbar(value, height, xerr=[[value - low], [high - value]], fmt="o", color=color, capsize=3)
        value, half = (float(word) for word in row[5].split(" ± "))
        right.errorbar(value, height, xerr=half, fmt="o", color=color, capsize=3)
    left.set_yticks(range(len(agents)), [NAMES[row[0]] for row in agents])
    left.set(xlabel="episodes with at least a quarter turn (share)", xlim=(-0.02, 0.8))
    right.set(xlabel="quarter turns an episode (mean)", xlim=(-0.06, 2.5))
    save_figure(figure, PICTURE, dpi=120)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", nargs="+", default=[])
    parser.add_argument("--first", nargs="+", default=[], help="one run per task, in place of --runs")
    parser.add_argument("--evaluated", nargs="+", default=[])
    parser.add_argument("--after", nargs="*", default=[])
    parser.add_argument("--processor", nargs="*", default=[])
    parser.add_argument("--notes", type=Path, help="text that follows the table")
    parser.add_argument("--device", default="one NVIDIA H200 per run")
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    if sum(map(bool, (options.runs, options.first, options.evaluated))) != 1:
        parser.error("give --runs, --first or --evaluated")
    runs = {name: Path(folder) for name, folder in pairs(options.runs or options.first).items()}
    after = pairs(options.after)
    if options.evaluated:
        text = evaluated({name: Path(file) for name, file in pairs(options.evaluated).items()})
    elif options.first:
        text = first(runs)
    else:
        text = body(runs, after, {name: Path(file) for name, file in pairs(options.processor).items()})
    if options.notes:
        text += "\n\n" + options.notes.read_text(encoding="utf-8").strip()
    print(text)
    if options.write and options.evaluated:
        command = (
            "brainbench policy evaluate in_palm_rotate in_palm_rotate.firm in_palm_rotate.careful --config careful "
        )
        command += "--change contacts=firm --out FILE; python -m benchmarks.policies.teachers --evaluated ENGINE=FILE …"
        write_section("Teacher under firm contacts", command, text, where=options.device, subject="policies")
    elif options.write and options.first:
        command = (
            f"python -m benchmarks.policies.tasks --part teacher --device cuda --tasks {' '.join(runs)} --envs 8192 …"
        )
        write_section("First teachers of other tasks", command, text, where=options.device, subject="policies")
    elif options.write:
        draw(text)
        command = "python -m benchmarks.policies.tasks --part teacher --device cuda --tasks in_palm_rotate …"
        write_section("Teachers of in_palm_rotate", command, text, where=options.device, subject="policies")


if __name__ == "__main__":
    main()
