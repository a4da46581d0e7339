"""Procedural shapes: families draw proportions from a seed and combine bodies into closed meshes with a class label.

:mod:`.bodies` has the building blocks; every public function of :mod:`.builders` is a family, and :mod:`.families`
makes a member of any of them.
"""

from brainbench.stimuli.objects.procedural.families import DETAIL, Shape, describe_family, list_families, make

__all__ = ["DETAIL", "Shape", "describe_family", "list_families", "make"]
