"""``brainbench policy tasks | play | evaluate``: what there is to do, and how well agents do it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from brainbench.cli.options import out_file, out_file_option, with_options
from brainbench.cli.output import Output, facts, progress_bar, table_of
from brainbench.cli.policy.train import ENV, ENVS_FLAG, TOUCH, World, agent_of, in_world, touch_of
from brainbench.core.errors import check_number
from brainbench.core.figures import check_format
from brainbench.core.limits import Limit, Positive
from robotics_bridge.policies.shipped import list_policies, stored


def tasks_() -> Output:
    """List the tasks with their success, length, observation groups, and the policies that come with the package."""
    from robotics_bridge import tasks
    from robotics_bridge.policies.contract import trained_contacts
    from robotics_bridge.tasks.settings import contacts_name

    rows = []
    for name in tasks.list_tasks():
        task = tasks.load(name)
        student = [*task.groups["student"], "tactile"]
        shipped = [*list_policies("teacher", name), *list_policies("student", name)]
        rows.append(
            {
                "task": name,
                "text": task.text,
                "seconds": task.episode,
                "metric": task.success.metric,
                "success_from": task.success.threshold,
                "student": student,
                "teacher": list(task.groups["actor"]),
                "shipped": shipped,
                "contacts": {policy: contacts_name(trained_contacts(stored(policy))) for policy in shipped},
            }
        )
    columns = {
        "task": "{0[task]}",
        "what to do": "{0[text]}",
        ">episode, s": "{0[seconds]:g}",
        "success": "{0[metric]} ≥ {0[success_from]:.3g}",
        "student sees": lambda row: ", ".join(row["student"]),
    }
    policies = [(name, row["task"], row["contacts"][name]) for row in rows for name in row["shipped"]]
    heads = ("trained policy", "task", "contacts")
    trained = table_of("", policies, {head: f"{{0[{index}]}}" for index, head in enumerate(heads)})
    return Output(rows, f"{table_of('', rows, columns)}\n\n{trained}")


@dataclass(frozen=True)
class Film:
    """How long an agent acts, and the frames of a film of it."""

    seconds: Positive = 4.0
    """Simulated time."""
    rate: Positive = 20.0
    """Frames per simulated second of a film."""
    width: Annotated[int, Limit(least=64)] = 480
    """Width of a frame [pixels]."""


@with_options(ENV, (*TOUCH, "device", "seed"), build=False)
@with_options("brainbench.cli.policy.play:Film", parameter="film")
@in_world
def play(
    world: World,
    options: dict[str, Any],
    film: Film,
    agent: Annotated[str, typer.Option(help="zero, random, a shipped policy, or a run's folder.")] = "random",
    video: Annotated[Path | None, typer.Option(callback=out_file, help="Write a film here (.mp4 or .gif).")] = None,
) -> Output:
    """Run an agent in one environment of a task and show what happens, as numbers and as a film."""
    from robotics_bridge.tasks.settings import contacts_name

    world.check([agent])
    if video is not None:
        check_format(video, (".mp4", ".gif"))
        from brainbench.cli.tactile.scenes import Stage, write_video
    # After the checks of names, which need no torch.
    from robotics_bridge.policies.evaluate import forget

    options |= touch_of([agent])
    env = world.make([agent], num_envs=1, threads=1, **options)
    act = agent_of(agent, env, seed=options["seed"])
    steps = max(round(film.seconds / env.step_dt), 1)
    rewards: list[float] = []
    ended, dropped, goals, turned = 0, 0, 0, 0.0
    with progress_bar() as progress:
        size, frames = (film.width, round(film.width * 5 / 6)), []
        stage = None if video is None else Stage(env, size)
        every = max(round(1 / (film.rate * env.step_dt)), 1)
        for step in range(steps):
            if stage is not None and step % every == 0:
                frames.append(stage.frame())
            _, reward, terminated, truncated, info = env.step(act(env.observations))
            rewards.append(float(reward))
            over = bool(terminated | truncated)
            ended += over
            if over:
                forget(act, terminated | truncated)
            dropped += bool(info["dropped"])
            if over or step == steps - 1:
                goals, turned = goals + int(info["goals"]), turned + float(info["turned"])
            progress(step + 1, steps, "playing")
        if video is not None:
            write_video(video, frames, size, 1 / (every * env.step_dt))
    result = {
        "task": env.task.name, "hand": env.hand.name, "contacts": contacts_name(env.task.contacts), "agent": agent,
        "seconds": steps * env.step_dt, "reward": sum(rewards), "episodes_ended": ended,
        "metric": env.task.success.metric, "files": [] if video is None else [video],
        "goals": goals, "turned": turned, "dropped": dropped,
    }  # fmt: skip
    lines: dict[str, object] = {
        "task": result["task"], "hand": result["hand"], "contacts": result["contacts"], "agent": agent,
        "simulated": f"{result['seconds']:g} s",
        # What a task does not count stays unsaid.
        **({"goals reached": goals} if env.task.goal is not None else {}),
        **({"turned": f"{round(turned, 2) + 0:.2f} rad about the commanded axis"} if env.task.turns else {}),
        "dropped": f"{dropped} times", "episodes ended": ended, "reward": f"{sum(rewards):.3g}",
    }  # fmt: skip
    lines |= {} if video is None else {"files": video}
    return Output(result, f"{env.task.text}\n\n{facts(lines)}")


# As in our records: every object of in_palm_rotate twice.
@with_options(ENV, ("num_envs", "device"), flags=ENVS_FLAG, defaults={"num_envs": 34}, build=False)
@in_world
def evaluate(
    world: World,
    options: dict[str, Any],
    agents: Annotated[
        list[str] | None,
        typer.Argument(help="Shipped policies, or folders of teachers or students; zero and random always run."),
    ] = None,
    episodes: Annotated[int, typer.Option(help="Per agent and seed.")] = 100,
    seeds: Annotated[int, typer.Option(help="Evaluation seeds.")] = 3,
    out: Annotated[Path | None, out_file_option("Write the result as JSON here too.")] = None,
) -> Output:
    """Compare agents over whole episodes: success rate with its 95 % interval, and what it does not tell.

    The last column is the success by kind of object; ``--out`` and ``--json`` say it for each object.
    Beside success stand the task's metric, the return, the rate of rotation about the commanded axis while anything
    touched the object (rad/s), the mean duration (s) and the share of episodes that a drop (or another ending of the
    task) ended.
    """
    from robotics_bridge.policies.evaluate import evaluate as run
    from robotics_bridge.tasks.settings import contacts_name

    check_number("--seeds", seeds, least=1)
    world.check(agents or [])
    env = world.make(agents or (), **options, **touch_of(agents or []))
    contacts = contacts_name(env.task.contacts)
    names = ["zero", "random", *(name for name in agents or [] if name not in ("zero", "random"))]
    # All are read before the first one runs: an unfit last one would else be told after minutes.
    acting = {name: agent_of(name, env) for name in names}
    rows: list[dict[str, Any]] = []
    with progress_bar() as progress:
        for name, act in acting.items():
            result = run(env, act, episodes=episodes, seed=tuple(range(seeds)), name=name, progress=progress)
            rows.append({**result.summary(), "contacts": contacts})
    columns = {
        "agent": "{0[agent]}",
        ">episodes": "{0[episodes]}",
        ">success": "{0[success_rate]:.3f}",
        ">95 %": lambda row: "{:.3f}–{:.3f}".format(*row["success_interval"]),
        f">{env.task.success.metric}": "{0[metric]:.3g} ± {0[metric_half_width]:.2g}",
        ">return": "{0[returns]:.4g} ± {0[returns_half_width]:.2g}",
        ">rad/s": "{0[turn_rate]:.3g} ± {0[turn_rate_half_width]:.2g}",
        ">s": "{0[seconds]:.3g}",
        ">dropped": "{0[dropped]:.3f}",
        ">diverged": "{0[diverged]}",
        ">by object": lambda row: _by_kind(row["objects"]),
    }
    return Output(rows, table_of(f"{env.task.text}; contacts: {contacts}", rows, columns), out=out)


def _by_kind(objects: Mapping[str, Mapping[str, float]]) -> str:
    """Return the success with each kind of object, the first word of its name."""
    counts: dict[str, list[float]] = {}
    for name, share in objects.items():
        won, of = counts.setdefault(name.partition(" ")[0], [0.0, 0.0])
        counts[name.partition(" ")[0]] = [won + share["success_rate"] * share["episodes"], of + share["episodes"]]
    return ", ".join(f"{kind} {won / of:.2f}" for kind, (won, of) in counts.items())
