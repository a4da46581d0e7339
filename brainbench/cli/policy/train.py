"""``brainbench policy train``: train the privileged teacher of a task."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from brainbench.cli.output import JsonOption, emit, progress_bar, table
from brainbench.cli.policy.options import (
    ConfigOption,
    DeviceOption,
    HandOption,
    SeedOption,
    TaskArgument,
    TaskFileOption,
    read_task_file,
)


def train(
    task: TaskArgument,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder of the run; started again, it goes on.")
    ] = None,
    envs: Annotated[int | None, typer.Option("--envs", help="Environments at once (published: 8192).")] = None,
    iterations: Annotated[int | None, typer.Option(help="In total, earlier ones of the run included.")] = None,
    minutes: Annotated[float | None, typer.Option(help="Stop and save after this time.")] = None,
    hand: HandOption = "xhand1",
    config: ConfigOption = "default",
    task_file: TaskFileOption = None,
    steps: Annotated[int | None, typer.Option(help="Control steps per environment and iteration.")] = None,
    curiosity: Annotated[float | None, typer.Option(help="Weight of the RND reward (published: 100).")] = None,
    initial_std: Annotated[float | None, typer.Option(help="Of the first policy's actions (published: 1).")] = None,
    start: Annotated[
        Path | None, typer.Option(help="Begin with the networks of another run: its folder or one of its models.")
    ] = None,
    start_std: Annotated[
        float | None, typer.Option(help="Of the actions of --start's policy, to explore anew.")
    ] = None,
    change: Annotated[
        list[str] | None,
        typer.Option(help="Another number of the task: is_dropped=-300, goal.start_threshold=0.4, entropy=0, …"),
    ] = None,
    save_every: Annotated[int, typer.Option(help="Iterations between checkpoints.")] = 50,
    device: DeviceOption = "cpu",
    seed: SeedOption = 0,
    as_json: JsonOption = False,
) -> None:
    """Train the teacher of a task by PPO, or go on with a run.

    The run's folder holds checkpoints, log.jsonl and TensorBoard events. A killed run goes on from its last
    checkpoint exactly as if nothing had happened.
    """
    from dataclasses import replace

    from robotics_bridge import tasks
    from robotics_bridge.policies.training import teacher
    from robotics_bridge.tasks.overrides import changed

    count = envs or (8192 if device != "cpu" else 64)
    if task_file is not None:
        read_task_file(task_file)
    chosen_task = changed(tasks.load(task, config), change or ())
    env = tasks.make(chosen_task, num_envs=count, hand=hand, device=device, seed=seed)
    given: dict[str, Any] = {"steps_per_env": steps, "rnd_weight": curiosity, "initial_std": initial_std}
    chosen = {name: value for name, value in given.items() if value is not None}
    settings = replace(chosen_task.teacher, num_envs=count, **chosen)
    run = out or Path("runs") / f"{task}-{env.hand.name}-{seed}"
    with progress_bar() as progress:
        result = teacher.train(
            env, run, iterations=iterations, minutes=minutes, settings=settings, seed=seed, save_every=save_every,
            start=start, start_std=start_std, progress=progress,
        )  # fmt: skip
    last = dict(result.history[-1]) if result.history else {}
    facts = {
        "run": result.run, "iterations": result.iterations, "control_steps": result.steps, "seconds": result.seconds,
        "reward": last.get("reward"), "success": last.get("episode/success"),
    }  # fmt: skip
    rows = [[key, f"{value:.4g}" if isinstance(value, float) else str(value)] for key, value in facts.items()]
    emit(facts | {"last": last}, table("", ["", ""], rows), as_json=as_json)
