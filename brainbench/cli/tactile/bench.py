"""``brainbench tactile bench``: what the sensors cost on this machine."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from brainbench.cli.output import JsonOption, emit, progress_bar, table


def bench(
    hand: Annotated[str, typer.Option(help="xhand1, sharpa, or a URDF or MJCF file.")] = "xhand1",
    resolution: Annotated[str, typer.Option(help="low, med or high.")] = "med",
    placement: Annotated[str, typer.Option(help="hand, fingers, tips or palm.")] = "hand",
    envs: Annotated[int, typer.Option(help="Environments.")] = 256,
    device: Annotated[str, typer.Option(help="cpu or cuda.")] = "cpu",
    noisy: Annotated[bool, typer.Option("--noisy", help="With the published noise of each sensor.")] = False,
    repeats: Annotated[int, typer.Option(help="Timed updates; the median counts.")] = 20,
    as_json: JsonOption = False,
) -> None:
    """Time one update of each sensor class on a hand that holds a ball, with the memory per environment.

    The benchmark against peers and rooflines is benchmarks/tactile/throughput.py in the repository.
    """
    from brainbench.cli.tactile import grip_scene
    from brainbench.core.errors import UsageError

    if envs < 1 or repeats < 1:
        raise UsageError(f"--envs and --repeats are at least 1; received {envs} and {repeats}.")
    rows, results = [], []
    with progress_bar() as progress:
        grip = grip_scene.Grip(hand, envs=envs, device=device)
        grip.run(60)
        names = list(grip_scene.CLASSES)
        for index, name in enumerate(names):
            progress(index, len(names), "timing sensors")
            result: dict[str, Any] = grip_scene.time_class(
                grip, name, resolution, placement, noisy=noisy, repeats=repeats
            )
            results.append(result)
            rows.append(
                [name, str(result["probes"]), f"{1e3 * result['seconds']:.3f}", f"{result['per_probe_ns']:.1f}",
                 f"{envs / result['seconds']:,.0f}", f"{result['state_bytes']:,}"]
            )  # fmt: skip
        progress(len(names), len(names), "timing sensors")
    title = f"{hand}, {resolution} {placement}, {envs} environments on {device}" + (
        ", published noise" if noisy else ""
    )
    columns = ["sensor", "probes", "ms per update", "ns per probe", "readings/s", "bytes/environment"]
    text = table(title, columns, rows, right=(1, 2, 3, 4, 5))
    emit({"results": results, "envs": envs, "device": device}, text, as_json=as_json)
