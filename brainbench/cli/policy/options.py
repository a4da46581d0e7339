"""Options that the commands on tasks share, and the environment that they describe."""

from __future__ import annotations

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
EnvsOption = Annotated[int, typer.Option("--envs", help="Environments at once.")]
DeviceOption = Annotated[str, typer.Option(help="cpu, or cuda for MuJoCo Warp.")]
SeedOption = Annotated[int, typer.Option(help="Of all random numbers.")]
ObserveOption = Annotated[str, typer.Option(help="Tactile observation type (table 4.3); none builds no sensor.")]
PlacementOption = Annotated[str, typer.Option(help="Taxels on: hand, fingers, tips or palm.")]
ResolutionOption = Annotated[str, typer.Option(help="Of the taxels: low, med or high.")]
NoisyOption = Annotated[bool, typer.Option("--noisy", help="Taxels with the published imperfections.")]


def make_env(name: str, *, task_file: Path | None = None, **options: Any) -> Env:
    """Return the environment of a command; a task of the user's own is read first."""
    from robotics_bridge import tasks

    if task_file is not None:
        read_task_file(task_file)
    return tasks.make(name, **options)


def read_task_file(path: Path) -> None:
    """Run a Python file that registers tasks.

    Raises:
        DataError: it is missing, or fails.
    """
    import importlib.util

    from brainbench.core.errors import BrainbenchError, DataError, DataFileNotFoundError

    if not path.is_file():
        raise DataFileNotFoundError(f"There is no task file {str(path)!r}.")
    spec = importlib.util.spec_from_file_location(path.stem, path)
    if spec is None or spec.loader is None:
        raise DataError(f"{str(path)!r} is no Python file.")
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except BrainbenchError:
        raise
    except Exception as error:
        raise DataError(f"The task file {str(path)!r} failed: {type(error).__name__}: {error}.") from error


def agent_of(name: str, env: Env, *, seed: int = 0) -> Any:
    """Return the agent ``zero`` or ``random``, a shipped policy, or the teacher or student of a run's folder."""
    from brainbench.core.errors import unknown_name
    from brainbench.core.files import read_json
    from robotics_bridge.policies import evaluate, shipped
    from robotics_bridge.policies.training import teacher

    if name in evaluate.AGENTS:
        return evaluate.agent(name, env, seed=seed)
    known = (*evaluate.AGENTS, *shipped.list_teachers(), *shipped.list_students())
    if name not in known and not Path(name).exists():
        raise unknown_name("agent", name, known, hint="Or give the folder of a training run.")
    config = _folder(name) / "config.json"
    if config.is_file() and read_json(config).get("brainbench_student"):
        from robotics_bridge.policies.training.distill import StudentPolicy, load_student

        student, _ = load_student(name, device=str(env.device))
        return StudentPolicy(student)
    return teacher.load_teacher(name, env)


def _folder(name: str) -> Path:
    from robotics_bridge.policies.shipped import FOLDER

    return FOLDER / name if not Path(name).exists() and (FOLDER / name).is_dir() else Path(name)


def touch_of(names: list[str]) -> dict[str, Any]:
    """Return the tactile options of the student among some agents; nothing if there is none.

    Raises:
        UsageError: students with different senses are asked for at once.
    """
    from brainbench.core.errors import UsageError
    from brainbench.core.files import read_json

    found: dict[str, dict[str, Any]] = {}
    for name in names:
        config = _folder(name) / "config.json"
        if config.is_file():
            facts = read_json(config)
            if facts.get("brainbench_student"):
                kept = facts.get("distill", facts)
                found[name] = {key: kept[key] for key in _TOUCH if key in kept}
    if any(senses != next(iter(found.values())) for senses in found.values()):
        raise UsageError(f"The students {', '.join(found)} feel differently; evaluate them one at a time.")
    return next(iter(found.values()), {})


_TOUCH = ("observe", "placement", "resolution", "noisy")
