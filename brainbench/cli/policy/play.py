"""``brainbench policy play``: watch an agent."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from brainbench.cli.output import JsonOption, emit, progress_bar, table
from brainbench.cli.policy.options import (
    ConfigOption,
    DeviceOption,
    HandOption,
    NoisyOption,
    ObserveOption,
    PlacementOption,
    ResolutionOption,
    SeedOption,
    TaskArgument,
    TaskFileOption,
    agent_of,
    make_env,
    touch_of,
)


def play(
    task: TaskArgument,
    agent: Annotated[str, typer.Option(help="zero, random, a shipped policy, or a run's folder.")] = "random",
    video: Annotated[Path | None, typer.Option(help="Write a film here (.mp4 or .gif).")] = None,
    strip: Annotated[Path | None, typer.Option(help="Write six frames side by side here (.png).")] = None,
    seconds: Annotated[float, typer.Option(help="Simulated time.")] = 4.0,
    rate: Annotated[float, typer.Option(help="Frames per simulated second of a film.")] = 20.0,
    width: Annotated[int, typer.Option(help="Of a frame [pixels].")] = 480,
    hand: HandOption = "xhand1",
    config: ConfigOption = "default",
    task_file: TaskFileOption = None,
    observe: ObserveOption = "none",
    placement: PlacementOption = "hand",
    resolution: ResolutionOption = "med",
    noisy: NoisyOption = False,
    device: DeviceOption = "cpu",
    seed: SeedOption = 0,
    as_json: JsonOption = False,
) -> None:
    """Run an agent in one environment of a task and show what happens, as numbers and as a film."""
    import math

    from brainbench.core.errors import UsageError

    if not (seconds > 0 and math.isfinite(seconds) and rate > 0 and width >= 64):
        raise UsageError(
            f"A film has a positive length and rate, and 64 pixels or more across; received {seconds} s, "
            f"{rate} frames/s and {width} pixels."
        )
    touch = {"observe": observe, "placement": placement, "resolution": resolution, "noisy": noisy} | touch_of([agent])
    env = make_env(
        task, task_file=task_file, num_envs=1, hand=hand, config=config, device=device, seed=seed, threads=1, **touch
    )
    act = agent_of(agent, env, seed=seed)
    steps = max(round(seconds / env.step_dt), 1)
    pictures = [path for path in (video, strip) if path is not None]
    rewards: list[float] = []
    ended = 0
    with progress_bar() as progress:
        from brainbench.cli.policy import pictures as _picture

        size = (width, round(width * 5 / 6))
        stage = _picture.Stage(env, size) if pictures else None
        every = max(round(1 / (rate * env.step_dt)), 1)
        marks = {round(index * (steps - 1) / 5) for index in range(6)}
        film, stills, times = [], [], []
        for step in range(steps):
            wanted = (video is not None and step % every == 0) or (strip is not None and step in marks)
            if stage is not None and wanted:
                frame = stage.frame()
                film += [frame] if step % every == 0 else []
                if step in marks:
                    stills.append(frame)
                    times.append(step * env.step_dt)
            _, reward, terminated, truncated, _ = env.step(act(env.observations))
            rewards.append(float(reward))
            ended += int(terminated | truncated)
            progress(step + 1, steps, "playing")
        if video is not None:
            _picture.write_video(video, film, len(film), size, 1 / (every * env.step_dt))
        if strip is not None:
            _picture.write_strip(strip, stills, times)
    facts = {
        "task": env.task.name, "hand": env.hand.name, "agent": agent, "seconds": steps * env.step_dt,
        "reward": sum(rewards), "episodes_ended": ended, "metric": env.task.success.metric, "files": pictures,
    }  # fmt: skip
    rows = [
        [key, ", ".join(map(str, value)) if isinstance(value, list) else str(value)] for key, value in facts.items()
    ]
    emit(facts, table(env.task.text, ["", ""], rows), as_json=as_json)
