"""Options that the commands on tasks share, and the environments and agents that they name."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from brainbench.cli.options import filled_from, option
from brainbench.cli.output import Output

if TYPE_CHECKING:
    from robotics_bridge.envs import Env

TaskArgument = Annotated[str, typer.Argument(help="A task: in_palm_rotate, in_hand_repose, screwdriver, hot_ball.")]
HandOption = Annotated[str, typer.Option(help="xhand1, sharpa, or a URDF or MJCF file.")]
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
    config: Annotated[str, typer.Option(help="Configuration of the task: default, published, …")] = "default"
    change: Annotated[
        list[str] | None, typer.Option(help="Another number of the task: contacts=firm, is_dropped=-300, entropy=0, …")
    ] = None
    task_file: TaskFileOption = None

    def check(self, agents: Iterable[str]) -> None:
        """Raise UsageError for an unknown task or agent, before anything slow is imported."""
        from brainbench.core.errors import check_name, unknown_name
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
    from brainbench.core.plugins import load_module

    if file is not None:
        load_module(str(file.absolute()))


def in_world(command: Callable[..., Output]) -> Callable[..., Output]:
    """Decorate a command so that its parameter ``world`` is filled from an argument and options."""
    parameters = list(inspect.signature(World, eval_str=True).parameters.values())
    return filled_from(command, "world", parameters, lambda values: World(**values))


def agent_of(name: str, env: Env, *, seed: int = 0) -> Any:
    """Return the agent ``zero`` or ``random``, a shipped policy, or the teacher or student of a run's folder."""
    from robotics_bridge.policies import evaluate
    from robotics_bridge.policies.shipped import stored

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
    from brainbench.core.errors import UsageError
    from robotics_bridge.policies.contract import from_json
    from robotics_bridge.policies.shipped import stored

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
