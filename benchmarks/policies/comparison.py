"""The students of the controlled comparison laid out: every arm, every student, and the differences between arms.

    python -m benchmarks.policies.comparison FOLDER … [--at-least 110] [--notes FILE] [--device "NVIDIA H100"]
        [--write] [--records FOLDER]

takes several training seeds of an arm and several folders together (what came back of earlier sessions lies in
``benchmarks/policies/records/students-*.tar.xz``, to unpack and name too); with ``--write`` a section of RESULTS.md and
a picture, with ``--records`` records for a leaderboard, whose commands name the teacher as it is shipped.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from benchmarks.policies.arms import ARMS, arm_of
from benchmarks.report import table, with_notes, write_section
from brainbench.core.files import read_json
from brainbench.core.records import Interval
from brainbench.metrics.inference.multiple import adjust
from leaderboards import write_record
from robotics_bridge.policies.report import figure, tables
from robotics_bridge.policies.report.records import records
from robotics_bridge.policies.report.results import StudentResult, mixed_model, read_agents, read_results
from robotics_bridge.policies.training.distill_config import DistillConfig

TASK, TEACHER = "in_palm_rotate", "in_palm_rotate.teacher"
PICTURE = Path(__file__).resolve().parents[2] / "docs" / "images" / "policy-students.png"
SMOOTH = 8
"""Last iterations over which a loss and a success are averaged."""
Logs = Mapping[tuple[str, int], Sequence[Mapping[str, Any]]]
"""Rows of a student's log, by arm and training seed."""
CONTRASTS = (
    ("ft_hand", "ft_tips"), ("bool_hand", "bool_tips"), ("ft_tips", "bool_tips"), ("ft_hand", "bool_hand"),
    ("ead_simclr", "ead_supervised"), ("ead_simclr", "ead_untrained"), ("ead_supervised", "ead_untrained"),
    ("ead_simclr", "reservoir"), ("ead_supervised", "reservoir"), ("ft_hand", "ead_simclr"), ("ft_hand", "reservoir"),
    ("ft_hand", "none_memory"), ("reservoir", "none_memory"), ("ead_simclr", "none_memory"), ("none_memory", "none"),
    ("reservoir_50", "reservoir"), ("bool_hand", "none_memory"), ("raw_rnn", "ft_hand"), ("raw_rnn", "reservoir"),
    ("ead_finetuned", "ead_scratch"), ("ead_finetuned", "ead_simclr"), ("ead_finetuned", "reservoir_large"),
    ("ft_hand_large", "ead_finetuned"), ("raw_rnn", "ead_finetuned"),
    ("raw_rnn_small", "ft_hand"), ("raw_rnn", "ft_hand_large"), ("raw_rnn", "reservoir_large"),
    ("ft_hand_large", "ft_hand"), ("reservoir_large", "reservoir"), ("reservoir_graph", "reservoir"),
)  # fmt: skip
"""Arms whose differences are tested."""
JUDGED: dict[str, tuple[str, ...]] = {
    "ead_simclr": ("reservoir", "ead_untrained"),
    "ead_supervised": ("reservoir", "ead_untrained"),
    "ead_finetuned": ("reservoir_large", "ead_scratch"),
}
"""Arms with whisker-trained networks, and those that never saw a whisker and learn as many parameters. Whiskers are
said to help only beyond the best of these."""


def found_logs(folders: list[Path], named: Mapping[str, StudentResult]) -> Logs:
    """Return the log of every student that counts, by arm and training seed."""
    logs = {}
    for path in (path for folder in folders for path in sorted(folder.rglob("log.jsonl"))):
        config = DistillConfig.of(read_json(path.parent / "config.json")["distill"])
        arm = arm_of(config)
        if arm not in named or config.seed not in named[arm].seeds:
            continue
        rows = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
        if len(rows) > len(logs.get((arm, config.seed), [])):
            logs[arm, config.seed] = rows
    return dict(sorted(logs.items(), key=lambda item: (list(named).index(item[0][0]), item[0][1])))


def every_student(named: Mapping[str, StudentResult], logs: Logs) -> str:
    """Return the table of single students: one row per arm and training seed."""
    least = min(learned or 0 for result in named.values() for learned in result.learned)
    rows = []
    for (arm, seed), log in logs.items():
        result = named[arm]
        number = result.seeds.index(seed)
        learned = result.learned[number] or 0
        steps = learned * result.config.steps_per_env * result.config.num_envs
        loss = [row["behaviour"] for row in log if row["kind"] == "loss"][-SMOOTH:]
        rows.append(
            [
                arm, str(seed), str(learned), f"{steps / 1e6:.1f}e6", f"{sum(loss) / len(loss):.3f}",
                f"{seen(log, least):.3f}", f"{result.success[number]:.3f}",
            ]
        )  # fmt: skip
    span = f"{least - SMOOTH + 1} to {least}"
    columns = ["arm", "training seed", "iterations", "control steps", f"imitation loss, last {SMOOTH}"]
    return table([*columns, f"success in training, iterations {span}", "success in evaluation"], rows)


