"""``brainbench policy probe``: what can be read from the features of tactile encoders, before anything is trained."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from brainbench.cli.destinations import out_file_option
from brainbench.cli.options import with_options
from brainbench.cli.output import JsonOption, emit, progress_bar, table_of
from brainbench.cli.policy.options import (
    ChangeOption,
    ConfigOption,
    DeviceOption,
    EnvsOption,
    HandOption,
    TaskArgument,
    TaskFileOption,
    agent_of,
    check_names,
    make_env,
)


@with_options("robotics_bridge.policies.readouts.probe:ProbeOptions", ("seconds", "reservoirs", "untrained", "seed"))
def probe(
    task: TaskArgument,
    options: Any,
    agent: Annotated[str, typer.Option(help="Policy that acts: a shipped teacher, or a run's folder.")],
    arm: Annotated[list[str] | None, typer.Option(help="Only this arm; once for each.")] = None,
    envs: EnvsOption = 48,
    hand: HandOption = "xhand1",
    config: ConfigOption = "default",
    change: ChangeOption = None,
    task_file: TaskFileOption = None,
    device: DeviceOption = "cpu",
    out: Annotated[Path | None, out_file_option("Write the result as JSON here too.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Read object position, velocity, spin and contact linearly from what encoders make of one rollout's touch.

    Prints R² on environments left out, with 95 % intervals over environments and draws, and the differences of trained
    networks from random ones. It says what an encoder lets a policy know, and takes a minute or two.
    """
    from dataclasses import replace

    from brainbench.core.files import write_json
    from robotics_bridge.policies.readouts.probe import differences, plain
    from robotics_bridge.policies.readouts.probe import probe as run
    from robotics_bridge.policies.readouts.rollout import TARGETS
    from robotics_bridge.tasks.contact_model import contacts_name

    options = replace(options, arms=tuple(arm or ()))
    check_names(task, [agent], task_file)
    env = make_env(
        task, config=config, change=change, task_file=task_file, agents=[agent], num_envs=envs, hand=hand,
        device=device, observe="force_torque", seed=options.seed,
    )  # fmt: skip
    with progress_bar() as progress:
        found = run(env, agent_of(agent, env), options, progress)
    told: dict[str, Any] = {"task": task, "config": config, "change": change or [], "agent": agent}
    told |= {"contacts": contacts_name(env.task.contacts)}
    told |= {"environments": envs, "seconds": options.seconds}
    told |= {"arms": [plain(item) for item in found], "differences": differences(found)}
    if out is not None:
        write_json(out, told)
    columns: dict[str, Any] = {"arm": "{0[arm]}", ">features": "{0[features]}", ">draws": "{0[draws]}"}
    columns |= {
        f">{name}": f"{{0[{name}][r2]:.3f}} [{{0[{name}][low]:.3f}}, {{0[{name}][high]:.3f}}]" for name in TARGETS
    }
    text = table_of("R² on environments left out, by object quantity", told["arms"], columns)
    if told["differences"]:
        columns = {"arm": "{0[arm]}", "less": "{0[less]}"}
        columns |= {f">{n}": f"{{0[{n}][r2]:+.3f}} [{{0[{n}][low]:+.3f}}, {{0[{n}][high]:+.3f}}]" for n in TARGETS}
        text += "\n" + table_of("Differences of R²", told["differences"], columns)
    emit(told, text, as_json=as_json)
