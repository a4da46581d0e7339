"""Students of one teacher that differ in what they feel, trained for the same number of control steps.

    python -m benchmarks.policies.students --teacher RUN --device cuda --iterations 110 --together 2 --out STUDENTS
        [--end EPOCH_SECOND] [--arms none ft_hand …]
    python -m benchmarks.policies.comparison STUDENTS

Each student is a process of its own; ``--together`` of them run at once. Rows are printed as they come and kept in
``STUDENTS/students.jsonl``. By ``--end`` all have stopped and were evaluated as far as they got (their evaluation says
how far). Run again with the same folder, students that were stopped go on.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from benchmarks.policies.arms import ARMS, NETWORKS, settings_of
from brainbench.core.files import write_json
from robotics_bridge import tasks
from robotics_bridge.policies.evaluate import agent, evaluate
from robotics_bridge.policies.training.distill_config import DistillConfig
from robotics_bridge.policies.training.students import SEEDS, train_student
from robotics_bridge.policies.training.teacher import load_teacher

TASK = "in_palm_rotate"
EVERY = 25
"""Iterations between rows."""
_PER_EVALUATION = 90.0
"""Seconds kept for making the environments of a student (7 to 15) and for its evaluation (50 to 75, where two share an
H200). What begins later learns too little to count."""


def put(out: Path, row: dict[str, Any]) -> None:
    """Print a row and keep it; processes append whole lines."""
    line = json.dumps(row)
    print(line, flush=True)
    with (out / "students.jsonl").open("a", encoding="utf-8") as file:
        file.write(line + "\n")


def train(options: argparse.Namespace) -> None:
    """Train and evaluate one student in this process."""
    draw = options.seed if options.draw is None else options.draw
    settings = settings_of(options.arm, draw, options.pretrained)
    precision = "bf16" if options.device != "cpu" and settings["observe"] != "none" else "float32"
    config = DistillConfig(
        task=TASK, variant=options.config, teacher=str(options.teacher), num_envs=options.envs, precision=precision,
        seed=options.seed, save_interval=1_000_000, learning_rate=options.learning_rate, **settings,
    )  # fmt: skip
    began = time.time()
    left = None if options.end is None else max(options.end - began - options.reserve, 1.0)
    folder = options.out / options.arm / folder_name(options)

    def tell(done: int, total: int, what: str) -> None:
        if what == "evaluating" or done == 1 or done % EVERY == 0:
            put(options.out, {"arm": options.arm, "what": what, "done": done, "s": round(time.time() - began, 1)})

    student = train_student(
        config, folder, device=options.device, episodes=options.episodes, stop_after=left, stop_at=options.iterations,
        progress=tell, evaluations=options.evaluations,
    )  # fmt: skip
    logged = [json.loads(line) for line in (folder / "log.jsonl").read_text(encoding="utf-8").splitlines()]
    last = {kind: next((row for row in reversed(logged) if row["kind"] == kind), {}) for kind in ("loss", "time")}
    row: dict[str, Any] = {"arm": options.arm, "seed": options.seed, "status": student.result.status}
    row |= {"iterations": student.result.iterations}
    row |= {"control_steps": student.result.iterations * config.steps_per_env * config.num_envs}
    row |= {"learning_s": round(student.result.seconds, 1), "s": round(time.time() - began, 1)}
    row |= {"loss": last["loss"].get("behaviour"), "acting": last["time"].get("acting")}
    row |= {"learning": last["time"].get("learning")}
    for name in ("success", "goals", "turn_rate", "seconds", "returns", "dropped"):
        values = [value for item in student.evaluations for value in item.get(name, [])]
        row[name] = sum(values) / len(values) if values else None
    put(options.out, row)


def others(options: argparse.Namespace) -> None:
    """Evaluate the teacher, zero and random over the students' evaluation seeds."""
    env = tasks.make(TASK, config=options.config, num_envs=options.envs, device=options.device, seed=1)
    found = []
    for name in ("teacher", "zero", "random"):
        act = load_teacher(options.teacher, env) if name == "teacher" else agent(name, env)
        found.append(evaluate(env, act, episodes=options.episodes, seed=SEEDS, name=name).summary())
        put(options.out, {"arm": name, **found[-1]})
    write_json(options.out / "agents.json", found)


def together(options: argparse.Namespace) -> None:
    """Run all arms, some at once."""
    options.out.mkdir(parents=True, exist_ok=True)
    waiting = [*([] if options.no_agents else ["agents"]), *options.arms]
    running: dict[subprocess.Popen[bytes], str] = {}
    environment = {**os.environ, "OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS", "2")}
    while waiting or running:
        while waiting and len(running) < options.together:
            name = waiting.pop(0)
            if done(options, name):
                continue
            if options.end is not None and time.time() > options.end - options.reserve - 20:
                put(options.out, {"arm": name, "status": "no time"})
                continue
            command = [sys.executable, "-m", __spec__.name, *sys.argv[1:], "--arm", name]
            running[subprocess.Popen(command, env=environment)] = name
        time.sleep(0.2)
        for process in [process for process in running if process.poll() is not None]:
            name = running.pop(process)
            if process.returncode:
                put(options.out, {"arm": name, "status": "failed", "code": process.returncode})


def done(options: argparse.Namespace, arm: str) -> bool:
    """Return whether an arm was evaluated after all its iterations, with this seed and draw."""
    if arm == "agents":
        return (options.out / "agents.json").is_file()
    path = options.out / arm / folder_name(options) / "evaluation.json"
    return path.is_file() and all(one["iterations"] >= options.iterations for one in json.loads(path.read_text()))


def folder_name(options: argparse.Namespace) -> str:
    """Return the name of a student's folder in that of its arm."""
    drawn = options.pretrained.parent.name if options.pretrained else options.draw
    return f"seed{options.seed}" + (f"_draw-{drawn}" if drawn is not None else "")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--teacher", type=Path, default=Path("in_palm_rotate.teacher"), help="shipped, or a run's folder"
    )
    parser.add_argument("--config", default="default", help="configuration of the task; that of the teacher")
    parser.add_argument("--draw", type=int, help="seed of untrained networks and reservoirs; by default the student's")
    parser.add_argument("--pretrained", type=Path, help="weights of one training, for arms with a trained network")
    parser.add_argument("--arms", nargs="+", default=list(ARMS), choices=[*ARMS, *NETWORKS])
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--no-agents", action="store_true", help="do not evaluate the teacher, zero and random again")
    parser.add_argument("--together", type=int, default=1, help="processes per GPU")
    parser.add_argument("--envs", type=int, default=4096)
    parser.add_argument("--iterations", type=int, default=300, help="after which each student stops")
    parser.add_argument("--learning-rate", type=float, help="by default the task's own (published)")
    parser.add_argument("--episodes", type=int, default=512, help="per evaluation seed, at least")
    parser.add_argument("--evaluations", type=int, default=3, help="seeds of evaluation, of --envs episodes each")
    parser.add_argument("--end", type=float, help="second since 1970 by which all is done")
    parser.add_argument("--reserve", type=float, default=_PER_EVALUATION, help="of it, for start and evaluation")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("policy-students"))
    parser.add_argument("--arm", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.arm is None:
        together(options)
    elif options.arm == "agents":
        others(options)
    else:
        train(options)


if __name__ == "__main__":
    main()
