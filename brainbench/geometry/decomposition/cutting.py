"""Convex decomposition of meshes, in a process of its own with limits, cached, with its deviation measured."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from brainbench.core.errors import DataError, missing_dependency
from brainbench.core.files import cache_dir, content_hash
from brainbench.core.reading.regular import temporary_folder
from brainbench.core.reading.sealed import read_sealed, write_sealed
from brainbench.geometry.mesh import Deviation, Mesh, convex_hull, deviation, hausdorff
from brainbench.geometry.pieces import Decomposition, DecompositionSettings

_LOG = logging.getLogger(__name__)

METHODS = {
    "coacd": ("coacd", "coacd", "mesh", "Convex decomposition by CoACD"),
    "vhacd": ("pybullet", "pybullet", "bullet", "Convex decomposition by V-HACD"),
}
"""Method → module, distribution and extra that it needs, and what it is for."""

_OUT_OF_MEMORY = ("bad_alloc", "MemoryError", "Unable to allocate", "allocate memory", "Thread creation failed")

REDUCTION = 5
"""A mesh of too many triangles is simplified to the limit over this: CoACD's time grows with their number."""

_VERSION = 1  # raised when results of this module change, so that cached ones are made again


def cut(mesh: Mesh, settings: DecompositionSettings) -> Decomposition:
    """Cut a mesh into convex pieces; holes of the surface are closed by CoACD's remeshing.

    The pieces are computed for the mesh at a diagonal of 1 and kept under
    ``brainbench.core.files.cache_dir("collision")`` by the hash of that mesh, the settings and the versions
    of the packages, so that one decomposition serves every size.
    """
    diagonal, centre = mesh.diagonal, mesh.bounds.mean(axis=0)
    # Rounded, so that one shape at two sizes has one name in the cache.
    unit = Mesh(np.round((mesh.vertices - centre) / diagonal, 9), mesh.faces, mesh.name)
    key = _key(unit, settings)
    path = cache_dir("collision") / f"{key}.npz"
    stored = _read(path, mesh.name)
    pieces, numbers = stored or _compute(unit, settings, path)
    outward, inward, samples, decimated = (float(value) for value in numbers)
    # Convexity and relative deviation do not change with scale, so the unit pieces are only scaled back.
    placed = tuple(Mesh(piece.vertices * diagonal + centre, piece.faces, mesh.name) for piece in pieces)
    return Decomposition(
        pieces=placed,
        deviation=Deviation(outward * diagonal, inward * diagonal, int(samples)),
        notes=_notes(unit, settings, len(pieces), (outward, inward, decimated)),
        key=key,
        cached=stored is not None,
    )


def _compute(unit: Mesh, settings: DecompositionSettings, path: Path) -> tuple[tuple[Mesh, ...], Any]:
    module, distribution, extra, purpose = METHODS[settings.method]
    if find_spec(module) is None:
        raise missing_dependency(distribution, extra=extra, purpose=purpose)
    reduced, decimated = _decimated(unit, settings.most_faces)
    pieces = tuple(convex_hull(points, unit.name) for points in _run(reduced, settings))
    # Measured against the whole mesh; the simplified one decides what is inside, to save time.
    gap = deviation(unit, pieces, inside=reduced)
    # Relative to a diagonal of 1, so that the cached numbers serve every size.
    numbers = np.array([gap.outward, gap.inward, gap.samples, decimated])
    _write(path, pieces, numbers)
    return pieces, numbers


def _decimated(mesh: Mesh, most: int) -> tuple[Mesh, float]:
    """Return a mesh of at most ``most`` triangles and its distance from ``mesh``, NaN when nothing was done."""
    if len(mesh.faces) <= most:
        return mesh, np.nan
    if find_spec("fast_simplification") is None:
        purpose = f"Decomposing a mesh of {len(mesh.faces):,} triangles, which is first simplified,"
        raise missing_dependency("fast-simplification", extra="mesh", purpose=purpose)
    import fast_simplification

    vertices, faces = fast_simplification.simplify(
        np.array(mesh.vertices), np.array(mesh.faces, dtype=np.int32), target_count=most // REDUCTION
    )[:2]
    reduced = Mesh(np.asarray(vertices, float), np.asarray(faces), mesh.name)
    return reduced, hausdorff(mesh, reduced)


