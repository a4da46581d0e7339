"""Tables and picture of teachers: of in_palm_rotate with three seeds, and those of other tasks.

    brainbench policy evaluate TASK RUN … --episodes 102 --envs 34 --seeds 3 --out FILE
    python -m benchmarks.policies.teachers --evaluated ENGINE=FILE … [--curves NAME=LOG.csv …] [--notes FILE] [--write]

is the section of the teacher of in_palm_rotate: its evaluations, kept in ``records``, and how it learned. With
``--others TITLE`` it is another section: evaluations, and what episodes of training were like on the way.
"""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.report import script_parser, table, with_notes, write_section
from brainbench.core.figures.style import COLORS, panels, save_figure

PICTURE = Path(__file__).resolve().parents[2] / "docs" / "images" / "policy-teachers.png"
_SMOOTH = 8
"""Iterations over whose episodes a curve's point is the mean."""
STEP = 0.025
"""Seconds of a control step."""
GOALS = {"success": 0.85, "quarter turns": 5.0, "dropped": 0.15}
"""What the teacher should reach, as the picture marks it."""


def pairs(words: list[str]) -> dict[str, str]:
    return {name: value for name, _, value in (word.rpartition("=") for word in words)}


def share(found: dict[str, Any]) -> str:
    return "{:.3f} [{:.3f}, {:.3f}]".format(found["success_rate"], *found["success_interval"])


def logged(path: Path) -> list[dict[str, float]]:
    """Return the rows of a log.csv; NaN where nothing stands."""
    with path.open(encoding="utf-8", newline="") as stream:
        return [{key: float(value or "nan") for key, value in row.items()} for row in csv.DictReader(stream)]


def others(files: dict[str, Path], curves: dict[str, Path]) -> str:
    """One row per task, engine and agent, and one per run and moment of training."""
    found, way = [], []
    names = ("metric", "seconds", "dropped")
    for engine, file in files.items():
        for row in json.loads(file.read_text(encoding="utf-8")):
            means = [f"{row[name]:.2f} ± {row[f'{name}_half_width']:.2f}" for name in names]
            found.append([row["task"], engine, Path(row["agent"]).name, str(row["episodes"]), share(row), *means])
    for name, path in curves.items():
        rows = [row for row in logged(path) if row["episode/episodes"] > 0]
        # Powers of two show where it stopped changing.
        numbers = [2**power for power in range(3, 12) if 2**power < len(rows) - _SMOOTH / 2] + [len(rows)]
        for number in numbers:
            own = rows[max(number - _SMOOTH, 0) : number]
            weights = [row["episode/episodes"] for row in own]
            keys = ("episode/success", "episode/metric", "episode/length")
            won, metric, length = (float(np.average([row[key] for row in own], weights=weights)) for key in keys)
            width = f"{own[-1]['threshold']:.2f}" if "threshold" in own[-1] else "–"
            steps, seconds, spread = f"{own[-1]['steps'] / 1e6:.1f}e6", f"{STEP * length:.2f}", f"{own[-1]['std']:.2f}"
            way.append([name, steps, f"{won:.3f}", f"{metric:.2f}", seconds, width, spread])
    columns = ["task", "engine", "agent", "episodes", "success", "goals, or rad turned", "s", "dropped"]
    moments = ["run", "control steps", "success in training", "goals, or rad turned", "s", "goal, rad", "action std"]
    return "\n\n".join([table(columns, found), *([table(moments, way)] if way else [])])


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
        rows = logged(path)
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
    parser = script_parser(__doc__, notes=True)
    parser.add_argument("--evaluated", nargs="+", required=True)
    parser.add_argument("--others", help="title of the section of other policies than the teacher of in_palm_rotate")
    parser.add_argument("--curves", nargs="*", default=[], help="log.csv of each run")
    parser.add_argument("--device", default="one NVIDIA H200 per run")
    options = parser.parse_args()
    files, curves = ({name: Path(path) for name, path in pairs(words).items()} for words in
                     (options.evaluated, options.curves))  # fmt: skip
    text = others(files, curves) if options.others else evaluated(files)
    text = with_notes(text, options.notes)
    print(text)
    if not options.write:
        return
    what, other = "in_palm_rotate in_palm_rotate.teacher --config careful", ""
    if options.others:
        what, other = "TASK RUN …", f"--others {options.others!r} "
    else:
        draw(curves)
    command = (
        f"brainbench policy evaluate {what} --out FILE; python -m benchmarks.policies.teachers {other}"
        "--evaluated ENGINE=FILE … --curves NAME=LOG.csv … --write"
    )
    write_section(
        options.others or "Teacher of in_palm_rotate", command, text, where=options.device, subject="policies"
    )


if __name__ == "__main__":
    main()
