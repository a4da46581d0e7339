"""``brainbench policy probe``: what can be read from the features of tactile encoders, before anything is trained."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from brainbench.cli.options import option, out_file, out_file_option, with_options
from brainbench.cli.output import Output, progress_bar, table_of
from brainbench.cli.policy.train import ENV, ENVS_FLAG, World, agent_of, in_world, touch_of

PROBE = "robotics_bridge.policies.readouts.probe:ProbeOptions"


@with_options(PROBE, ("seconds", "reservoirs", "untrained", "place", "draws", "seed"))
@with_options(
    ENV, ("num_envs", "device"), parameter="simulation", flags=ENVS_FLAG, defaults={"num_envs": 48}, build=False
)
@in_world
def probe(
    world: World,
    options: Any,
    simulation: dict[str, Any],
    agent: Annotated[str, typer.Option(help="Policy that acts: a shipped teacher, or a run's folder.")],
    arm: Annotated[list[str] | None, option(PROBE, "arms")] = None,
    network: Annotated[list[str] | None, option(PROBE, "networks")] = None,
    layout: Annotated[
        Path | None, typer.Option(callback=out_file, help="Write the taxels that --place chose here, as a probe file.")
    ] = None,
    out: Annotated[Path | None, out_file_option("Write the result as JSON here too.")] = None,
) -> Output:
    """Read object position, velocity, spin and contact linearly from what encoders make of one rollout's touch.

    Prints R² on environments left out, with 95 % intervals over environments and draws, and the differences of trained
    networks from random ones. It says what an encoder lets a policy know, and takes a minute or two. With --place 50 it
    chooses so many taxels on one half of the environments and reads from them on the other, beside all, random and
    evenly spread ones.
    """
    from dataclasses import replace

    from brainbench.core.errors import UsageError
    from robotics_bridge.hands.layouts import write_probes
    from robotics_bridge.policies.readouts import probe as readouts
    from robotics_bridge.tasks.settings import contacts_name

    options = replace(options, arms=tuple(arm or ()), networks=tuple(network or ()))
    if layout is not None and options.place is None:
        raise UsageError("--layout takes the taxels that --place NUMBER chooses; received none.")
    world.check([agent])
    touch = touch_of([agent])  # A student acts on what it feels; one that feels nothing is asked what it could feel.
    touch = touch if touch.get("observe", "none") != "none" else {"observe": "force_torque"}
    env = world.make([agent], seed=options.seed, **simulation, **touch)
    result: dict[str, Any] = {"task": world.task, "config": world.config, "change": world.change or [], "agent": agent}
    result |= {"contacts": contacts_name(env.task.contacts), "environments": env.num_envs, "seconds": options.seconds}
    result["noisy"] = env.options.noisy
    with progress_bar() as progress:
        policy = agent_of(agent, env)
        if options.place is None:
            readings = readouts.probe(env, policy, options, progress)
            result["arms"] = [readouts.plain(item) for item in readings]
            result["differences"] = readouts.differences(readings)
        else:
            placed, chosen = readouts.place(env, policy, options, progress)
            result |= {"place": options.place, **readouts.placements(placed)}
            if layout is not None:
                write_probes(layout, chosen)
    size = "features" if options.place is None else "taxels"
    text = _table("R² on environments left out, by object quantity", result["arms"], size, "draws")
    if result["differences"]:
        text += "\n" + _table("Differences of R²", result["differences"], "less", sign="+")
    return Output(result, text, out=out)


def _table(title: str, rows: list[dict[str, Any]], *more: str, sign: str = "") -> str:
    from robotics_bridge.policies.readouts.features import TARGETS

    columns: dict[str, Any] = {"arm": "{0[arm]}"} | {
        f">{name}" * (name != "less") or name: f"{{0[{name}]}}" for name in more
    }
    for name in TARGETS:
        low, high = (f"{{0[{name}][{end}]:{sign}.3f}}" for end in ("low", "high"))
        columns[f">{name}"] = f"{{0[{name}][r2]:{sign}.3f}} [{low}, {high}]"
    return table_of(title, rows, columns)
