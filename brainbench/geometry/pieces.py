"""Convex pieces that stand for a mesh; :mod:`brainbench.geometry.decomposition`, an optional folder, cuts them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal

from brainbench.core.errors import UsageError
from brainbench.core.limits import Count, Limit, Positive, Seed, limited
from brainbench.core.plugins import require_optional
from brainbench.geometry.mesh import Deviation, Mesh


@limited
class DecompositionSettings:
    """Method and limits by which a mesh is cut; a value outside its range is a :class:`UsageError`."""

    method: Literal["coacd", "vhacd"] = "coacd"
    """Method of a decomposition: ``coacd`` (Wei et al. 2022) or ``vhacd`` (Mamou 2016, as PyBullet carries it; what
    the thesis used)."""
    threshold: Annotated[float, Limit(least=0.01, most=1)] = 0.05
    """Concavity that a decomposition may leave, relative to the size of the mesh: .01 is fine; CoACD only."""
    most_pieces: Count | None = None
    """Largest number of pieces; None for as many as the threshold asks for; CoACD only."""
    seed: Seed = 0
    """Seed of CoACD's search."""
    most_faces: Annotated[int, Limit(least=500)] = 50_000
    """A mesh of more triangles is first simplified, to a fifth of this many; the deviation of the pieces is still
    measured against the original."""
    seconds: Positive = 120.0
    """Limit of wall time; the work is stopped beyond it. Does not change a result."""
    memory: Positive = 4e9
    """Limit of memory [bytes]; the work is stopped beyond it. Does not change a result."""

    def __post_init__(self) -> None:
        if self.most_pieces is not None and self.method == "vhacd":
            raise UsageError("V-HACD in PyBullet has no limit on the number of pieces; use method = 'coacd' for one.")

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
    """Cut a mesh into convex pieces; holes of the surface are closed by CoACD's remeshing."""
    cut = require_optional("brainbench.geometry", "decomposition", "collision")
    return cut(mesh, settings or DecompositionSettings())