def every_draw(named: Mapping[str, StudentResult], logs: Logs) -> list[str]:
    """Return the table of networks that serve several students, where an arm has more than one; empty if none has."""
    least = min(learned or 0 for result in named.values() for learned in result.learned)
    rows = []
    for arm, result in ((arm, result) for arm, result in named.items() if result.nested):
        for draw in dict.fromkeys(config.draw for config in result.configs):
            own = [number for number, config in enumerate(result.configs) if config.draw == draw]
            told = [[result.success[number] for number in own], [seen(logs[arm, result.seeds[n]], least) for n in own]]
            rows.append([arm, f"`{draw}`", str(len(own)), *(f"{sum(shares) / len(own):.3f}" for shares in told)])
    columns = ["arm", "network", "students", "success in evaluation", "success in training"]
    return ["Means over the students of each network:", table(columns, rows)] if rows else []


def differences(named: Mapping[str, StudentResult], logs: Logs) -> str:
    """Return the table of :data:`CONTRASTS`, what spread they were held against, and whether trained networks help.

    Success in training is that of several moments of a policy, so that it scatters less than that of the last one.
    """
    least = min(learned or 0 for result in named.values() for learned in result.learned)
    model = mixed_model(list(named.values()))
    trained = mixed_model(
        [
            replace(result, success=tuple(seen(logs[arm, seed], least) for seed in result.seeds))
            for arm, result in named.items()
        ]
    )
    pairs = [(one, other) for one, other in CONTRASTS if one in named and other in named]
    found = [model.contrast(named[one].name, named[other].name) for one, other in pairs]
    held = adjust([item.p for item in found], "holm")
    rows = []
    for (one, other), item, p in zip(pairs, found, held, strict=True):
        moments = trained.contrast(named[one].name, named[other].name)
        count = f"{len(named[one].seeds)}, {len(named[other].seeds)}"
        told = [f"{each.difference:+.3f} {_span(each.interval)}" for each in (item, moments)]
        rows.append([f"{one} – {other}", count, told[0], f"{p:.2g}", told[1]])
    spreads = [", ".join(f"{name} {value:.3f}" for name, value in one.spread.items()) for one in (model, trained)]
    said = (
        f"Mixed model of all {len(named)} arms; standard deviations of success in evaluation: {spreads[0]}; in "
        f"training, iterations {least - SMOOTH + 1} to {least}: {spreads[1]}. Differences of arms with 95 % intervals:"
    )
    lines = [said, table(["arms", "students", "success in evaluation", "p (Holm)", "success in training"], rows)]
    for arm, rivals in JUDGED.items():
        random = {named[rival].name: rival for rival in rivals if rival in named}
        if arm not in named or not random:
            continue
        judged = model.judge(named[arm].name, random)
        gain = f"{judged.contrast.difference:+.3f} {_span(judged.contrast.interval)}"
        word = "helps" if judged.helps else "is not shown to help"
        lines.append(f"`{arm}` {word}: {gain} over `{random[judged.best]}`, the best rival.")
    return "\n\n".join(lines)


def _span(interval: Interval | None) -> str:
    return "–" if interval is None else f"[{interval.low:+.3f}, {interval.high:+.3f}]"


def seen(log: Sequence[Mapping[str, Any]], iteration: int) -> float:
    """Return the success in training over the last iterations up to one."""
    own = [row for row in log if row["kind"] == "episode" and iteration - SMOOTH < row["step"] <= iteration]
    return sum(row["episodes"] * row["success"] for row in own) / sum(row["episodes"] for row in own)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+", help="of students that came back")
    parser.add_argument("--at-least", type=int, default=0, help="iterations; what learned fewer is left out, by name")
    parser.add_argument("--notes", type=Path, help="text that follows the tables")
    parser.add_argument("--device", default="", help="what trained the students")
    parser.add_argument("--write", action="store_true")
    parser.add_argument("--records", type=Path, help="folder for records of what is laid out")
    options = parser.parse_args()
    every = read_results(options.folders, at_least=options.at_least)
    results = [result for result in every if arm_of(result.config) in ARMS]
    named = {arm: result for arm in ARMS for result in results if arm_of(result.config) == arm}
    agents = read_agents(options.folders)
    title, columns, rows = tables.concise([*tables.rows(results), *tables.agent_rows(agents)])
    notes = tables.remarks([replace(result, left_out=()) for result in results])
    left = [f"{arm} seed {item.seed} ({item.iterations})" for arm, r in named.items() for item in r.left_out]
    notes += [f"left out, after so many iterations: {', '.join(left)}"] if left else []
    parts = [f"{title}.", table(columns, rows)]
    parts += [f"Notes: {'; '.join(notes)}."] if notes else []
    logs = found_logs(options.folders, named)
    parts += [every_student(named, logs), *every_draw(named, logs), differences(named, logs)]
    body = with_notes("\n\n".join(parts), options.notes)
    print(body)
    if options.write:
        figure.draw(results, PICTURE, agents=agents)
        command = "python -m benchmarks.policies.comparison FOLDER … --at-least 110 --write"
        write_section(f"Students of {TASK}", command, body, where=options.device, subject="policies")
    if options.records is not None:
        shipped = [replace(result, config=replace(result.config, teacher=TEACHER)) for result in every]
        for record in records(shipped):
            print(write_record(record, options.records))


if __name__ == "__main__":
    main()
