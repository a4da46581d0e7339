"""Modes of solids by finite elements: quadratic tetrahedra of linear elasticity, K φ = ω² M φ (thesis 4.33).

The published method lumps the mass on linear tetrahedra, which are far too stiff in bending; quadratic ones reach
the closed forms of beams and plates to a percent with a few hundred elements.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse.linalg import eigsh

from brainbench.core.errors import UsageError, unknown_name
from brainbench.core.files import cache_dir, content_hash, to_plain
from brainbench.core.reading.sealed import read_sealed, write_sealed
from brainbench.geometry import Mesh
from robotics_bridge.sensors.audio import tetrahedra
from robotics_bridge.sensors.audio.materials import ElasticMaterial, Modes, elastic_material

_VERSION = 1
SHAPES = ("box", "sphere", "ellipsoid", "cylinder", "mesh")


@dataclass(frozen=True)
class ElasticSolid:
    """A body to be struck, in its own frame.

    Raises:
        UsageError: the shape is unknown or a size is not positive.
    """

    shape: str
    """``box``, ``sphere``, ``ellipsoid``, ``cylinder`` (along z) or ``mesh`` (any closed surface)."""
    size: tuple[float, ...] = ()
    """Half edges; radius; half axes; radius and half length [m]."""
    mesh: Mesh | None = None

    def __post_init__(self) -> None:
        needed = {"box": 3, "sphere": 1, "ellipsoid": 3, "cylinder": 2, "mesh": 0}
        if self.shape not in needed:
            raise unknown_name("solid", self.shape, SHAPES)
        sizes = self.size[: needed[self.shape]]
        if len(sizes) < needed[self.shape] or not all(0 < value < np.inf for value in sizes):
            raise UsageError(f"A {self.shape} needs {needed[self.shape]} positive sizes (m); received {self.size}.")
        if self.shape == "mesh" and self.mesh is None:
            raise UsageError("A solid of shape 'mesh' needs its mesh.")

    def tetrahedra(self, cells: int) -> Any:
        """Return the ``skfem.MeshTet`` with ``cells`` elements along its longest edge."""
        if self.shape == "box":
            return tetrahedra.box((self.size[0], self.size[1], self.size[2]), cells)
        if self.shape == "sphere":
            return tetrahedra.ball((self.size[0], self.size[0], self.size[0]), cells)
        if self.shape == "ellipsoid":
            return tetrahedra.ball((self.size[0], self.size[1], self.size[2]), cells)
        if self.shape == "cylinder":
            return tetrahedra.cylinder(self.size[0], self.size[1], cells)
        return tetrahedra.voxels(cast("Mesh", self.mesh), cells)


def find_modes(
    solid: ElasticSolid,
    material: str | ElasticMaterial,
    *,
    count: int = 16,
    cells: int = 12,
    strike: ArrayLike | None = None,
    hear: ArrayLike | None = None,
    cache: bool = True,
) -> Modes:
    """Return the lowest elastic modes of a free solid.

    Args:
        solid: Its shape.
        material: What it is made of; decays follow from its Rayleigh damping.
        count: Number of modes.
        cells: Elements along the longest edge.
        strike: Point [3] (m) that is struck; None takes the root mean square over the surface.
        hear: Point [3] (m) whose normal velocity is heard; None as above.
        cache: Whether the result is kept in the cache folder.

    Raises:
        UsageError: the mesh is too coarse for so many modes.
    """
    chosen = elastic_material(material)
    shape = (solid.shape, list(solid.size), None if solid.mesh is None else solid.mesh.content_hash)
    points = [None if point is None else np.asarray(point, float).tolist() for point in (strike, hear)]
    path = cache_dir("modes") / f"{content_hash(_VERSION, shape, to_plain(chosen), count, cells, points)}.npz"
    if cache and (kept := read_sealed(path, "modes of a solid")) is not None:
        return Modes(*(tuple(kept[name].tolist()) for name in ("frequency", "decay", "gain")))
    frequency, normal, place = solve(solid.tetrahedra(cells), chosen, count)
    weights = []
    for point in (strike, hear):
        if point is None:
            weights.append(np.sqrt(np.mean(normal**2, axis=0)))
        else:
            weights.append(normal[np.argmin(np.linalg.norm(place - np.asarray(point, float), axis=1))])
    decay = tuple(chosen.decay(f) for f in frequency)
    modes = Modes(tuple(frequency.tolist()), decay, tuple((weights[0] * weights[1]).tolist()))
    if cache:
        write_sealed(path, "modes of a solid", vars(modes))
    return modes


def solve(
    mesh: Any, material: ElasticMaterial, count: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return frequencies [M] (Hz), normal components [V, M] (1/√kg) of mass-normalised modes, and points [V, 3].

    V are the corners on the surface.

    Raises:
        UsageError: the mesh is too coarse for so many modes.
    """
    fem = tetrahedra.skfem()
    helpers, elasticity = import_module("skfem.helpers"), import_module("skfem.models.elasticity")
    # K φ = ω² M φ (4.33) with a consistent mass and quadratic elements.
    basis = fem.Basis(mesh, fem.ElementVector(fem.ElementTetP2()), intorder=4)
    if 3 * (count + 6) > basis.N:
        raise UsageError(f"{count} modes need a finer mesh than {mesh.t.shape[1]} tetrahedra; raise cells.")
    stiffness = elasticity.linear_elasticity(*elasticity.lame_parameters(1.0, material.poisson_ratio)).assemble(basis)
    mass = fem.BilinearForm(lambda u, v, w: helpers.dot(u, v)).assemble(basis)
    # E = 1 and density 1 keep the numbers near one; the shift makes the free body's stiffness definite.
    size = float(np.ptp(mesh.p, axis=1).max())
    values, vectors = eigsh(stiffness, count + 6, mass, sigma=-1e-3 / size**2, which="LM", v0=np.ones(basis.N))
    # The six lowest are the rigid motions of a free body. Frequencies scale with √(E/ρ) and mass-normalised shapes with
    # 1/√ρ, so the eigenproblem is solved for unit constants.
    order = np.argsort(values)[6:]
    speed = material.young_modulus / material.density
    frequency = np.sqrt(values[order] * speed) / (2 * np.pi)
    shapes = vectors[:, order] / np.sqrt(material.density)
    corners = np.unique(mesh.facets[:, mesh.boundary_facets()])
    dofs = basis.nodal_dofs[:, corners]
    outward = _corner_normals(mesh)[corners]
    return frequency, np.einsum("vi,ivm->vm", outward, shapes[dofs]), mesh.p[:, corners].T


def _corner_normals(mesh: Any) -> NDArray[np.float64]:
    """Return area-weighted outward normals [points, 3] of corners on the surface; zero inside."""
    facets = mesh.boundary_facets()
    corners = mesh.facets[:, facets]
    a, b, c = (mesh.p[:, corners[i]].T for i in range(3))
    cross = np.cross(b - a, c - a)
    owner = mesh.f2t[0, facets]
    inward = mesh.p[:, mesh.t[:, owner]].mean(axis=1).T - a
    # Facets are listed with either orientation; the tetrahedron behind a facet tells which way is out.
    cross *= -np.sign(np.einsum("ni,ni->n", cross, inward))[:, None]
    normal = np.zeros((mesh.p.shape[1], 3))
    for corner in corners:
        np.add.at(normal, corner, cross)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    return np.divide(normal, length, out=np.zeros_like(normal), where=length > 0)
