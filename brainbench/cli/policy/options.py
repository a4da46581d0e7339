"""Options that the commands on tasks share, and the environments and agents that they name."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from robotics_bridge.envs import Env

TaskArgument = Annotated[str, typer.Argument(help="A task: in_palm_rotate, in_hand_repose, screwdriver, hot_ball.")]
HandOption = Annotated[str, typer.Option(help="xhand1, sharpa, or a URDF or MJCF file.")]
ConfigOption = Annotated[str, typer.Option("--config", help="Configuration of the task: default, published, …")]
TaskFileOption = Annotated[
    Path | None, typer.Option("--task-file", help="Python file that registers a task of your own.")
]
ChangeOption = Annotated[
    list[str] | None,
    typer.Option("--change", help="Another number of the task: contacts=firm, is_dropped=-300, entropy=0, …"),
]
EnvsOption = Annotated[int, typer.Option("--envs", help="Environments at once.")]
DeviceOption = Annotated[str, typer.Option(help="cpu, or cuda for MuJoCo Warp.")]
ENV = "robotics_bridge.envs.options:EnvOptions"
TOUCH = ("observe", "placement", "resolution", "noisy")
"""Fields of the options of an environment that a student fixes."""


def make_env(
    name: str,
    *,
    config: str = "default",
    change: list[str] | None = None,
    task_file: Path | None = None,
    agents: Iterable[str] = (),
    **options: Any,
) -> Env:
    """Return the environment of a command; a task of the user's own is read first, then changed.

    Trained ``agents`` find the contacts in which they were trained, unless ``change`` names others or ``config`` is
    ``published``, which defines them.
    """
    from robotics_bridge import tasks
    from robotics_bridge.policies.fit import with_contacts_of
    from robotics_bridge.tasks.overrides import apply_overrides

    read_task_file(task_file)
    task, change = tasks.load(name, config), change or []
    if config != "published" and not any(word.startswith("contacts") for word in change):
        task = with_contacts_of(task, agents)
    return tasks.make(apply_overrides(task, change), **options)


def read_task_file(path: Path | None) -> None:
    """Run a Python file that registers tasks, if there is one."""
    from brainbench.core.plugins import load_module

    if path is not None:
        load_module(str(path.absolute()))


def check_names(task: str, agents: Iterable[str], task_file: Path | None = None) -> None:
    """Raise UsageError for an unknown task or agent, before anything slow is imported.

    Raises:
        UsageError: there is no such task, or no such agent or folder.
    """
    from brainbench.core.errors import check_name, unknown_name
    from robotics_bridge import tasks
    from robotics_bridge.policies import shipped

    if task_file is None:  # else the file may register the task
        check_name("task", task, tasks.list_tasks())
    known = (*shipped.AGENTS, *shipped.list_policies("teacher"), *shipped.list_policies("student"))
    for name in agents:
        if name not in known and not Path(name).exists():
            raise unknown_name("agent", name, known, hint="Or give the folder of a training run.")


def check_paths(video: Path | None, strip: Path | None) -> None:
    """Check before anything is played that a film and a strip can be written.

    Raises:
        UsageError: a path has another ending than .mp4 or .gif (film) or .png (strip), or cannot be written.
        MissingDependencyError: what writes this format is not installed.
    """
    from brainbench.core.figures.style import check_format
    from brainbench.core.files import check_folder
    from brainbench.stimuli.figures.films import require_writer

    for path, endings, option in ((video, (".mp4", ".gif"), "--video"), (strip, (".png",), "--strip")):
        if path is not None:
            require_writer(check_format(path, endings))
            check_folder(path.parent, option)


def agent_of(name: str, env: Env, *, seed: int = 0) -> Any:
    """Return the agent ``zero`` or ``random``, a shipped policy, or the teacher or student of a run's folder."""
    from robotics_bridge.policies import evaluate
    from robotics_bridge.policies.shipped import stored

    if name in evaluate.AGENTS:
        return evaluate.agent(name, env, seed=seed)
    if stored(name).get("brainbench_student"):
        from robotics_bridge.policies.fit import check_fit
        from robotics_bridge.policies.training.student_files import load_student

        student, described = load_student(name, device=str(env.device))
        check_fit(described, env, name)
        return evaluate.Policy(student)
    from robotics_bridge.policies.training import teacher

    return teacher.load_teacher(name, env)


def touch_of(names: list[str]) -> dict[str, Any]:
    """Return the tactile options of the student among some agents; nothing if there is none.

    Raises:
        UsageError: students with different senses are asked for at once.
    """
    from brainbench.core.errors import UsageError
    from robotics_bridge.policies.schema import Values
    from robotics_bridge.policies.shipped import stored

    found: dict[str, dict[str, Any]] = {}
    for name in names:
        if (facts := stored(name)).get("brainbench_student"):
            # Loads the students' networks, which other agents do not need.
            from robotics_bridge.policies.training.distill_config import DistillConfig

            kept = Values("config.json", facts).part("distill").fields(DistillConfig)
            found[name] = {key: kept[key] for key in TOUCH if key in kept}
            config = DistillConfig.of_run(kept)
            if config.knobs and config.observe in ("force", "force_torque"):
                found[name]["knobs"] = config.knobs
    if any(senses != next(iter(found.values())) for senses in found.values()):
        raise UsageError(f"The students {', '.join(found)} feel differently; evaluate them one at a time.")
    return next(iter(found.values()), {})
