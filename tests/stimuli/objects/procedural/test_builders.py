from __future__ import annotations

import numpy as np
import pytest

from brainbench.stimuli.objects import procedural


def test_an_ellipsoid_has_the_drawn_axes():
    shape = procedural.make("ellipsoid", 4)
    extent = np.ptp(shape.mesh.bounds, axis=0)
    np.testing.assert_allclose(
        extent[1:] / extent[0], [shape.parameters["y_over_x"], shape.parameters["z_over_x"]], rtol=1e-6
    )


def test_a_torus_is_a_torus():
    shape = procedural.make("torus", 4, detail=20_000)
    r = shape.parameters["tube_over_ring"]
    size = np.sqrt(2 * (2 + 2 * r) ** 2 + (2 * r) ** 2)
    assert shape.mesh.volume == pytest.approx(2 * np.pi**2 * r**2 / size**3, rel=0.02)


def _genus(mesh):
    """Of one closed surface, by Euler's formula V − E + F = 2 − 2g."""
    used = len(np.unique(mesh.faces))
    return (2 - (used - len(mesh.faces) * 3 // 2 + len(mesh.faces))) // 2


def test_the_holes_of_a_perforated_box_are_as_many_as_drawn():
    for seed in range(4):
        shape = procedural.make("perforated", seed, detail=2000)
        assert _genus(shape.mesh) == shape.parameters["holes"]
