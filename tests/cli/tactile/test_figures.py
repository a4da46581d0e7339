"""Pictures of the tactile demo."""

import numpy as np
import pytest

from brainbench.cli.tactile import figures
from brainbench.stimuli.figures.surfaces import Triangles


def test_triangles_of_a_link_are_carried_with_it():
    corners = np.array([[[1.0, 0, 0], [0, 1, 0], [0, 0, 1]]])
    flat = Triangles(corners, np.tile([1.0, 0, 0], (1, 3, 1)), np.ones((1, 3)))
    half = np.sqrt(0.5)
    # A quarter turn about z, then one metre up.
    moved = figures.placed(flat, np.array([0, 0, 1, 0, 0, half, half]))
    np.testing.assert_allclose(moved.corners[0], [[0, 1, 1], [-1, 0, 1], [0, 0, 2]], atol=1e-12)
    np.testing.assert_allclose(moved.normals[0], [[0, 1, 0]] * 3, atol=1e-12)


def test_a_supersampled_picture_is_averaged_to_its_own_size():
    fine = np.zeros((2 * figures.SAMPLES, 3 * figures.SAMPLES, 3))
    fine[0, 0] = 1.0
    small = figures.averaged(fine)
    assert small.shape == (2, 3, 3)
    np.testing.assert_allclose(small[0, 0], 1 / figures.SAMPLES**2)
    assert not small[1:].any()


def test_white_borders_are_cut_to_a_margin():
    image = np.ones((50, 60, 3))
    image[20:30, 40:45] = 0.2
    assert figures._trimmed(image, margin=3).shape == (16, 11, 3)
    assert figures._trimmed(np.ones((50, 60, 3))).shape == (50, 60, 3)


@pytest.mark.parametrize("moved", [0.0, 1e-3])
def test_markers_are_drawn_whether_they_moved_or_not(tmp_path, moved):
    rest = np.stack([*np.meshgrid(np.linspace(0, 0.01, 4), np.linspace(0, 0.01, 4)), np.zeros((4, 4))], -1)
    field = np.full((16, 3), moved)
    figures.draw_markers(tmp_path / "m.png", rest.reshape(-1, 3), {"press": field, "drag": field})
    assert (tmp_path / "m.png").read_bytes().startswith(b"\x89PNG")
