"""Convex decomposition of meshes, in a process of its own with limits, cached, with its deviation measured."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import numpy as np

from brainbench.core.errors import DataError, UsageError, check_name, missing_dependency
from brainbench.core.files import cache_dir, content_hash
from brainbench.core.reading.ranges import check_fields
from brainbench.core.reading.sealed import read_sealed, write_sealed
from brainbench.geometry.distance import Deviation, deviation, hausdorff
from brainbench.geometry.mesh import Mesh, convex_hull

_LOG = logging.getLogger(__name__)

METHODS = {
    "coacd": ("coacd", "coacd", "mesh", "Convex decomposition by CoACD"),
    "vhacd": ("pybullet", "pybullet", "bullet", "Convex decomposition by V-HACD"),
}
"""Method → module, distribution and extra that it needs, and what it is for."""

_OUT_OF_MEMORY = ("bad_alloc", "MemoryError", "Unable to allocate", "allocate memory", "Thread creation failed")

REDUCTION = 5
"""A mesh of too many triangles is simplified to the limit over this: CoACD's time grows with their number."""

_VERSION = 1
"""Raised when results of this module change, so that cached ones are made again."""


@dataclass(frozen=True)
class DecompositionSettings:
    """Method and limits by which a mesh is cut; a value outside its range is a :class:`UsageError`."""

    method: Literal["coacd", "vhacd"] = "coacd"
    """``coacd`` (Wei et al. 2022) or ``vhacd`` (Mamou 2016, as PyBullet carries it; what the thesis used)."""
    threshold: float = 0.05
    """Concavity that may remain, relative to the size of the mesh, 0.01 (fine) … 1; CoACD only."""
    most_pieces: int | None = None
    """Largest number of pieces; None for as many as the threshold asks for; CoACD only."""
    seed: int = 0
    """Seed of CoACD's search."""
    most_faces: int = 50_000
    """A mesh of more triangles is first simplified, to a fifth of this many; the deviation of the pieces is still
    measured against the original."""
    seconds: float = 120.0
    """Limit of wall time; the work is stopped beyond it. Does not change a result."""
    memory: float = 4e9
    """Limit of memory [bytes]; the work is stopped beyond it. Does not change a result."""

    def __post_init__(self) -> None:
        check_name("decomposition method", self.method, METHODS)
        check_fields(self, "threshold", least=0.01, most=1)
        check_fields(self, "most_pieces", least=1, whole=True)
        if self.most_pieces is not None and self.method == "vhacd":
            raise UsageError("V-HACD in PyBullet has no limit on the number of pieces; use method = 'coacd' for one.")
        check_fields(self, "seed", least=0, whole=True)
        check_fields(self, "most_faces", least=500, whole=True)
        check_fields(self, "seconds", "memory", above=0)

    def config(self) -> dict[str, Any]:
        """Return the plain values that determine the pieces."""
        if self.method == "vhacd":
            return {"method": self.method, "most_faces": self.most_faces}
        names = ("method", "threshold", "most_pieces", "seed", "most_faces")
        return {name: getattr(self, name) for name in names}


@dataclass(frozen=True, eq=False)
class Decomposition:
    """Convex pieces that stand for a mesh."""

    pieces: tuple[Mesh, ...]
    """Convex, closed, outward."""
    deviation: Deviation
    """Deviation of the union of the pieces from the solid inside the mesh [m]."""
    notes: tuple[str, ...]
    """Sentences on what was done and how far the pieces are from the mesh; relative, so scaling keeps them true."""
    key: str = ""
    """Names what the pieces were computed from: the shape of the mesh, the settings, the versions of the packages."""
    cached: bool = False
    """True when the pieces were found in the cache."""


def decompose(mesh: Mesh, settings: DecompositionSettings | None = None) -> Decomposition:
    """Cut a mesh into convex pieces; holes of the surface are closed by CoACD's remeshing.

    The pieces are computed for the mesh at a diagonal of 1 and kept under
    ``brainbench.core.files.cache_dir("collision")`` by the hash of that mesh, the settings and the versions
    of the packages, so that one decomposition serves every size.
    """
    settings = settings or DecompositionSettings()
    diagonal, centre = mesh.diagonal, mesh.bounds.mean(axis=0)
    # Rounded, so that one shape at two sizes has one name in the cache.
    unit = Mesh(np.round((mesh.vertices - centre) / diagonal, 9), mesh.faces, mesh.name)
    key = _key(unit, settings)
    path = cache_dir("collision") / f"{key}.npz"
    found = _read(path, mesh.name)
    pieces, numbers = found or _compute(unit, settings, path)
    outward, inward, samples, decimated = (float(value) for value in numbers)
    # Convexity and relative deviation do not change with scale, so the unit pieces are only scaled back.
    placed = tuple(Mesh(piece.vertices * diagonal + centre, piece.faces, mesh.name) for piece in pieces)
    return Decomposition(
        pieces=placed,
        deviation=Deviation(outward * diagonal, inward * diagonal, int(samples)),
        notes=_notes(unit, settings, len(pieces), (outward, inward, decimated)),
        key=key,
        cached=found is not None,
    )


def _compute(unit: Mesh, settings: DecompositionSettings, path: Path) -> tuple[tuple[Mesh, ...], Any]:
    module, distribution, extra, purpose = METHODS[settings.method]
    if find_spec(module) is None:
        raise missing_dependency(distribution, extra=extra, purpose=purpose)
    reduced, decimated = _decimated(unit, settings.most_faces)
    pieces = tuple(convex_hull(points, unit.name) for points in _run(reduced, settings))
    # Measured against the whole mesh; the simplified one decides what is inside, to save time.
    found = deviation(unit, pieces, inside=reduced)
    # Relative to a diagonal of 1, so that the cached numbers serve every size.
    numbers = np.array([found.outward, found.inward, found.samples, decimated])
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
    worker = Path(__file__).with_name("decomposition_worker.py")
    with tempfile.TemporaryDirectory(prefix="brainbench-") as folder:
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
