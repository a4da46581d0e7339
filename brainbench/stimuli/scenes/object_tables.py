"""Objects of a scene file: the keys of ``[[scene.object]]``, documented with the scene file itself."""

from __future__ import annotations

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
from brainbench.stimuli.scenes.toml_tables import DEGREE, MILLI, Keys, TomlTable, number, text, vector, whole

_LENGTH = number(MILLI)
_PRIMITIVES: dict[str, tuple[Callable[..., Solid], Keys]] = {
    "sphere": (sphere, {"radius": ("radius_mm", _LENGTH)}),
    "box": (box, {"size": ("size_mm", vector(MILLI))}),
    "cylinder": (cylinder, {"radius": ("radius_mm", _LENGTH), "height": ("height_mm", _LENGTH)}),
    "capsule": (capsule, {"radius": ("radius_mm", _LENGTH), "length": ("length_mm", _LENGTH)}),
    "rodgers": (rodgers_solid, {"diagonal": ("diagonal_mm", _LENGTH), "segments": ("segments", whole)}),
}
_MESH, _FAMILY = "mesh", "family:"
_COLLISION: Keys = {"diagonal": ("diagonal_mm", _LENGTH), "collision": ("collision", text)}
_DECOMPOSITION: Keys = {
    "method": ("method", text),
    "threshold": ("threshold", number()),
    "most_pieces": ("most_pieces", whole),
}
PLACE: Keys = {"position": ("position_mm", vector(MILLI)), "rotation": ("rotation_deg", vector(DEGREE))}
"""Pose in the world, of objects and heads."""


def read_object(table: TomlTable, folder: Path) -> PlacedObject:
    """Return the object that a table describes; paths are relative to ``folder``."""
    made = {"solid": _solid(table, folder), "motion": read_object_motion(table)}
    placed = table.build(PlacedObject, {**PLACE, "friction": ("friction", number())}, **made)
    table.finish()
    return placed


def _solid(table: TomlTable, folder: Path) -> Solid:
    shape = table.take("shape", text)
    if shape in _PRIMITIVES:
        return table.build(*_PRIMITIVES[shape])
    if shape == _MESH:
        file: Keys = {"path": ("path", lambda name: folder / text(name)), "unit": ("unit", text)}
        cut = table.build(DecompositionSettings, _DECOMPOSITION)
        return table.build(mesh_solid, {**file, **_COLLISION}, decomposition=cut)
    if shape.startswith(_FAMILY):
        drawn: Keys = {"seed": ("seed", whole), "detail": ("detail", whole)}
        member = table.build(procedural.make, drawn, family=shape.removeprefix(_FAMILY))
        cut = table.build(DecompositionSettings, _DECOMPOSITION)
        return table.build(shape_solid, _COLLISION, shape=member, decomposition=cut)
    raise unknown_name("shape", shape, [*_PRIMITIVES, _MESH, f"{_FAMILY}NAME"])
