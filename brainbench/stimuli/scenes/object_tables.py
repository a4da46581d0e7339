"""Objects of a scene file: the keys of ``[[scene.object]]``, documented with the scene file itself."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

from brainbench.core.errors import unknown_name
from brainbench.geometry import DecompositionSettings
from brainbench.stimuli.objects import procedural
from brainbench.stimuli.objects.mesh_solids import mesh_solid, shape_solid
from brainbench.stimuli.objects.placed_object import PlacedObject
from brainbench.stimuli.objects.primitives import box, capsule, cylinder, rodgers_solid, sphere
from brainbench.stimuli.objects.solid import Solid
from brainbench.stimuli.scenes.motion_tables import read_object_motion
from brainbench.stimuli.scenes.toml_tables import MILLI, TomlTable, length, number, text, vector, whole

_FAMILY = "family:"


def read_object(table: TomlTable, folder: Path) -> PlacedObject:
    """Return the object that a table describes; paths are relative to ``folder``.

    Raises:
        UsageError: a key is unknown, missing or of the wrong kind, or the shape is unknown.
        DataError: a mesh file is missing or unreadable.
    """
    shape = table.take("shape", text)
    if shape not in _SHAPES and not shape.startswith(_FAMILY):
        raise unknown_name("shape", shape, [*_SHAPES, f"{_FAMILY}NAME"])
    placed = PlacedObject(
        solid=_family(table, shape.removeprefix(_FAMILY)) if shape not in _SHAPES else _SHAPES[shape](table, folder),
        position=table.take("position_mm", vector(MILLI), (0.0, 0.0, 0.0)),
        rotation=table.take("rotation_deg", vector(math.pi / 180), (0.0, 0.0, 0.0)),
        motion=read_object_motion(table),
        friction=table.take("friction", number(1.0), None),
    )
    table.finish()
    return placed


def _mesh(table: TomlTable, folder: Path) -> Solid:
    path = folder / table.take("path", text)
    return mesh_solid(
        path,
        unit=table.take("unit", text),
        diagonal=table.take("diagonal_mm", length, None),
        collision=table.take("collision", text, "hull"),
        decomposition=_decomposition(table),
    )


def _family(table: TomlTable, name: str) -> Solid:
    shape = procedural.make(name, table.take("seed", whole, 0), detail=table.take("detail", whole, 4_000))
    return shape_solid(
        shape,
        diagonal=table.take("diagonal_mm", length, 0.04),
        collision=table.take("collision", text, None),
        decomposition=_decomposition(table),
    )


def _decomposition(table: TomlTable) -> DecompositionSettings:
    usual = DecompositionSettings()
    return DecompositionSettings(
        method=table.take("method", text, usual.method),  # type: ignore[arg-type]
        threshold=table.take("threshold", number(1.0), usual.threshold),
        most_pieces=table.take("most_pieces", whole, usual.most_pieces),
    )


def _rodgers(table: TomlTable, folder: Path) -> Solid:
    diagonal = table.take("diagonal_mm", length, 0.055)
    return rodgers_solid(diagonal, segments=table.take("segments", whole, 24))


_SHAPES: dict[str, Callable[[TomlTable, Path], Solid]] = {
    "sphere": lambda table, folder: sphere(table.take("radius_mm", length)),
    "box": lambda table, folder: box(table.take("size_mm", vector(MILLI))),
    "cylinder": lambda table, folder: cylinder(table.take("radius_mm", length), table.take("height_mm", length)),
    "capsule": lambda table, folder: capsule(table.take("radius_mm", length), table.take("length_mm", length)),
    "rodgers": _rodgers,
    "mesh": _mesh,
}
