"""Modes of solids by finite elements: quadratic tetrahedra of linear elasticity, K φ = ω² M φ (thesis 4.33).

The published method lumps the mass on linear tetrahedra, which are far too stiff in bending; quadratic ones reach
the closed forms of beams and plates to a percent with a few hundred elements.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse.linalg import eigsh
from scipy.spatial import KDTree

from brainbench.core.errors import UsageError, check_number, needing
from brainbench.core.files import cache_dir, content_hash, to_plain
from brainbench.core.reading.sealed import read_sealed, write_sealed
from brainbench.geometry import Mesh, winding_number
from robotics_bridge.physics.scene import Geometry
from robotics_bridge.sensors.audio.sensors import ElasticMaterial, Modes, elastic_material
from robotics_bridge.sensors.probes.placement import face_areas, spread_over

SMALLEST = 0.05  # a tetrahedron may shrink to this share of its volume when its corners are moved to a surface


def skfem() -> Any:
    """Return the module ``skfem``."""
    with needing("scikit-fem", extra="tactile", purpose="Modal analysis"):
        return import_module("skfem")


def fill(solid: Geometry, cells: int) -> Any:
    """Return the ``skfem.MeshTet`` of a solid with ``cells`` elements along its longest edge."""
    if solid.kind == "box":
        return box(solid.size, cells)
    if solid.kind in ("sphere", "ellipsoid"):
        return ball(np.broadcast_to(solid.size, 3), cells)
    if solid.kind == "cylinder":
        return cylinder(solid.size[0], solid.size[1], cells)
    if solid.mesh is None:
        raise UsageError(
            f"Modes are those of a box, sphere, ellipsoid, cylinder or mesh; {solid.name!r} is a {solid.kind}. Make it "
            "a mesh."
        )
    return voxels(solid.mesh, cells)


def box(half: ArrayLike, cells: int) -> Any:
    """Return a box of half edges (m) with ``cells`` along its longest edge and at least one along each."""
    size = 2 * np.asarray(half, dtype=float)
    counts = np.maximum(np.round(cells * size / size.max()), 1).astype(int)
    axes = [np.linspace(-s / 2, s / 2, n + 1) for s, n in zip(size, counts, strict=True)]
    return skfem().MeshTet.init_tensor(*axes)


def ball(half: ArrayLike, cells: int) -> Any:
    """Return an ellipsoid of half axes (m), from a cube whose shells are pushed out to spheres."""
    mesh = box((1.0, 1.0, 1.0), cells)
    return type(mesh)(_rounded(mesh.p, 0.8) * np.asarray(half)[:, None], mesh.t)


def cylinder(radius: float, half_length: float, cells: int) -> Any:
    """Return a cylinder along z."""
    mesh = box((radius, radius, half_length), cells)
    return type(mesh)(np.concatenate([_rounded(mesh.p[:2] / radius, 0.85) * radius, mesh.p[2:]]), mesh.t)


def _rounded(p: NDArray[np.float64], core: float) -> NDArray[np.float64]:
    """Push the shells of a cube [-1, 1] out to spheres; near the middle it stays a cube, shrunk by ``core``."""
    # A shell of the cube, max |x| = const, becomes a sphere. Blending by the squared distance keeps the middle a cube,
    # where tetrahedra on spheres would be flat.
    longest, far = np.abs(p).max(axis=0), np.linalg.norm(p, axis=0)
    sphere = np.where(far > 0, longest / np.maximum(far, 1e-12), 1.0)
    share = longest**2
    return p * (share * sphere + (1 - share) * core)


def voxels(surface: Mesh, cells: int) -> Any:
    """Return a closed surface filled with voxels of six tetrahedra each, whose skin is moved onto the surface."""
    vertices = np.asarray(surface.vertices, dtype=float)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    edge = float((high - low).max()) / cells
    counts = np.maximum(np.ceil((high - low) / edge - 1e-9), 1).astype(int)
    middle = (low + high) / 2
    axes = [middle[a] + edge * (np.arange(n + 1) - n / 2) for a, n in enumerate(counts)]
    grid = skfem().MeshTet.init_tensor(*axes)
    # All six tetrahedra of a voxel are kept or dropped together, by the winding number at its middle: the skin stays
    # closed.
    centers = grid.p[:, grid.t].mean(axis=1).T
    cell = np.floor((centers - [axis[0] for axis in axes]) / edge).astype(int)
    place = np.array([axis[0] for axis in axes]) + (cell + 0.5) * edge
    unique, inverse = np.unique(place.round(12), axis=0, return_inverse=True)
    inside = winding_number(surface, unique) > 0.5
    keep = inside[inverse.ravel()]
    if not keep.any():
        raise UsageError(f"No voxel lies inside the body with {cells} cells along it; use more, or a primitive shape.")
    mesh = grid.restrict(np.flatnonzero(keep))
    corners = vertices[surface.faces]
    samples = spread_over(corners, face_areas(corners)[0], 40_000, seed=0)[0]
    skin = np.unique(mesh.facets[:, mesh.boundary_facets()])
    distance, nearest = (np.asarray(item) for item in KDTree(samples).query(mesh.p[:, skin].T))
    p = mesh.p.copy()
    near = distance < 1.2 * edge
    p[:, skin[near]] = samples[nearest[near]].T
    return type(mesh)(_untangled(mesh, p), mesh.t)


def _untangled(mesh: Any, target: NDArray[np.float64]) -> NDArray[np.float64]:
    """Move back, step by step, the corners of tetrahedra that would be turned over."""
    start, moved = mesh.p, target.copy()
    rest = volumes(start, mesh.t)
    for _ in range(20):
        # Halving the way back converges to the start, where every volume is sound.
        bad = volumes(moved, mesh.t) * np.sign(rest) < SMALLEST * np.abs(rest)
        if not bad.any():
            return moved
        corners = np.unique(mesh.t[:, bad])
        moved[:, corners] = 0.5 * (moved[:, corners] + start[:, corners])
    return start


def volumes(p: NDArray[np.float64], t: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the signed volumes [n] of tetrahedra t [4, n] of points p [3, m]."""
    a, b, c, d = (p[:, t[i]] for i in range(4))
    return np.einsum("in,in->n", np.cross(b - a, c - a, axis=0), d - a) / 6


