"""Rigid shapes in their own frame: what whiskers touch of them, as convex parts and as a surface. Metres."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.files import content_hash, portable
from brainbench.core.reading.ranges import check_number
from brainbench.geometry import Mesh
from brainbench.stimuli.objects.obstacle import ConvexPart, Part, bounds_of


@dataclass(frozen=True, eq=False)
class Solid:
    """A rigid shape in its own frame."""

    name: str
    parts: tuple[Part, ...]
    """Convex parts whose union is what whiskers touch [m]; empty for a concave surface that is not cut into any."""
    mesh: Mesh | None = None
    """Surface for pictures and measurements; None for primitives."""
    notes: tuple[str, ...] = ()
    """Remarks for the user, such as a concavity lost to the convex hull."""
    origin: Mapping[str, Any] | None = None
    """Source of the parts, where their last digits depend on the machine; :meth:`config` has it."""
    surface: Mesh | None = None
    """The exact surface [m], for engines that collide meshes; None where the parts are exact by themselves
    (primitives) or stand for the solid (``pieces``, ``decomposition``)."""

    @cached_property
    def bounds(self) -> NDArray[np.float64]:
        """Lowest and highest corner [2, 3] (m)."""
        return bounds_of(self.parts, self.mesh or self.surface)

    @property
    def diagonal(self) -> float:
        """Length of the bounding-box diagonal [m]."""
        return float(np.linalg.norm(self.bounds[1] - self.bounds[0]))

    def scaled(self, factor: float) -> Solid:
        """Return the solid scaled about its origin."""
        check_number("The scale of a solid", factor, above=0)
        parts = tuple(part.scaled(factor) for part in self.parts)
        surface = self.surface and self.surface.scaled(factor)
        return replace(self, parts=parts, mesh=self.mesh and self.mesh.scaled(factor), surface=surface)

    def to_diagonal(self, diagonal: float) -> Solid:
        """Return the solid scaled about its origin to a bounding-box diagonal [m]."""
        return self.scaled(diagonal / self.diagonal)

    def config(self) -> dict[str, Any]:
        """Return plain values that determine the physics; parts count by a hash of numbers or origin."""
        stated = {"name": self.name, "parts": len(self.parts), "diagonal": self.diagonal, "notes": list(self.notes)}
        return {**stated, "hash": self._hash}

    @cached_property
    def _hash(self) -> str:
        """Hash of the parts; kept, because every whisker's job asks for it and a hull has a thousand corners."""
        if self.origin is not None:
            return content_hash(self.origin, round(self.diagonal, 12))
        parts = [{"kind": type(part).__name__, **portable(part)} for part in self.parts]
        if self.surface is None or _through_corners(self.surface, self.parts):
            return content_hash(parts)
        return content_hash(parts, portable({"vertices": self.surface.vertices, "faces": self.surface.faces}))


def _through_corners(surface: Mesh, parts: tuple[Part, ...]) -> bool:
    """Return whether the surface runs through corners of the convex parts alone, so that the parts tell it."""
    corners = {tuple(corner) for part in parts if isinstance(part, ConvexPart) for corner in part.vertices.tolist()}
    return all(tuple(vertex) in corners for vertex in surface.vertices.tolist())
