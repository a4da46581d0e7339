"""``brainbench policy train | distill | sweep``: a teacher that knows everything, students that feel."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from brainbench.cli.options import filled_from, option, out_folder, out_folder_option, part_of, with_options
from brainbench.cli.output import Output, facts, progress_bar, table, table_of
from brainbench.core.errors import UsageError, check_name, unknown_name
from brainbench.core.files import lock_folder, read_json
from brainbench.core.plugins import load_module
from robotics_bridge.policies.shipped import stored

if TYPE_CHECKING:
    from robotics_bridge.envs import Env
    from robotics_bridge.policies.training.teacher import StudentRun


TaskArgument = Annotated[str, typer.Argument(help="A task: in_palm_rotate, in_hand_repose, screwdriver, hot_ball.")]
DISTILL = "robotics_bridge.policies.training.distill_config:DistillConfig"
HandOption = Annotated[str, option(DISTILL, "hand")]
TaskFileOption = Annotated[Path | None, typer.Option(help="Python file that registers a task of your own.")]
ENV, ENVS_FLAG = "robotics_bridge.envs.simulation:EnvOptions", {"num_envs": ("--envs",)}
DeviceOption = Annotated[str, option(ENV, "device")]
TOUCH = ("observe", "placement", "resolution", "noisy")
"""Fields of the options of an environment that a student fixes."""


@dataclass(frozen=True)
class World:
    """A task on a hand, as a command names it."""

    task: TaskArgument
    hand: HandOption = "xhand1"
    config: Annotated[str, option(DISTILL, "variant")] = "default"
    change: Annotated[
        list[str] | None, typer.Option(help="Another number of the task: contacts=firm, is_dropped=-300, entropy=0, …")
    ] = None
    task_file: TaskFileOption = None

    def check(self, agents: Iterable[str]) -> None:
        """Raise UsageError for an unknown task or agent, before anything slow is imported."""
        from robotics_bridge import tasks
        from robotics_bridge.policies import shipped

        if self.task_file is None:  # else the file may register the task
            check_name("task", self.task, tasks.list_tasks())
        choices = (*shipped.AGENTS, *shipped.list_policies("teacher"), *shipped.list_policies("student"))
        for name in agents:
            if name not in choices and not Path(name).exists():
                raise unknown_name("agent", name, choices, hint=shipped.HINT)

    def make(self, agents: Iterable[str] = (), **options: Any) -> Env:
        """Return its environment; a task of the user's own is read first, then changed.

        Trained ``agents`` find the contacts in which they were trained, unless ``change`` names others or ``config`` is
        ``published``, which defines them.
        """
        from robotics_bridge import tasks
        from robotics_bridge.policies.contract import with_contacts_of
        from robotics_bridge.tasks.registry import apply_overrides

        read_task_file(self.task_file)
        task, change = tasks.load(self.task, self.config), self.change or []
        if self.config != "published" and not any(word.startswith("contacts") for word in change):
            task = with_contacts_of(task, agents)
        return tasks.make(apply_overrides(task, change), hand=self.hand, **options)


def read_task_file(file: Path | None) -> None:
    """Run a file that registers a task, if one is given."""
    if file is not None:
        load_module(str(file.absolute()))


def in_world(command: Callable[..., Output]) -> Callable[..., Output]:
    """Decorate a command so that its parameter ``world`` is filled from an argument and options."""
    parameters = list(inspect.signature(World, eval_str=True).parameters.values())
    return filled_from(command, "world", parameters, lambda values: World(**values))


def agent_of(name: str, env: Env, *, seed: int = 0) -> Any:
    """Return the agent ``zero`` or ``random``, a shipped policy, or the teacher or student of a run's folder."""
    from robotics_bridge.policies import evaluate

    if name in evaluate.AGENTS:
        return evaluate.agent(name, env, seed=seed)
    if stored(name).get("brainbench_student"):
        from robotics_bridge.policies.contract import check_fit
        from robotics_bridge.policies.training.distill import load_student

        student, described = load_student(name, device=str(env.device))
        check_fit(described, env, name)
        return evaluate.Policy(student)
    from robotics_bridge.policies.training import teacher

    return teacher.load_teacher(name, env)


def touch_of(names: list[str]) -> dict[str, Any]:
    """Return the tactile options of the student among some agents; nothing if there is none."""
    from robotics_bridge.policies.contract import from_json

    touch: dict[str, dict[str, Any]] = {}
    for name in names:
        if (facts := stored(name)).get("brainbench_student"):
            # Loads the students' networks, which other agents do not need.
            from robotics_bridge.policies.training.distill_config import DistillConfig

            config = from_json(dict, facts.get("distill"), "distill of config.json")
            from_json(DistillConfig, config, "config.json")
            touch[name] = {key: config[key] for key in TOUCH if key in config}
    if any(senses != next(iter(touch.values())) for senses in touch.values()):
        raise UsageError(f"The students {', '.join(touch)} feel differently; evaluate them one at a time.")
    return next(iter(touch.values()), {})


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


