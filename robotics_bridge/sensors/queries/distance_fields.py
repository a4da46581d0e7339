"""Sampled distance fields of meshes: built when asked for, kept in the user's cache by content. Metres."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.devices import warp
from brainbench.core.files import cache_dir
from brainbench.core.reading.ranges import check_number
from brainbench.core.reading.sealed import read_sealed, write_sealed
from brainbench.geometry import Mesh
from robotics_bridge.sensors.kernels import distance

_FORMAT = 3


@dataclass(frozen=True, eq=False)
class Field:
    """Signed distances on a regular grid around a mesh."""

    values: NDArray[np.float32]
    """[nx, ny, nz] (m), negative inside."""
    origin: NDArray[np.float32]
    """Position [3] of the first sample (m)."""
    spacing: float
    """Distance of neighbouring samples (m)."""


def sample_field(mesh: Mesh, resolution: int = 64, device: Any = "cpu") -> Field:
    """Return the distance field of a closed mesh, from the cache if it was sampled before.

    Args:
        mesh: its surface; where it has holes, inside is where its winding number exceeds one half.
        resolution: cells along the longest edge of the bounding box; the grid extends a quarter of that edge beyond the
            box on every side, further out distances are extrapolated.
    """
    check_number("The resolution of a distance field (cells)", resolution, least=4, most=512, whole=True)
    low, high = mesh.bounds
    # A margin of a quarter of the box on each side, so that most probes in reach fall within the samples.
    spacing = float((high - low).max()) / resolution
    counts = np.ceil((high - low) / spacing).astype(int) + 1 + 2 * max(4, -(-resolution // 4))
    # Samples lie symmetrically about the middle of the box, so that a symmetric mesh has a symmetric field.
    origin = (0.5 * (low + high) - 0.5 * spacing * (counts - 1)).astype(np.float32)
    path = cache_dir("fields") / f"{mesh.content_hash}-{resolution}-{_FORMAT}.npz"
    kept = read_sealed(path, "distance field")
    if kept is not None and kept["values"].shape == tuple(counts):
        return Field(kept["values"], origin, spacing)
    wp, tree = warp(), mesh_tree(mesh, device, winding=True)
    samples = wp.zeros(tuple(int(n) for n in counts), dtype=wp.float32, device=device)
    reach = 4 * float(spacing * counts.max())
    inputs = [tree.id, wp.vec3f(*origin.tolist()), spacing, reach, samples]
    wp.launch(distance.sample_field, dim=samples.shape, inputs=inputs, device=device)
    values = samples.numpy()
    write_sealed(path, "distance field", {"values": values})
    return Field(values, origin, spacing)


def mesh_tree(mesh: Mesh, device: Any, *, winding: bool = False) -> Any:
    """Return a ``warp.Mesh``: the triangles with their search tree."""
    wp = warp()
    return wp.Mesh(
        points=wp.array(mesh.vertices.astype(np.float32), dtype=wp.vec3f, device=device),
        indices=wp.array(mesh.faces.astype(np.int32).ravel(), dtype=wp.int32, device=device),
        support_winding_number=winding,
    )
