"""``brainbench stimuli hand``: touch of a robot hand that explores objects, as a stimulus set."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from brainbench.cli.options import needs, out_file_option, with_options
from brainbench.cli.output import Output, progress_bar, table_of
from brainbench.cli.policy.train import ENV, HandOption
from brainbench.cli.stimuli.scenes import UnitOption

if TYPE_CHECKING:
    from robotics_bridge.exploration.record import Explored

RODGERS = "rodgers"
_DISTANCES = {"close": 0.0, "medium": 4e-4, "far": 8e-4}


@needs(cache=True)
@with_options(ENV, ("placement", "resolution", "noisy", "seed"), parameter="touch", build=False)
def hand(
    touch: dict[str, Any],
    out: Annotated[Path | None, out_file_option("Stimulus-set file to write (.h5).")] = None,
    objects: Annotated[
        list[str] | None,
        typer.Option(
            help="rodgers (its convex and concave solid at three distances), primitives, a shape family (torus), a "
            "collection (procedural-24:1) or a mesh file; may be repeated."
        ),
    ] = None,
    procedure: Annotated[
        list[str] | None,
        typer.Option(help="lateral_motion, static_pressure, enclosure, contour_following; all by default."),
    ] = None,
    hand: HandOption = "xhand1",
    diagonal: Annotated[float, typer.Option(help="Size of shapes and meshes (mm).")] = 55.0,
    unit: UnitOption = None,
    frames: Annotated[int, typer.Option(help="Frames of 9 ms; a multiple of 5.")] = 110,
) -> Output:
    """Record exploratory procedures of a robot hand as a stimulus set that any model can be scored or probed on.

    Sites of the hand stand in for whiskers (5 fingers × 7 sites); forces are scaled to a whisker's.
    """
    import numpy as np

    from brainbench.core.errors import UsageError
    from brainbench.stimuli import write_stimulus_set
    from brainbench.stimuli.stimulus_set import hash_stimulus_set
    from robotics_bridge.exploration.record import PROCEDURES, record_exploration

    if frames < 5 or frames % 5:
        raise UsageError(f"--frames is a multiple of 5, the sub-steps of a time step; received {frames}.")
    explored = [item for text in objects or ["primitives"] for item in objects_of(text, diagonal * 1e-3, unit)]
    with progress_bar() as progress:
        recording = record_exploration(
            explored, tuple(procedure or PROCEDURES), hand=hand, frames=frames, progress=progress, **touch
        )
    calibration = recording.calibration()
    dataset = recording.dataset(calibration)
    dataset.attrs["content_hash"] = hash_stimulus_set(dataset)
    if out is not None:
        write_stimulus_set(dataset, out)
    force = np.linalg.norm(recording.wrench[..., :3], axis=-1)
    sites = force.shape[-1]
    data = [
        {
            "stimulus": label,
            "sites_touched": int((felt.max(axis=0) > 1e-3).sum()),
            "peak_force_N": float(felt.sum(axis=1).max()),
        }
        for label, felt in zip(recording.labels, force, strict=True)
    ]
    silent = [item["stimulus"] for item in data if not item["sites_touched"]]
    unit_of = f"one unit = {calibration.force:.3g} N, {calibration.moment:.3g} N·m"
    title = f"{recording.hand}, {touch['placement']}, {touch['resolution']}; {unit_of}"
    columns = {
        "stimulus": "{0[stimulus]}",
        ">sites touched": lambda row: f"{row['sites_touched']} of {sites}",
        ">peak force N": "{0[peak_force_N]:.3g}",
    }
    text = table_of(title, data, columns)
    if silent:
        text += f"\n\n{len(silent)} never touch a taxel: {', '.join(silent)}."
    result = {"stimuli": data, "calibration": calibration, "content_hash": dataset.attrs["content_hash"], "path": out}
    return Output(result, text + ("" if out is None else f"\n\nstimuli  {out}"))


def objects_of(text: str, diagonal: float, unit: str | None = None) -> list[Explored]:
    """Return the objects that a word names, of a given size (m).

    ``rodgers`` gives the labels of the recipe of that name, so that hand and whisker stimuli can be compared.
    """
    import math

    from brainbench.geometry import Mesh
    from brainbench.stimuli.objects.collections import resolve_objects
    from brainbench.stimuli.objects.solid import rodgers_solid
    from brainbench.stimuli.scenes.recipes import get_recipe
    from robotics_bridge.exploration.record import Explored
    from robotics_bridge.physics import Geometry

    if text == "primitives":
        sizes = {
            "sphere": (0.025,), "box": (0.02, 0.03, 0.015), "capsule": (0.012, 0.025), "cylinder": (0.02, 0.03),
            "ellipsoid": (0.02, 0.035, 0.015),
        }  # fmt: skip
        lying = {"capsule": (0.7071068, 0.7071068, 0.0, 0.0)}
        shapes = {kind: Geometry(name=kind, link=kind, kind=kind, size=size) for kind, size in sizes.items()}
        return [Explored(kind, one, quaternion=lying.get(kind, (1, 0, 0, 0))) for kind, one in shapes.items()]
    if text == RODGERS:
        shape, explored = _geometry(_surface(rodgers_solid(diagonal))), []
        for scene in get_recipe(RODGERS).scenes:
            side, _, distance = scene.label.partition("-")
            # The concave face looks towards -y, askew by 25 degrees; the side that is named faces the palm.
            half, skew = math.radians(-90.0 if side == "convex" else 90.0) / 2, math.radians(25.0) / 2
            c, s, cz, sz = math.cos(half), math.sin(half), math.cos(skew), math.sin(skew)
            turn = (c * cz, s * cz, -s * sz, c * sz)
            explored.append(Explored(scene.label, shape, quaternion=turn, retreat=_DISTANCES[distance]))
        return explored
    explored = []
    for name, solid in resolve_objects([text], unit=unit, surfaces=True).items():
        mesh = _surface(solid.load())
        # Centred, and scaled to the diagonal of its box.
        centred = Mesh(mesh.vertices - mesh.bounds.mean(axis=0), mesh.faces)
        explored.append(Explored(name, _geometry(centred.scaled(diagonal / mesh.diagonal))))
    return explored


def _geometry(mesh: Any) -> Any:
    from robotics_bridge.physics import Geometry

    return Geometry(name="object", link="object", kind="mesh", mesh=mesh)


def _surface(solid: Any) -> Any:
    """Return the mesh of a solid."""
    return solid.mesh if solid.surface is None else solid.surface
