"""Different objects in different environments: variants of a MuJoCo model that differ in numbers only."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from brainbench.core.devices import mujoco_module
from brainbench.core.errors import UsageError, unknown_name
from robotics_bridge.physics.scene import Geometry

mujoco = mujoco_module()


def compile_variants(spec: Any, geometry: str, shapes: Sequence[Geometry], *, density: float = 1000.0) -> list[Any]:
    """Compile one model per shape of a geometry, ready for an engine.

    Every model holds the meshes of all shapes, so that they differ in numbers only. The link's mass and inertia
    follow from the density.

    Args:
        spec: a ``mujoco.MjSpec`` that has the geometry; it is not changed.
        geometry: name of the geometry that is replaced.
        shapes: what to put there; name, link and pose are those of the spec. MuJoCo Warp needs equal kinds, C MuJoCo
            takes any.
        density: kg/m³.

    Raises:
        UsageError: the spec has no such geometry, or a kind cannot be an object.
    """
    kinds = {"sphere": 2, "capsule": 3, "ellipsoid": 4, "cylinder": 5, "box": 6, "mesh": 7}
    models = []
    for shape in shapes:
        if shape.kind not in kinds:
            raise UsageError(f"A {shape.kind} cannot be a variant of an object; use one of {', '.join(kinds)}.")
        copy = spec.copy()
        for index, other in enumerate(shapes):
            if other.mesh is not None:
                copy.add_mesh(
                    name=f"variant{index}",
                    uservert=other.mesh.vertices.ravel().tolist(),
                    userface=other.mesh.faces.ravel().tolist(),
                )
        target = next((g for g in copy.geoms if g.name == geometry), None)
        if target is None:
            raise unknown_name("geometry", geometry, [g.name for g in copy.geoms if g.name])
        target.type = mujoco.mjtGeom(kinds[shape.kind])
        target.size = [*shape.size, 0.0, 0.0, 0.0][:3]
        target.density = density
        if shape.mesh is not None:
            target.meshname = f"variant{list(shapes).index(shape)}"
        models.append(copy.compile())
    return models
