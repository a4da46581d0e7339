"""``brainbench tactile demo``: pictures of what a hand feels."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from brainbench.cli.output import JsonOption, emit, progress_bar, table


def demo(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the pictures.")] = Path("tactile-demo"),
    hand: Annotated[str, typer.Option(help="xhand1, sharpa, or a URDF or MJCF file.")] = "xhand1",
    resolution: Annotated[str, typer.Option(help="low, med or high.")] = "high",
    noisy: Annotated[bool, typer.Option("--noisy", help="Draw measured readings with the published noise.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Let a hand close around a warm ball and draw what it feels.

    Four pictures: forces on the taxels, marker motion of an elastomer, temperature of the finger tips, and the sound
    of a ball on wood, metal and glass.
    """
    from brainbench.cli.tactile import demo_scenes

    jobs = {
        "forces": lambda path: demo_scenes.forces(path, hand, resolution, noisy=noisy),
        "markers": lambda path: demo_scenes.markers(path, noisy=noisy),
        "temperature": lambda path: demo_scenes.temperature(path, hand),
        "sound": demo_scenes.sound,
    }
    made: dict[str, Any] = {}
    rows = []
    with progress_bar() as progress:
        for index, (name, job) in enumerate(jobs.items()):
            progress(index, len(jobs), f"drawing {name}")
            path = out / f"tactile-{name}.png"
            facts = job(path)
            made[name] = {"picture": path, **facts}
            rows.append([str(path), ", ".join(f"{key} {value:.3g}" for key, value in facts.items())])
        progress(len(jobs), len(jobs), "drawing")
    emit(made, table("", ["picture", "shows"], rows), as_json=as_json)
