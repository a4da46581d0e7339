"""Objects that whiskers touch, from shape to obstacle.

``primitives``, ``mesh_solids``, ``procedural`` families and ``shapenet`` make a :class:`Solid`; a
:class:`PlacedObject` puts it into a scene with a pose and a motion; engines see its ``obstacle``. ``collections``
names many objects that are built when they are needed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from brainbench.core.lazy import lazy_exports

if TYPE_CHECKING:
    from brainbench.stimuli.objects.collections import resolve_objects
    from brainbench.stimuli.objects.mesh_solids import mesh_solid, shape_solid
    from brainbench.stimuli.objects.obstacle import Obstacle
    from brainbench.stimuli.objects.placed_object import PlacedObject
    from brainbench.stimuli.objects.primitives import box, capsule, cylinder, rodgers_solid, sphere
    from brainbench.stimuli.objects.shapenet import load_shapenet
    from brainbench.stimuli.objects.solid import Solid

__all__ = [
    "Obstacle",
    "PlacedObject",
    "Solid",
    "box",
    "capsule",
    "cylinder",
    "load_shapenet",
    "mesh_solid",
    "resolve_objects",
    "rodgers_solid",
    "shape_solid",
    "sphere",
]

_MODULES = {
    ".collections": ("resolve_objects",),
    ".mesh_solids": ("mesh_solid", "shape_solid"),
    ".obstacle": ("Obstacle",),
    ".placed_object": ("PlacedObject",),
    ".primitives": ("box", "capsule", "cylinder", "rodgers_solid", "sphere"),
    ".shapenet": ("load_shapenet",),
    ".solid": ("Solid",),
}
__getattr__, __dir__ = lazy_exports(__name__, {name: module for module, names in _MODULES.items() for name in names})
