"""``brainbench policy train | distill | sweep``: a teacher that knows everything, students that feel."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from brainbench.cli.options import out_folder, out_folder_option, part_of, with_options
from brainbench.cli.output import Output, facts, progress_bar, table, table_of
from brainbench.cli.policy.options import (
    ENV,
    ENVS_FLAG,
    DeviceOption,
    TaskArgument,
    TaskFileOption,
    World,
    in_world,
    read_task_file,
)


@with_options(
    "robotics_bridge.policies.training.teacher:TeacherRun",
    ("iterations", "minutes", "start", "start_std", "observe", "encoder", "loggers", "save_every", "seed"),
)
@with_options(
    "robotics_bridge.tasks.settings:TeacherSettings",
    ("num_envs", "steps_per_env", "rnd_weight", "initial_std"),
    parameter="changes",
    flags=ENVS_FLAG | {"steps_per_env": ("--steps",), "rnd_weight": ("--curiosity",)},
    given=True,
)
@with_options(
    ENV,
    ("observe", "placement", "resolution", "device"),
    parameter="simulation",
    flags={"observe": ("--touch",)},
    defaults={"observe": "agg_bool"},
    build=False,
)
@in_world
def train(
    world: World,
    options: Any,
    changes: dict[str, Any],
    simulation: dict[str, Any],
    out: Annotated[Path | None, out_folder_option("Folder of the run; started again, it goes on.")] = None,
) -> Output:
    """Train the teacher of a task by PPO, or go on with a run.

    With --observe proprio,touch the policy reads what a hand has, and remembers (recurrent PPO); the folder ``policy``
    of its run is a student's, for play, evaluate, export and deploy. The run's folder holds checkpoints, log.jsonl and
    TensorBoard events. A killed run goes on from its last checkpoint exactly as if nothing had happened.
    """
    from robotics_bridge.policies.training import teacher

    changes = {"num_envs": 8192 if simulation["device"] != "cpu" else 64} | changes
    if "touch" not in options.observe:
        simulation = {"device": simulation["device"]}
    env = world.make(num_envs=changes["num_envs"], seed=options.seed, **simulation)
    settings = replace(env.task.teacher, **changes)
    run = out or Path("runs") / f"{world.task}-{env.hand.name}-{options.seed}"
    with progress_bar() as progress:
        result = teacher.train(env, run, options, settings=settings, progress=progress)
    last = dict(result.history[-1]) if result.history else {}
    summary = {
        "run": result.folder, "iterations": result.iterations, "control_steps": result.steps, "seconds": result.seconds,
        "reward": last.get("reward"), "success": last.get("episode/success"),
    }  # fmt: skip
    lines = {key: f"{value:.4g}" if isinstance(value, float) else value for key, value in summary.items()}
    return Output(summary | {"last": last}, facts(lines))


DISTILL = "robotics_bridge.policies.training.distill_config:DistillConfig"
DISTILL_FLAGS = ENVS_FLAG | {"variant": ("--config",)}
OFFERED = (
    "encoder", "observe", "placement", "resolution", "noisy", "contacts", "embedder", "hand", "variant", "num_envs",
    "iterations", "learning_rate", "epochs", "hidden", "teacher_share", "teacher_iterations", "aggregate", "precision",
    "save_interval", "seed", "start",
)  # fmt: skip
"""Fields of a student's configuration that have a flag of their name."""


@with_options(DISTILL, OFFERED, flags=DISTILL_FLAGS, build=False)
@with_options(
    "robotics_bridge.policies.encoders.arms:EncoderConfig",
    ("learning", "time", "seed", "pretrained", "units"),
    parameter="of_encoder",
    flags={"seed": ("--draw",)},
    given=True,
)
def distill(
    task: TaskArgument,
    teacher: Annotated[Path, typer.Option(help="A shipped teacher, or a folder of brainbench policy train.")],
    options: dict[str, Any],
    of_encoder: dict[str, Any],
    out: Annotated[
        Path | None, typer.Option(callback=out_folder, help="Folder of the run; by default students/<what it is>.")
    ] = None,
    unroll: Annotated[
        str | None, typer.Option(help="Of a graph model: full answers at once, biological after a step per layer.")
    ] = None,
    episodes: Annotated[int, typer.Option(help="Of the evaluation, per seed; 0 for none.")] = 100,
    device: DeviceOption = "cpu",
    stop_after: Annotated[float | None, typer.Option(help="Save, stop and evaluate after so many seconds.")] = None,
    stop_at: Annotated[int | None, typer.Option(help="Likewise after so many iterations in all.")] = None,
    task_file: TaskFileOption = None,
) -> Output:
    """Distil a teacher into a student that feels; a run that was interrupted goes on when it is started again."""
    from robotics_bridge.policies.encoders.arms import ARMS, AUTO
    from robotics_bridge.policies.training.distill_config import DistillConfig
    from robotics_bridge.policies.training.students import train_student

    # The learning of a network is stated in the names and tables of students.
    network = options["encoder"] not in (AUTO, *ARMS)
    settings = {"learning": "frozen", "time": "native"} | of_encoder if network else of_encoder
    settings |= {} if unroll is None else {"options": {"unroll": unroll}}
    read_task_file(task_file)
    config = DistillConfig(task=task, teacher=str(teacher), encoder_settings=settings, **options)
    folder = out or Path("students") / config.name
    with progress_bar() as progress:
        student = train_student(
            config, folder, device=device, episodes=episodes, stop_after=stop_after, stop_at=stop_at, progress=progress
        )
    result = {
        "folder": str(student.folder),
        **{name: getattr(student.result, name) for name in ("status", "reason", "iterations", "loss")},
        "success": student.success,
        "episodes": sum(len(evaluation["success"]) for evaluation in student.evaluations),
        "seconds": round(student.result.seconds, 1),
    }
    lines = [f"{key}: {value}" for key, value in result.items() if value not in ("", None)]
    failure = typer.Exit(1) if student.result.status == "diverged" else None
    return Output(result, "\n".join(lines), failure=failure)


