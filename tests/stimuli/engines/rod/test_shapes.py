"""Which side of a surface is out."""

import numpy as np
import pytest

from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.engines.rod.shapes import PackedSurface, pseudo_normals
from brainbench.stimuli.scenes.recipes import get_recipe


@pytest.mark.parametrize("lift", [0.0, 1e-10, -1e-10])
def test_a_triangle_without_a_width_in_a_sharp_edge_does_not_hide_the_other_side(lift):
    """A roof of 33° whose ridge from 0 to 1 has a corner 4 in the middle that one of its two sides does not use."""
    corners = np.array([[0, 0, 0], [10, 0, 0], [5, 3, -10], [5, -3, -10], [4, 0, lift]], dtype=float)
    faces = np.array([[0, 1, 2], [0, 4, 1], [0, 3, 4], [4, 3, 1], [0, 2, 3], [1, 3, 2]])
    found = pseudo_normals(corners, faces)
    up = np.array([0.0, 0.0, 1.0])
    # The ridge and its middle belong to both sides, which are mirror images of each other.
    np.testing.assert_allclose(found[0, 6], up, atol=1e-6)  # edge 0–1 of the side that is whole
    np.testing.assert_allclose(found[2, 5], up, atol=1e-6)  # edge 0–4
    np.testing.assert_allclose(found[3, 5], up, atol=1e-6)  # edge 4–1
    np.testing.assert_allclose(found[1, 4:], np.tile(up, (3, 1)), atol=1e-6)
    np.testing.assert_allclose(found[2, 3], up, atol=1e-6)  # corner 4
    assert PackedSurface.of(corners, faces).triangles == 5
    usual = pseudo_normals(corners[:4], np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]]))
    np.testing.assert_allclose(found[0, [0, 1, 2, 3]], usual[0, [0, 1, 2, 3]], atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("label", ["pyramid", "stairs", "house", "polygon"])
def test_hulls_with_such_triangles_have_no_whisker_inside_before_they_arrive(label):
    (scene,) = (scene for scene in get_recipe("objects").scenes if scene.label == label)
    jobs = scene.jobs()
    times = np.arange(1, 4) * 1e-3
    traces = get_engine("rod").run(
        [type(job)(job.whisker, job.follicle, job.obstacles, times) for job in jobs], Fidelity(links=10, time_step=1e-3)
    )
    assert [trace.reason for trace in traces if trace.reason] == []
