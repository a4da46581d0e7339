"""``brainbench policy evaluate``: success rates of agents, with intervals."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from brainbench.cli.output import JsonOption, emit, progress_bar, table
from brainbench.cli.policy.options import (
    ConfigOption,
    DeviceOption,
    EnvsOption,
    HandOption,
    TaskArgument,
    TaskFileOption,
    agent_of,
    make_env,
    touch_of,
)


def evaluate(
    task: TaskArgument,
    agents: Annotated[
        list[str] | None,
        typer.Argument(help="Shipped policies, or folders of teachers or students; zero and random always run."),
    ] = None,
    episodes: Annotated[int, typer.Option(help="Per agent and seed.")] = 100,
    seeds: Annotated[int, typer.Option(help="Evaluation seeds.")] = 3,
    envs: EnvsOption = 32,
    hand: HandOption = "xhand1",
    config: ConfigOption = "default",
    task_file: TaskFileOption = None,
    device: DeviceOption = "cpu",
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Write the result as JSON here too.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Compare agents over whole episodes: success rate with its 95 % interval, and what it does not tell.

    Beside success stand the task's metric, the return, the rate of rotation about the commanded axis while anything
    touched the object (rad/s), the mean duration (s) and the share of episodes that a drop (or another ending of the
    task) ended.
    """
    from brainbench.core.errors import UsageError
    from brainbench.core.files import write_json
    from robotics_bridge.policies.evaluate import evaluate as run

    if seeds < 1:
        raise UsageError(f"An evaluation needs at least one seed; received {seeds}.")
    touch = touch_of(list(agents or []))
    env = make_env(task, task_file=task_file, num_envs=envs, hand=hand, config=config, device=device, **touch)
    names = ["zero", "random", *(name for name in agents or [] if name not in ("zero", "random"))]
    found: list[dict[str, Any]] = []
    with progress_bar() as progress:
        for name in names:
            result = run(
                env, agent_of(name, env), episodes=episodes, seed=tuple(range(seeds)), name=name, progress=progress
            )
            found.append(result.summary())
    if out is not None:
        write_json(out, found)
    rows = [
        [
            r["agent"], str(r["episodes"]), f"{r['success_rate']:.3f}",
            "{:.3f}–{:.3f}".format(*r["success_interval"]), f"{r['metric']:.3g} ± {r['metric_half_width']:.2g}",
            f"{r['returns']:.4g} ± {r['returns_half_width']:.2g}",
            f"{r['turn_rate']:.3g} ± {r['turn_rate_half_width']:.2g}", f"{r['seconds']:.3g}", f"{r['dropped']:.3f}",
            str(r["diverged"]),
        ]
        for r in found
    ]  # fmt: skip
    columns = ["agent", "episodes", "success", "95 %", env.task.success.metric, "return", "rad/s", "s", "dropped"]
    text = table(env.task.text, [*columns, "diverged"], rows, right=tuple(range(1, 10)))
    emit(found, text, as_json=as_json)