@with_options(DISTILL, ("num_envs", "iterations"), parameter="changes", flags=DISTILL_FLAGS, given=True)
def sweep(
    changes: dict[str, Any],
    file: Annotated[
        Path | None,
        typer.Argument(help="TOML file, or a shipped sweep: placement-and-type, … (docs/students.md); table-4.10."),
    ] = None,
    subset: Annotated[str, typer.Option(help="all, types, encoders, or an observation type.")] = "all",
    count: Annotated[bool, typer.Option("--count", help="Print how many students there are, and stop.")] = False,
    names: Annotated[bool, typer.Option("--list", help="Print their names, and stop.")] = False,
    out: Annotated[Path, typer.Option(callback=out_folder, help="Folder of the runs.")] = Path("students"),
    shard: Annotated[str, typer.Option(help="Part of the students, as 0/4.")] = "0/1",
    stop_at: Annotated[int | None, typer.Option(help="Stop each student, and evaluate it, after so many.")] = None,
    episodes: Annotated[int, typer.Option(help="Of the evaluation, per seed.")] = 100,
    evaluations: Annotated[int, typer.Option("--seeds", help="Seeds of the evaluation.", min=1, max=3)] = 3,
    device: DeviceOption = "cpu",
    task_file: TaskFileOption = None,
) -> Output:
    """Distil every student of a sweep that is not finished yet; what was interrupted goes on.

    Start it once on each GPU, with the same folder: every process takes the next student that none has.
    """
    from brainbench.core.errors import UsageError
    from brainbench.core.files import lock_folder, read_json
    from robotics_bridge.policies.training.distill_config import PUBLISHED, read_sweep
    from robotics_bridge.policies.training.students import EVALUATION, is_done, success_of, train_student

    read_task_file(task_file)
    plan = read_sweep(file or PUBLISHED)
    if count:
        numbers = plan.count(subset)
        rows = [[name, str(value)] for name, value in {**numbers["entries"], **numbers["types"]}.items()]
        more = numbers["students"] - numbers["published"]
        extra = f" ({numbers['published']} without {', '.join(plan.extra_types)})" if more else ""
        text = table("", ["entry or type", "students"], rows, right=(1,))
        return Output(numbers, f"{text}\n\n{numbers['students']} students in {plan.name}, {subset}{extra}")
    part, parts = part_of(shard, "--shard takes")
    students = [replace(student, **changes) for student in plan.students(subset)][part::parts]
    if names:
        return Output([student.name for student in students], "\n".join(student.name for student in students))
    results = []
    for student in students:
        folder = out / student.name
        with ExitStack() as held:
            try:
                held.enter_context(lock_folder(out / ".taken" / student.name, wait=False))
            except UsageError:
                results.append({"student": student.name, "status": "at another process", "success": None})
                continue
            if is_done(student, folder, stop_at):
                status, success = "there already", success_of(read_json(folder / EVALUATION))
            else:
                with progress_bar() as progress:
                    done = train_student(
                        student, folder, device=device, episodes=episodes, evaluations=evaluations, stop_at=stop_at,
                        progress=progress,
                    )  # fmt: skip
                status, success = done.result.status, done.success
            results.append({"student": student.name, "status": status, "success": success})
    columns = {
        "student": "{0[student]}",
        "status": "{0[status]}",
        ">success": lambda row: "–" if row["success"] is None else f"{row['success']:.3f}",
    }
    return Output(results, table_of("", results, columns))
