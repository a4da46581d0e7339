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

from brainbench.core.errors import UsageError, shown
from brainbench.core.files import cache_dir, content_hash, to_plain
from brainbench.core.reading.ranges import check_number, check_numbers
from brainbench.core.reading.sealed import read_sealed, write_sealed
from robotics_bridge.physics.scene import Geometry
from robotics_bridge.sensors.audio import tetrahedra
from robotics_bridge.sensors.audio.materials import ElasticMaterial, Modes, elastic_material

_VERSION = 1


def find_modes(
    solid: Geometry,
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
        solid: A box, sphere, ellipsoid, cylinder or closed mesh; link and pose do not matter.
        material: What it is made of; decays follow from its Rayleigh damping.
        cells: Elements along the longest edge.
        strike: Point [3] (m, frame of the solid) that is struck; the nearest of the surface counts. None takes the root
            mean square over the surface.
        hear: Point [3] (m, frame of the solid) whose normal velocity is heard; otherwise as ``strike``.
        cache: Whether the result is kept in the cache folder.
    """
    for name, value in {"count": count, "cells": cells}.items():
        check_number(name, value, least=1, whole=True)
    chosen = elastic_material(material)
    for name, point in {"strike": strike, "hear": hear}.items():
        if point is not None:
            check_numbers(f"{name} (m)", point, 3)
    shape = (solid.kind, list(solid.size), None if solid.mesh is None else solid.mesh.content_hash)
    points = [None if point is None else np.asarray(point, float).tolist() for point in (strike, hear)]
    path = cache_dir("modes") / f"{content_hash(_VERSION, shape, to_plain(chosen), count, cells, points)}.npz"
    if cache and (kept := read_sealed(path, "modes of a solid")) is not None:
        return Modes(*(tuple(kept[name].tolist()) for name in ("frequency", "decay", "gain")))
    frequency, normal, place = solve(tetrahedra.fill(solid, cells), chosen, count)
    weights = []
    for point in (strike, hear):
        if point is None:
            weights.append(np.sqrt(np.mean(normal**2, axis=0)))
            continue
        away = np.linalg.norm(place - np.asarray(point, float), axis=1)
        if away.min() > (most := float(np.ptp(place, axis=0).max()) / 2):
            raise UsageError(
                f"The point {shown(point)} lies {away.min():g} m off the surface of {solid.name!r}, which is "
                f"{2 * most:g} m long; points are in metres, in the frame of the solid."
            )
        weights.append(normal[np.argmin(away)])
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
