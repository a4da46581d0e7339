"""Numbers of a MuJoCo model that differ between environments: domain randomisation, and variants of objects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.devices import mujoco_module
from brainbench.core.errors import UsageError, unknown_name
from brainbench.core.reading.ranges import check_number
from robotics_bridge.physics.scene import KINDS, Geometry

mujoco = mujoco_module()


def model_fields(model: Any) -> tuple[str, ...]:
    """Return the names of the numeric array fields of a ``mujoco.MjModel`` or ``MjData``."""
    names = (name for name in dir(model) if not name.startswith("_"))
    return tuple(name for name in names if isinstance(getattr(model, name, None), np.ndarray))


def check_fields(model: Any, fields: Mapping[str, ArrayLike], num_envs: int) -> dict[str, NDArray]:
    """Return the fields as arrays [B, ...] after checking names and shapes."""
    checked = {}
    for name, values in fields.items():
        own = getattr(model, name, None)
        if not isinstance(own, np.ndarray):
            raise unknown_name("model field", name, model_fields(model))
        array = np.asarray(values, dtype=own.dtype)
        if array.shape != (num_envs, *own.shape):
            needed = (num_envs, *own.shape)
            raise UsageError(f"The field {name!r} needs a value per environment, {needed}; received {array.shape}.")
        if array.dtype.kind == "f" and np.isnan(array).any():
            raise UsageError(f"The field {name!r} holds values that are no numbers (NaN).")
        checked[name] = array
    return checked


def differing_fields(models: Sequence[Any], order: Sequence[int], num_envs: int) -> dict[str, NDArray]:
    """Stack per environment e [B, ...] every field in which compiled variants ``order[e % len(order)]`` differ."""
    first = models[0]
    rows = np.array([order[env % len(order)] for env in range(num_envs)])
    found = {}
    for name in model_fields(first):
        values = [getattr(model, name) for model in models]
        if any(value.shape != values[0].shape for value in values):
            raise UsageError(
                f"Variants of a model must differ in numbers only; the shape of {name!r} differs "
                f"({', '.join(sorted({str(value.shape) for value in values}))}). Give every variant all the meshes, "
                "as compile_variants does."
            )
        if any(not np.array_equal(value, values[0], equal_nan=value.dtype.kind == "f") for value in values[1:]):
            found[name] = np.stack(values)[rows]
    return found


def compile_variants(spec: Any, geometry: str, shapes: Sequence[Geometry], *, density: float = 1000.0) -> list[Any]:
    """Compile one model per shape of a geometry, ready for an engine.

    Every model holds the meshes of all shapes, so that they differ in numbers only. The link's mass and inertia
    follow from the density.

    Args:
        spec: a ``mujoco.MjSpec``; it is not changed.
        geometry: name of what is replaced there.
        shapes: what to put there, with the link and pose of the spec. MuJoCo Warp needs equal kinds.
        density: kg/m³.
    """
    check_number("density (kg/m³)", density, above=0)
    models = []
    for number, shape in enumerate(shapes):
        if shape.kind not in KINDS[1:-1]:
            raise UsageError(f"A {shape.kind} cannot be a variant of an object; use one of {', '.join(KINDS[1:-1])}.")
        copy = spec.copy()
        for index, other in enumerate(shapes):
            if other.mesh is not None:
                vertices, faces = other.mesh.vertices.ravel().tolist(), other.mesh.faces.ravel().tolist()
                copy.add_mesh(name=f"variant{index}", uservert=vertices, userface=faces)
        target = next((g for g in copy.geoms if g.name == geometry), None)
        if target is None:
            raise unknown_name("geometry", geometry, [g.name for g in copy.geoms if g.name])
        target.type = getattr(mujoco.mjtGeom, f"mjGEOM_{shape.kind.upper()}")
        target.size = [*shape.size, 0.0, 0.0, 0.0][:3]
        # A mass or an inertia that the spec states would come before the density.
        target.density, target.mass = density, np.nan
        target.parent.explicitinertial, target.parent.ipos = False, [np.nan] * 3
        if shape.mesh is not None:
            target.meshname = f"variant{number}"
        models.append(copy.compile())
    return models
