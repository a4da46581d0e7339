"""Procedural shapes with class labels and seeds: objects for training and tests that need no download.

>>> shape = make("torus", seed=3)
>>> shape.label, round(shape.mesh.diagonal, 6), shape.mesh.diagnosis.watertight
('torus', 1.0, True)
"""

from __future__ import annotations

import functools
import math
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import FunctionType
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import check_name, check_number
from brainbench.geometry import Mesh, convex_hull
from brainbench.stimuli.objects.procedural import builders
from brainbench.stimuli.objects.procedural.bodies import Body, ShapeSampler

if TYPE_CHECKING:
    from manifold3d import Manifold

DETAIL = (2_000, 20_000)
"""Fewest and most triangles of a shape."""

_FAMILIES: dict[str, Callable[[ShapeSampler, int], Body]] = {
    name: value
    for name, value in vars(builders).items()
    if isinstance(value, FunctionType) and value.__module__ == builders.__name__ and not name.startswith("_")
}
"""Builders by name: every public function of :mod:`.builders` is a family."""


@dataclass(frozen=True, eq=False)
class Shape:
    """One member of a family: closed, outward, centred on its bounding box, of diagonal 1."""

    mesh: Mesh
    label: str
    """Class label: the name of the family."""
    parameters: Mapping[str, float | int | str]
    """The proportions that were drawn, in the family's own unit."""
    seed: int
    part_points: tuple[NDArray[np.float64], ...] = ()
    """Points [n, 3] of convex bodies that together fill the shape; empty where none are known."""

    @functools.cached_property
    def parts(self) -> tuple[Mesh, ...]:
        """The convex bodies as meshes; empty where none are known (then use ``geometry.decompose``)."""
        return tuple(convex_hull(points, self.label) for points in self.part_points)


def list_families() -> tuple[str, ...]:
    """Names that :func:`make` knows, in alphabetical order."""
    return tuple(sorted(_FAMILIES))


def describe_family(family: str) -> str:
    """Return one sentence about a family; an unknown one is a :class:`UsageError`."""
    return (_family(family).__doc__ or "").strip().partition("\n")[0]


def make(family: str, seed: int = 0, *, detail: int = 4_000) -> Shape:
    """Make one member of a family.

    The same family, seed and detail give the same shape in every process; the seed alone chooses the
    proportions, so shapes of different detail (about so many triangles, within :data:`DETAIL`) approximate the same
    solid.
    """
    build = _family(family)
    check_number("The seed of a shape", seed, least=0, whole=True)
    check_number("The detail of a shape (triangles)", detail, least=DETAIL[0], most=DETAIL[1])
    return _make(family, build, seed, int(detail))


@functools.lru_cache(maxsize=64)
def _make(family: str, build: Callable[[ShapeSampler, int], Body], seed: int, detail: int) -> Shape:
    draw = ShapeSampler(np.random.default_rng([zlib.crc32(family.encode()), seed]))
    body = build(draw, detail)
    # Booleans leave slivers where faces nearly meet; collapsing what is below a millionth of the size removes them
    # (as one original, or slivers between two operands would be kept as their seam).
    low, high = np.split(np.array(body.solid.bounding_box()), 2)
    clean = body.solid.as_original().simplify(1e-6 * float(np.linalg.norm(high - low)))
    data = _refined(clean, detail).to_mesh64()
    points = np.array(data.vert_properties[:, :3], dtype=float)
    low, high = points.min(axis=0), points.max(axis=0)
    size, centre = float(np.linalg.norm(high - low)), (low + high) / 2

    def _unit(vertices: np.ndarray) -> np.ndarray:
        # Rounded, so that the last digit of a sine on another processor does not change the hash.
        return np.round((vertices - centre) / size, 9) + 0.0

    mesh = Mesh(_unit(points), np.array(data.tri_verts, dtype=np.int64), family)
    return Shape(mesh, family, dict(draw.drawn), seed, tuple(_unit(part) for part in body.parts or ()))


def _refined(solid: Manifold, detail: int) -> Manifold:
    """Split long edges, which moves no surface, as little as gives about ``detail`` triangles."""
    wanted = max(DETAIL[0], 0.95 * detail)
    if solid.num_tri() >= wanted:
        return solid
    best, coarse, fine = solid, 40.0, 0.05
    typical = math.sqrt(solid.surface_area() / detail)
    for _ in range(16):
        factor = math.sqrt(coarse * fine)
        finer = solid.refine_to_length(factor * typical)
        count = finer.num_tri()
        if count > DETAIL[1]:
            fine = factor
        elif count < wanted:
            coarse = factor
            best = max(best, finer, key=lambda solid: solid.num_tri()) if best.num_tri() < wanted else best
        else:
            fine = factor
            best = finer if best.num_tri() < wanted else min(best, finer, key=lambda solid: solid.num_tri())
    return best


def _family(name: str) -> Callable[[ShapeSampler, int], Body]:
    check_name("shape family", name, list_families())
    return _FAMILIES[name]