DISTILL_FLAGS = ENVS_FLAG | {"variant": ("--config",)}
STUDENT = "robotics_bridge.policies.training.teacher:StudentRun"
OFFERED = (
    "encoder", "observe", "placement", "resolution", "noisy", "contacts", "embedder", "hand", "variant", "num_envs",
    "iterations", "learning_rate", "epochs", "hidden", "teacher_share", "teacher_iterations", "aggregate", "precision",
    "save_interval", "seed", "start",
)  # fmt: skip
"""Fields of a student's configuration that have a flag of their name."""


@with_options(STUDENT, ("episodes", "device", "stop_after", "stop_at"), parameter="how", build=False)
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
    teacher: Annotated[Path, option(DISTILL, "teacher")],
    options: dict[str, Any],
    of_encoder: dict[str, Any],
    how: dict[str, Any],
    out: Annotated[
        Path | None, typer.Option(callback=out_folder, help="Folder of the run; by default students/<what it is>.")
    ] = None,
    unroll: Annotated[
        str | None, typer.Option(help="Of a graph model: full answers at once, biological after a step per layer.")
    ] = None,
    task_file: TaskFileOption = None,
) -> Output:
    """Distil a teacher into a student that feels; a run that was interrupted goes on when it is started again."""
    from robotics_bridge.policies.encoders.arms import ARMS, AUTO
    from robotics_bridge.policies.training.distill_config import DistillConfig
    from robotics_bridge.policies.training.teacher import StudentRun, train_student

    # The learning of a network is stated in the names and tables of students.
    network = options["encoder"] not in (AUTO, *ARMS)
    settings = {"learning": "frozen", "time": "native"} | of_encoder if network else of_encoder
    settings |= {} if unroll is None else {"options": {"unroll": unroll}}
    read_task_file(task_file)
    config = DistillConfig(task=task, teacher=str(teacher), encoder_settings=settings, **options)
    folder = out or Path("students") / config.name
    with progress_bar() as progress:
        student = train_student(config, folder, StudentRun(**how), progress=progress)
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
@with_options(
    STUDENT, ("episodes", "evaluations", "device", "stop_at"), parameter="how", flags={"evaluations": ("--seeds",)}
)
def sweep(
    changes: dict[str, Any],
    how: StudentRun,
    file: Annotated[
        Path | None,
        typer.Argument(help="TOML file, or a shipped sweep: placement-and-type, … (docs/students.md); table-4.10."),
    ] = None,
    subset: Annotated[str, typer.Option(help="all, types, encoders, or an observation type.")] = "all",
    count: Annotated[bool, typer.Option("--count", help="Print how many students there are, and stop.")] = False,
    names: Annotated[bool, typer.Option("--list", help="Print their names, and stop.")] = False,
    out: Annotated[Path, typer.Option(callback=out_folder, help="Folder of the runs.")] = Path("students"),
    shard: Annotated[str, typer.Option(help="Part of the students, as 0/4.")] = "0/1",
    task_file: TaskFileOption = None,
) -> Output:
    """Distil every student of a sweep that is not finished yet; what was interrupted goes on.

    Start it once on each GPU, with the same folder: every process takes the next student that none has.
    """
    from robotics_bridge.policies.training.distill_config import PUBLISHED, read_sweep
    from robotics_bridge.policies.training.teacher import EVALUATION, is_done, success_of, train_student

    read_task_file(task_file)
    plan = read_sweep(file or PUBLISHED)
    if count:
        numbers = plan.count(subset)
        rows = [[name, str(value)] for name, value in {**numbers["entries"], **numbers["types"]}.items()]
        more = numbers["students"] - numbers["published"]
        extra = f" ({numbers['published']} without {', '.join(plan.extra_types)})" if more else ""
        text = table("", ["entry or type", "students"], rows, right=(1,))
        return Output(
            numbers, f"{text}\n\n{numbers['students']} students in {Path(file or PUBLISHED).stem}, {subset}{extra}"
        )
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
            if is_done(student, folder, how.stop_at):
                status, success = "there already", success_of(read_json(folder / EVALUATION))
            else:
                with progress_bar() as progress:
                    done = train_student(student, folder, how, progress=progress)
                status, success = done.result.status, done.success
            results.append({"student": student.name, "status": status, "success": success})
    columns = {
        "student": "{0[student]}",
        "status": "{0[status]}",
        ">success": lambda row: "–" if row["success"] is None else f"{row['success']:.3f}",
    }
    return Output(results, table_of("", results, columns))
