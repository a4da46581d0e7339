"""Students of one teacher that differ in what they feel, trained for the same number of control steps and compared.

    python -m benchmarks.policies.students --teacher RUN --device cuda --iterations 300 --together 2 --out STUDENTS
        [--gpus 2] [--end EPOCH_SECOND] [--arms none ft_hand …] [--tar $OUT]
    brainbench policy report STUDENTS --picture report.png --records leaderboards/results

Each student is a process of its own; ``--together`` of them share a GPU. Rows are printed as they come and kept in
``STUDENTS/students.jsonl``. By ``--end`` all have stopped, were evaluated as far as they got (their evaluation says how
far), and lie in ``$OUT/results.tar.gz`` (all but weights) and ``$OUT/models-<n>.tar`` of at most 15 MiB each, renewed
whenever one is done. Run again with the same folder, students that were stopped go on.

    python -m benchmarks.policies.students --lay-out FOLDER … [--at-least 90] [--notes FILE] [--device "2 × NVIDIA
    H200"]
        [--write] [--records FOLDER]

lays out what came back, several training seeds of an arm and several folders together: tables of arms, of every
student and of the differences between arms (what came back of earlier sessions lies in
``benchmarks/policies/records/students-DATE.tar.xz``, to unpack and name too); with ``--write`` a section of RESULTS.md
and two pictures, with ``--records`` records for a leaderboard, whose commands name the teacher as it is shipped.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tarfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robotics_bridge.tasks.contact_model import CONTACTS

if TYPE_CHECKING:
    from brainbench.core.records import Interval
    from robotics_bridge.policies.report.results import StudentResult
    from robotics_bridge.policies.training.distill_config import DistillConfig

NETWORK = "zhuang-intersection-ln-small"
CHOSEN = "benchmarks/policies/records/taxels-in_palm_rotate-50.json"
"""The 50 taxels that read-outs chose."""
ARMS: dict[str, dict[str, Any]] = {
    "none": {"observe": "none"},
    # Wider, so that it learns as many parameters as the others.
    "none_memory": {"observe": "none", "embedder": "lstm", "hidden": (1024, 256, 128)},
    "ft_hand": {"observe": "force_torque", "placement": "hand"},
    "ft_tips": {"observe": "force_torque", "placement": "tips"},
    "bool_hand": {"observe": "agg_bool", "placement": "hand"},
    "bool_tips": {"observe": "agg_bool", "placement": "tips"},
    "ead_simclr": {"observe": "force_torque", "placement": "hand", "encoder": f"{NETWORK}.simclr"},
    "ead_supervised": {"observe": "force_torque", "placement": "hand", "encoder": f"{NETWORK}.supervised"},
    "ead_untrained": {"observe": "force_torque", "placement": "hand", "encoder": NETWORK},
    "reservoir": {"observe": "force_torque", "placement": "hand", "encoder": "reservoir"},
    "reservoir_50": {"observe": "force_torque", "placement": "hand", "encoder": "reservoir", "resolution": CHOSEN},
    "raw_rnn": {"observe": "force_torque", "placement": "hand", "encoder": "rnn"},
    # As many parameters as ft_hand; and those that have as many as raw_rnn.
    "raw_rnn_small": {
        "observe": "force_torque", "placement": "hand", "encoder": "rnn", "encoder_settings": {"units": 9},
        "hidden": (128, 128, 128),
    },
    "ft_hand_large": {"observe": "force_torque", "placement": "hand", "hidden": (1376, 1024, 128)},
    "reservoir_large": {
        "observe": "force_torque", "placement": "hand", "encoder": "reservoir", "hidden": (1376, 1024, 128),
    },
    "ead_finetuned": {
        "observe": "force_torque", "placement": "hand", "encoder": f"{NETWORK}.simclr",
        "encoder_settings": {"learning": "finetuned"},
    },
    "ead_scratch": {
        "observe": "force_torque", "placement": "hand", "encoder": NETWORK,
        "encoder_settings": {"learning": "finetuned"},
    },
}  # fmt: skip
NETWORKS: dict[str, dict[str, Any]] = {
    name: {"observe": "force_torque", "placement": "hand", "encoder": name}
    for name in (
        "zhuang-small", "zhuang-ln-small", "zhuang-ugrnn-small", "zhuang-gru-small", "zhuang-lstm-small",
        "zhuang-intersection-small", "zhuang-feedforward-small", "resnet18-small", "s4-small", "zhuang-small+mamba",
        f"{NETWORK}+mamba", "zhuang-small.simclr", "zhuang-small.supervised", "resnet18-small.supervised",
    )
}  # fmt: skip
"""The other frozen networks of the default board, for the correlation of score and success (point 9 of issue 23). Those
with a transformer are left out: a policy runs without end."""
CONTRASTS = (
    ("ft_hand", "ft_tips"), ("bool_hand", "bool_tips"), ("ft_tips", "bool_tips"), ("ft_hand", "bool_hand"),
    ("ead_simclr", "ead_supervised"), ("ead_simclr", "ead_untrained"), ("ead_supervised", "ead_untrained"),
    ("ead_simclr", "reservoir"), ("ead_supervised", "reservoir"), ("ft_hand", "ead_simclr"), ("ft_hand", "reservoir"),
    ("ft_hand", "none_memory"), ("reservoir", "none_memory"), ("ead_simclr", "none_memory"), ("none_memory", "none"),
    ("reservoir_50", "reservoir"), ("bool_hand", "none_memory"), ("raw_rnn", "ft_hand"), ("raw_rnn", "reservoir"),
    ("ead_finetuned", "ead_scratch"), ("ead_finetuned", "ead_simclr"), ("ead_finetuned", "ft_hand"),
    ("raw_rnn_small", "ft_hand"), ("raw_rnn", "ft_hand_large"), ("raw_rnn", "reservoir_large"),
    ("ft_hand_large", "ft_hand"), ("reservoir_large", "reservoir"),
)  # fmt: skip
"""Arms whose differences are tested."""
RANDOM, TRAINED = ("reservoir", "ead_untrained"), ("ead_simclr", "ead_supervised")
"""Frozen arms that learned nothing, and those that are said to help only beyond the best of them."""
_TAR = 15 << 20
_SMOOTH = 8
"""Last iterations over which a loss and a success are averaged."""
_PICTURES = Path(__file__).resolve().parents[2] / "docs" / "images"
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
    from robotics_bridge.policies.readouts.arms import without_latency
    from robotics_bridge.policies.training.distill_config import DistillConfig
    from robotics_bridge.policies.training.students import train_student

    settings = dict((ARMS | NETWORKS)[options.arm])
    if "encoder" in settings:
        # A draw of a random arm is its seed; networks answer without added latency.
        own = {"seed": options.draw if options.draw is not None else options.seed}
        if _is_network(settings):
            options_of = without_latency(settings["encoder"])
            own |= {"learning": "frozen"} | ({"options": options_of} if options_of else {})
        if options.pretrained is not None and settings["encoder"].startswith(f"{NETWORK}."):
            own["pretrained"] = str(options.pretrained)
        settings["encoder_settings"] = own | settings.get("encoder_settings", {})
    precision = "bf16" if options.device != "cpu" and settings["observe"] != "none" else "float32"
    config = DistillConfig(
        task=options.task, variant=options.config, contacts=options.contacts, teacher=str(options.teacher),
        num_envs=options.envs, precision=precision, seed=options.seed, save_interval=1_000_000,
        learning_rate=options.learning_rate, epochs=options.epochs, teacher_share=options.teacher_share,
        teacher_iterations=options.teacher_iterations, **settings,
    )  # fmt: skip
    began = time.time()
    left = None if options.end is None else max(options.end - began - options.reserve, 1.0)
    folder = options.out / options.arm / folder_name(options)

    def tell(done: int, total: int, what: str) -> None:
        if what == "evaluating" or done == 1 or done % options.every == 0:
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
    from brainbench.core.files import write_json
    from robotics_bridge import tasks
    from robotics_bridge.policies.evaluate import agent, evaluate
    from robotics_bridge.policies.training.students import SEEDS
    from robotics_bridge.policies.training.teacher import load_teacher

    env = tasks.make(options.task, config=options.config, num_envs=options.envs, device=options.device, seed=1)
    found = []
    for name in ("teacher", "zero", "random"):
        act = load_teacher(options.teacher, env) if name == "teacher" else agent(name, env)
        found.append(evaluate(env, act, episodes=options.episodes, seed=SEEDS, name=name).summary())
        put(options.out, {"arm": name, **found[-1]})
    write_json(options.out / "agents.json", found)


def together(options: argparse.Namespace) -> None:
    """Run all arms, some at once per GPU, and pack what they leave."""
    options.out.mkdir(parents=True, exist_ok=True)
    words = sys.argv[1:]
    waiting = [*([] if options.no_agents else ["agents"]), *options.arms]
    visible = [name for name in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if name]
    running: dict[subprocess.Popen[bytes], tuple[str, int]] = {}
    places = [gpu for _ in range(options.together) for gpu in range(options.gpus)]
    while waiting or running:
        while waiting and places:
            name = waiting.pop(0)
            if done(options, name):
                continue
            if options.end is not None and time.time() > options.end - options.reserve - 20:
                put(options.out, {"arm": name, "status": "no time"})
                continue
            gpu = places.pop(0)
            environment = {**os.environ, "OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS", "2")}
            if options.device != "cpu":
                environment["CUDA_VISIBLE_DEVICES"] = visible[gpu] if visible else str(gpu)
            process = subprocess.Popen([sys.executable, "-m", __spec__.name, *words, "--arm", name], env=environment)
            running[process] = name, gpu
        time.sleep(0.2)
        for process in [process for process in running if process.poll() is not None]:
            name, gpu = running.pop(process)
            places.append(gpu)
            if process.returncode:
                put(options.out, {"arm": name, "status": "failed", "code": process.returncode})
            pack(options.out, options.tar or options.out, options.arms, options.tars)


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


def pack(out: Path, to: Path, arms: list[str], most: int) -> None:
    """Put everything but weights into one file, and weights into small ones, those of the first arms first."""
    to.mkdir(parents=True, exist_ok=True)
    kept = [path for path in out.rglob("*") if path.suffix in (".json", ".jsonl")]
    with tarfile.open(to / "results.tar.gz", "w:gz") as file:
        for path in kept:
            file.add(path, path.relative_to(out))
    number, size, file = 0, 0, None
    for path in (path for arm in arms for path in sorted((out / arm).rglob("model.safetensors"))):
        if number == most and size + path.stat().st_size > _TAR:
            break
        if file is None or size + path.stat().st_size > _TAR:
            if file is not None:
                file.close()
            number, size = number + 1, 0
            file = tarfile.open(to / f"models-{number}.tar", "w")  # noqa: SIM115 - closed before the next is opened
        file.add(path, path.relative_to(out))
        size += path.stat().st_size
    if file is not None:
        file.close()


def lay_out(options: argparse.Namespace) -> None:
    """Print the comparison; with ``--write`` keep it as a section and draw it, and how students learned."""
    from dataclasses import replace

    from benchmarks.report import table, with_notes, write_section
    from leaderboards import write_record
    from robotics_bridge.policies.report import figure, tables
    from robotics_bridge.policies.report.records import records
    from robotics_bridge.policies.report.results import read_agents, read_results

    every = read_results(options.lay_out, at_least=options.at_least)
    results = [result for result in every if arm_of(result.config) not in NETWORKS]
    agents = read_agents(options.lay_out)
    title, columns, rows = tables.concise([*tables.rows(results), *tables.agent_rows(agents)])
    named = {arm: result for arm in ARMS for result in results if arm_of(result.config) == arm}
    notes = tables.remarks([replace(result, left_out=()) for result in results])
    left = [f"{arm} seed {item.seed} ({item.iterations})" for arm, r in named.items() for item in r.left_out]
    notes += [f"left out, after so many iterations: {', '.join(left)}"] if left else []
    parts = [f"{title}.", table(columns, rows)]
    parts += [f"Notes: {'; '.join(notes)}."] if notes else []
    logs = found_logs(options.lay_out, named)
    parts += [every_student(named, logs), *every_draw(named, logs), differences(named, logs)]
    body = with_notes("\n\n".join(parts), options.notes)
    print(body)
    if options.write:
        figure.draw(results, _PICTURES / "policy-students.png", agents=agents)
        command = f"python -m benchmarks.policies.students --teacher {options.teacher} --config careful"
        write_section(f"Students of {options.task}", command, body, where=options.device, subject="policies")
    if options.records is not None:
        shipped = [replace(result, config=replace(result.config, teacher=str(options.teacher))) for result in every]
        for record in records(shipped):
            print(write_record(record, options.records))


def _is_network(settings: dict[str, Any]) -> bool:
    return settings.get("encoder", "").startswith(NETWORK) or settings.get("encoder") in NETWORKS


def arm_of(config: DistillConfig) -> str | None:
    """Return the arm that a student belongs to; None where it belongs to none of them."""
    from robotics_bridge.policies.training.distill_config import DistillConfig

    for arm, settings in (ARMS | NETWORKS).items():
        learning = settings.get("encoder_settings", {}).get("learning", "frozen" if _is_network(settings) else None)
        plain = {name: value for name, value in settings.items() if name != "encoder_settings"}
        wanted = DistillConfig(task=config.task, **plain)
        felt = () if config.observe == "none" else ("placement", "resolution", "encoder")
        same = ("observe", "embedder", "hidden", *felt)
        if all(getattr(config, name) == getattr(wanted, name) for name in same) and (
            config.encoder_settings.get("learning") == learning
            and config.encoder_settings.get("units") == settings.get("encoder_settings", {}).get("units")
        ):
            return arm
    return None


def found_logs(folders: list[Path], named: dict[str, StudentResult]) -> dict[tuple[str, int], list[dict[str, Any]]]:
    """Return the log of every student that counts, by arm and training seed."""
    from brainbench.core.files import read_json
    from robotics_bridge.policies.training.distill_config import DistillConfig

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


def every_student(named: dict[str, StudentResult], logs: dict[tuple[str, int], list[dict[str, Any]]]) -> str:
    """Return the table of single students: one row per arm and training seed."""
    from benchmarks.report import table

    least = min(learned or 0 for result in named.values() for learned in result.learned)
    rows = []
    for (arm, seed), log in logs.items():
        result = named[arm]
        number = result.seeds.index(seed)
        learned = result.learned[number] or 0
        steps = learned * result.config.steps_per_env * result.config.num_envs
        loss = [row["behaviour"] for row in log if row["kind"] == "loss"][-_SMOOTH:]
        rows.append(
            [
                arm, str(seed), str(learned), f"{steps / 1e6:.1f}e6", f"{sum(loss) / len(loss):.3f}",
                f"{seen(log, least):.3f}", f"{result.success[number]:.3f}",
            ]
        )  # fmt: skip
    span = f"{least - _SMOOTH + 1} to {least}"
    columns = ["arm", "training seed", "iterations", "control steps", f"imitation loss, last {_SMOOTH}"]
    return table([*columns, f"success in training, iterations {span}", "success in evaluation"], rows)


def every_draw(named: dict[str, StudentResult], logs: dict[tuple[str, int], list[dict[str, Any]]]) -> list[str]:
    """Return the table of networks that serve several students, where an arm has more than one; empty if none has."""
    from benchmarks.report import table

    least = min(learned or 0 for result in named.values() for learned in result.learned)
    rows = []
    for arm, result in ((arm, result) for arm, result in named.items() if result.nested):
        for draw in dict.fromkeys(config.draw for config in result.configs):
            own = [number for number, config in enumerate(result.configs) if config.draw == draw]
            told = [[result.success[number] for number in own], [seen(logs[arm, result.seeds[n]], least) for n in own]]
            rows.append([arm, f"`{draw}`", str(len(own)), *(f"{sum(shares) / len(own):.3f}" for shares in told)])
    columns = ["arm", "network", "students", "success in evaluation", "success in training"]
    return ["Means over the students of each network:", table(columns, rows)] if rows else []


def differences(named: dict[str, StudentResult], logs: dict[tuple[str, int], list[dict[str, Any]]]) -> str:
    """Return the table of :data:`CONTRASTS`, what spread they were held against, and whether trained networks help.

    Success in training is that of several moments of a policy, so that it scatters less than that of the last one.
    """
    from dataclasses import replace

    from benchmarks.report import table
    from brainbench.metrics.inference.multiple import adjust
    from robotics_bridge.policies.report.results import mixed_model

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
        f"training, iterations {least - _SMOOTH + 1} to {least}: {spreads[1]}. Differences of arms with 95 % intervals:"
    )
    lines = [said, table(["arms", "students", "success in evaluation", "p (Holm)", "success in training"], rows)]
    random = {named[arm].name: arm for arm in RANDOM if arm in named}
    for arm in (arm for arm in TRAINED if arm in named and random):
        judged = model.judge(named[arm].name, random)
        gain = f"{judged.contrast.difference:+.3f} {_span(judged.contrast.interval)}"
        word = "helps" if judged.helps else "is not shown to help"
        lines.append(f"`{arm}` {word}: {gain} over `{random[judged.best]}`, the best random arm.")
    return "\n\n".join(lines)


def _span(interval: Interval | None) -> str:
    return "–" if interval is None else f"[{interval.low:+.3f}, {interval.high:+.3f}]"


def seen(log: list[dict[str, Any]], iteration: int) -> float:
    """Return the success in training over the last iterations up to one."""
    own = [row for row in log if row["kind"] == "episode" and iteration - _SMOOTH < row["step"] <= iteration]
    return sum(row["episodes"] * row["success"] for row in own) / sum(row["episodes"] for row in own)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--teacher", type=Path, default=Path("in_palm_rotate.teacher"), help="shipped, or a run's folder"
    )
    parser.add_argument("--lay-out", type=Path, nargs="+", help="folders of students that came back")
    parser.add_argument("--at-least", type=int, default=0, help="iterations; what learned fewer is left out, by name")
    parser.add_argument("--records", type=Path, help="folder for records of what is laid out")
    parser.add_argument("--notes", type=Path, help="text that follows the tables")
    parser.add_argument("--write", action="store_true")
    parser.add_argument("--task", default="in_palm_rotate")
    parser.add_argument("--config", default="default", help="configuration of the task; that of the teacher")
    parser.add_argument("--contacts", choices=list(CONTACTS), help="by default those of the teacher")
    parser.add_argument("--draw", type=int, help="seed of untrained networks and reservoirs; by default the student's")
    parser.add_argument("--pretrained", type=Path, help="weights of one training, for arms with a trained network")
    parser.add_argument("--arms", nargs="+", default=list(ARMS), choices=[*ARMS, *NETWORKS])
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--gpus", type=int, default=1)
    parser.add_argument("--no-agents", action="store_true", help="do not evaluate the teacher, zero and random again")
    parser.add_argument("--together", type=int, default=1, help="processes per GPU")
    parser.add_argument("--envs", type=int, default=4096)
    parser.add_argument("--iterations", type=int, default=300, help="after which each student stops")
    parser.add_argument("--learning-rate", type=float, help="by default the task's own (published)")
    parser.add_argument("--epochs", type=int, help="over each iteration's steps; by default the task's own (published)")
    parser.add_argument("--teacher-share", type=float, default=0.0, help="of the first iteration's actions")
    parser.add_argument("--teacher-iterations", type=int, default=0, help="over which that share falls to 0")
    parser.add_argument("--episodes", type=int, default=512, help="per evaluation seed, at least")
    parser.add_argument("--evaluations", type=int, default=3, help="seeds of evaluation, of --envs episodes each")
    parser.add_argument("--end", type=float, help="second since 1970 by which all is done")
    parser.add_argument("--reserve", type=float, default=_PER_EVALUATION, help="of it, for start and evaluation")
    parser.add_argument("--every", type=int, default=25, help="iterations between rows")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("policy-students"))
    parser.add_argument("--tar", type=Path, help="folder for what is kept; by default --out")
    parser.add_argument("--tars", type=int, default=5, help="files of weights at most; later arms keep none")
    parser.add_argument("--arm", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.lay_out is not None:
        lay_out(options)
    elif options.arm is None:
        together(options)
    elif options.arm == "agents":
        others(options)
    else:
        train(options)


if __name__ == "__main__":
    main()
