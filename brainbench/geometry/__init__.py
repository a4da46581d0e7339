"""Triangle meshes, in metres: files with units, diagnosis, repair, distances, hulls and convex decomposition.

A mesh is loaded (``mesh``), repaired (``mesh_repair``), and cut into convex ``pieces`` by the optional folder
``decomposition``; ``distance`` measures how far the pieces are from it.
"""

from __future__ import annotations

from brainbench.geometry.mesh import (
    UNITS,
    Deviation,
    Diagnosis,
    Mesh,
    Repair,
    convex_hull,
    deviation,
    hausdorff,
    load_mesh,
    repair,
    save_mesh,
    winding_number,
)
from brainbench.geometry.pieces import Decomposition, DecompositionSettings, decompose

__all__ = [
    "UNITS",
    "Decomposition",
    "DecompositionSettings",
    "Deviation",
    "Diagnosis",
    "Mesh",
    "Repair",
    "convex_hull",
    "decompose",
    "deviation",
    "hausdorff",
    "load_mesh",
    "repair",
    "save_mesh",
    "winding_number",
]
