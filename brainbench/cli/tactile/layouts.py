"""``brainbench tactile layouts``: links, probes and counts of a hand."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from brainbench.cli.output import JsonOption, emit, table


def layouts(
    hand: Annotated[str, typer.Argument(help="xhand1, sharpa, or a URDF or MJCF file.")] = "xhand1",
    probes: Annotated[Path | None, typer.Option(help="Probe file (published JSON form) to show instead.")] = None,
    links: Annotated[bool, typer.Option("--links", help="Also list every link.")] = False,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Write the layouts as probe files here.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Count the probes of a hand by resolution and placement, as table 4.11 of the thesis does."""
    from robotics_bridge import hands

    chosen = hands.load(hand)
    resolutions: tuple[str, ...] = hands.RESOLUTIONS
    if probes is not None:
        chosen, resolutions = chosen.with_probes(probes), ("custom",)
    counts, rows, detail = {}, [], []
    for resolution in resolutions:
        layout = {place: chosen.layout(resolution, place) for place in hands.PLACEMENTS}
        counts[resolution] = {place: hands.active_count(layout[place]) for place in hands.PLACEMENTS}
        rows.append([resolution, *(str(counts[resolution][place]) for place in hands.PLACEMENTS)])
        for link, item in layout["hand"].items():
            shape = " × ".join(map(str, item.shape))
            radius = sorted({f"{1e3 * value:g}" for value in item.radius[item.active]})
            detail.append([resolution, link, shape, str(int(item.active.sum())), ", ".join(radius)])
        if out is not None:
            hands.write_probes(out / f"{chosen.name}_{resolution}.json", layout["hand"])
    text = table(f"{chosen.name}: {len(chosen.joints)} joints, {len(chosen.fingers)} fingers, palm {chosen.palm}",
                 ["resolution", *hands.PLACEMENTS], rows, right=(1, 2, 3, 4))  # fmt: skip
    if links:
        text += "\n\n" + table("", ["resolution", "link", "grid", "active", "radius (mm)"], detail, right=(3,))
    data = {
        "hand": chosen.name,
        "palm": chosen.palm,
        "joints": chosen.joints,
        "fingers": chosen.fingers,
        "counts": counts,
    }
    emit(data, text, as_json=as_json)
