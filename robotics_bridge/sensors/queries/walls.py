"""Meshes as solids: what is wrong with them is mended or said, and how thick their walls are is measured. Metres."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from brainbench.core.devices import warp
from brainbench.core.errors import UsageError
from brainbench.geometry import Mesh
from brainbench.geometry.distance import sample_surface
from brainbench.geometry.mesh_repair import repair
from robotics_bridge.sensors.kernels.distance import measure_walls
from robotics_bridge.sensors.probes.placement import face_areas
from robotics_bridge.sensors.queries.distance_fields import mesh_tree

RESOLVED = 4.0
"""Cells across a wall from which a distance field tells its two sides apart."""
_FLAT = 1e-6
"""Mean thickness, as a part of the diagonal, below which a mesh encloses nothing."""
_SAMPLES = 2000
_SHARE = 0.02
"""Part of the surface that must lie over thin walls for the mesh to be thin: an edge alone is none."""


def as_solid(mesh: Mesh) -> Mesh:
    """Return a mesh with its faults mended, as far as that can be; what was done and what is left is warned of."""
    spread = np.linalg.svd(mesh.vertices - mesh.vertices.mean(axis=0), compute_uv=False)
    # A closed surface of area A and thickness t has the volume A t / 2; an open one must at least not be flat.
    empty = 2 * abs(mesh.volume) <= _FLAT * mesh.diagonal * float(mesh.to_trimesh().area)
    if spread[2] <= _FLAT * spread[0] or (mesh.diagnosis.watertight and empty):
        raise UsageError(
            f"The mesh {mesh.name!r} has no thickness, so that no point lies inside it. Give its walls at least 0.1 mm."
        )
    mended = repair(mesh)
    words = [*mended.done, *(text for text in mended.remaining if "closed solid" in text)]
    if words:
        warnings.warn(
            f"The mesh {mesh.name!r} is not a sound solid: {'; '.join(words)}. Near a hole, what is inside is guessed.",
            RuntimeWarning,
            stacklevel=2,
        )
    return mended.mesh


def wall_thickness(mesh: Mesh, cell: float, device: Any) -> float:
    """Return the thickness (m) of walls of a closed mesh that cells of a distance field (m) cannot resolve, or 0."""
    wp, tree = warp(), mesh_tree(mesh, device)
    points, faces = sample_surface(mesh, _SAMPLES, np.random.default_rng(0))
    normal = face_areas(mesh.vertices[mesh.faces[faces]])[1]
    arrays = [wp.array(a.astype(np.float32), dtype=wp.vec3f, device=device) for a in (points, normal)]
    out = wp.zeros(len(points), dtype=float, device=device)
    inputs = [tree.id, *arrays, 1e-6 * mesh.diagonal, out]
    wp.launch(measure_walls, dim=len(points), inputs=inputs, device=device)
    thickness = out.numpy()
    thin = thickness[(thickness > 0) & (thickness < RESOLVED * cell)]
    return float(np.quantile(thin, 0.1)) if len(thin) > _SHARE * len(points) else 0.0