def _run(mesh: Mesh, settings: DecompositionSettings) -> list[np.ndarray]:
    worker = Path(__file__).with_name("worker.py")
    with temporary_folder() as folder:
        source, target = Path(folder, "mesh.npz"), Path(folder, "pieces.npz")
        np.savez(source, vertices=mesh.vertices, faces=mesh.faces)
        words = [settings.method, settings.threshold, settings.most_pieces or -1, settings.seed, int(settings.memory)]
        # One arena of the allocator per thread would count against the limit without being used.
        environment = {**os.environ, "MALLOC_ARENA_MAX": "2", "OMP_NUM_THREADS": str(min(8, os.cpu_count() or 1))}
        started = time.monotonic()
        try:
            done = subprocess.run(
                [sys.executable, os.fspath(worker), os.fspath(source), os.fspath(target), *map(str, words)],
                capture_output=True,
                cwd=folder,
                env=environment,
                timeout=settings.seconds,
                check=False,
            )
        except subprocess.TimeoutExpired:
            raise _failed(mesh, settings, f"took longer than {settings.seconds:g} s and was stopped") from None
        if done.returncode or not target.exists():
            errors = done.stderr.decode(errors="replace")
            last = (errors.strip().splitlines() or ["no message"])[-1]
            fault = f"by {settings.method} failed with exit status {done.returncode} ({last[:200]})"
            if any(word in errors for word in _OUT_OF_MEMORY):
                fault = f"needed more than {settings.memory / 1e9:.3g} GB of memory and was stopped"
            raise _failed(mesh, settings, fault)
        _LOG.info("%s decomposed in %.1f s", mesh.name, time.monotonic() - started)
        with np.load(target, allow_pickle=False) as stored:
            ends = np.cumsum(stored["sizes"])[:-1]
            return np.split(stored["points"], ends)


def _failed(mesh: Mesh, settings: DecompositionSettings, fault: str) -> DataError:
    return DataError(
        f"The decomposition of {mesh.name!r} ({len(mesh.faces):,} triangles) {fault}; raise the threshold "
        f"({settings.threshold:g}), lower most_faces ({settings.most_faces:,}), raise the limit, or use collision = "
        "'hull'."
    )


def _notes(
    unit: Mesh, settings: DecompositionSettings, pieces: int, numbers: tuple[float, float, float]
) -> tuple[str, ...]:
    outward, inward, decimated = numbers
    notes = []
    if np.isfinite(decimated):
        notes.append(
            f"{len(unit.faces):,} triangles were simplified to {settings.most_faces // REDUCTION:,} before the"
            f" decomposition; the surface moved by at most {decimated:.2%} of the diagonal (sampled)"
        )
    notes.append(
        f"whiskers touch {pieces} convex pieces ({settings.method}), which stand out from the mesh by at most"
        f" {outward:.2%} and fall short of it by at most {inward:.2%} of its diagonal (sampled)"
    )
    return tuple(notes)


def _key(unit: Mesh, settings: DecompositionSettings) -> str:
    versions = []
    for distribution in (METHODS[settings.method][1], "fast-simplification"):
        try:
            versions.append(metadata.version(distribution))
        except metadata.PackageNotFoundError:
            versions.append("")
    return content_hash(_VERSION, unit.content_hash, settings.config(), versions, length=24)


def _read(path: Path, name: str) -> tuple[tuple[Mesh, ...], Any] | None:
    if (stored := read_sealed(path, "decomposition")) is None:
        return None
    vertices = np.split(stored["vertices"], np.cumsum(stored["vertex_counts"])[:-1])
    faces = np.split(stored["faces"], np.cumsum(stored["face_counts"])[:-1])
    return tuple(Mesh(v, f, name) for v, f in zip(vertices, faces, strict=True)), stored["numbers"]


def _write(path: Path, pieces: Sequence[Mesh], numbers: np.ndarray) -> None:
    arrays = {
        "vertices": np.concatenate([piece.vertices for piece in pieces]),
        "vertex_counts": [len(piece.vertices) for piece in pieces],
        "faces": np.concatenate([piece.faces for piece in pieces]),
        "face_counts": [len(piece.faces) for piece in pieces],
        "numbers": numbers,
    }
    write_sealed(path, "decomposition", arrays, compress=True)
