from dataclasses import replace

import numpy as np
import pytest

from brainbench.geometry import Mesh
from brainbench.stimuli.objects.primitives import box, capsule, cylinder, rodgers_solid, sphere

SOLIDS = [sphere(2e-3), box((1e-3, 2e-3, 3e-3)), cylinder(1e-3, 5e-3), capsule(1e-3, 4e-3), rodgers_solid(segments=4)]


@pytest.mark.parametrize("solid", SOLIDS, ids=lambda solid: solid.name)
def test_scaling_to_a_diagonal_scales_everything(solid):
    scaled = solid.to_diagonal(0.04)
    assert scaled.diagonal == pytest.approx(0.04)
    np.testing.assert_allclose(scaled.bounds, solid.bounds * 0.04 / solid.diagonal)


def test_a_surface_changes_the_configuration_only_where_the_parts_do_not_tell_it():
    plain = rodgers_solid()
    # So stimuli of the recipe keep the configuration hash that they had before solids had surfaces.
    assert plain.config() == replace(plain, surface=None).config()
    other = replace(plain, surface=Mesh(plain.surface.vertices * 1.001, plain.surface.faces))
    assert other.config()["hash"] != plain.config()["hash"]


def test_the_configuration_of_a_solid_changes_with_its_geometry_only():
    assert rodgers_solid().config() == rodgers_solid().config()
    assert rodgers_solid().config() != rodgers_solid(0.05).config()
    assert sphere(1e-3).config() != sphere(2e-3).config()