_VERSION = 1


def find_modes(
    solid: Geometry,
    material: str | ElasticMaterial,
    *,
    count: int = 16,
    cells: int = 12,
    cache: bool = True,
) -> Modes:
    """Return the lowest elastic modes of a free solid, struck and heard anywhere: by the mean square over its surface.

    Args:
        solid: A box, sphere, ellipsoid, cylinder or closed mesh; link and pose do not matter.
        material: What it is made of; decays follow from its Rayleigh damping.
        cells: Elements along the longest edge.
        cache: Whether the result is kept in the cache folder.
    """
    for name, value in {"count": count, "cells": cells}.items():
        check_number(name, value, least=1, whole=True)
    chosen = elastic_material(material)
    shape = (solid.kind, list(solid.size), None if solid.mesh is None else solid.mesh.content_hash)
    path = cache_dir("modes") / f"{content_hash(_VERSION, shape, to_plain(chosen), count, cells)}.npz"
    if cache and (cached := read_sealed(path, "modes of a solid")) is not None:
        return Modes(*(tuple(cached[name].tolist()) for name in ("frequency", "decay", "gain")))
    frequency, normal = solve(fill(solid, cells), chosen, count)
    decay = tuple(chosen.decay(f) for f in frequency)
    modes = Modes(tuple(frequency.tolist()), decay, tuple(np.mean(normal**2, axis=0).tolist()))
    if cache:
        write_sealed(path, "modes of a solid", vars(modes))
    return modes


def solve(mesh: Any, material: ElasticMaterial, count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return frequencies [M] (Hz) and normal components [V, M] (1/√kg) of mass-normalised modes.

    V are the corners on the surface.
    """
    fem = skfem()
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
    return frequency, np.einsum("vi,ivm->vm", outward, shapes[dofs])


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
