import numpy as np

from brainbench.stimuli.objects import procedural


def _genus(mesh):
    """Of one closed surface, by Euler's formula V − E + F = 2 − 2g."""
    used = len(np.unique(mesh.faces))
    return (2 - (used - len(mesh.faces) * 3 // 2 + len(mesh.faces))) // 2


def test_the_holes_of_a_perforated_box_are_as_many_as_drawn():
    for seed in range(4):
        shape = procedural.make("perforated", seed, detail=2000)
        assert _genus(shape.mesh) == shape.parameters["holes"]
