import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from brainbench.core.errors import UsageError
from brainbench.stimuli.figures.camera import VIEWS, Camera

SIZE = (640, 480)
views = st.sampled_from(sorted(VIEWS)) | st.tuples(*[st.floats(-1, 1).filter(lambda value: abs(value) > 0.05)] * 3)
cameras = st.builds(Camera, view=views, projection=st.sampled_from(["perspective", "orthographic"]))
points = hnp.arrays(float, (5, 3), elements=st.floats(-0.02, 0.02))


@given(camera=cameras, cloud=points)
def test_everything_shown_lies_in_the_picture(camera, cloud):
    flat = camera.lens(cloud, SIZE).project(cloud)
    assert (flat[:, :2] >= 0).all()
    assert (flat[:, :2] <= SIZE).all()


@given(camera=cameras, cloud=points)
def test_a_picture_point_and_its_nearness_give_the_point_back(camera, cloud):
    lens = camera.lens(cloud, SIZE)
    x, y, nearness = lens.project(cloud).T
    np.testing.assert_allclose(lens.unproject(x, y, nearness), cloud, atol=1e-9)


@pytest.mark.parametrize(
    ("view", "right", "up"),
    [("top", (1, 0, 0), (0, 1, 0)), ("side", (0, 1, 0), (0, 0, 1)), ("front", (-1, 0, 0), (0, 0, 1))],
)
def test_views_show_dorsal_or_rostral_up(view, right, up):
    np.testing.assert_allclose(Camera(view).axes[:2], [right, up], atol=1e-12)


def test_an_orthographic_picture_is_to_scale():
    lens = Camera("top", "orthographic", target=(0.0, 0.0, 0.0), width=0.064).lens(np.zeros((1, 3)), SIZE)
    flat = lens.project(np.array([[0.0, 0.0, 0.0], [0.003, 0.004, 0.01]]))
    np.testing.assert_allclose(flat[:, :2], [[320, 240], [350, 200]])
    np.testing.assert_allclose(lens.pixel_size(np.zeros((1, 3))), 1e-4)


def test_perspective_enlarges_what_is_nearer_by_the_ratio_of_distances():
    camera = Camera("top", target=(0.0, 0.0, 0.0), width=0.064, field_of_view=2 * math.atan(0.5))
    lens = camera.lens(np.zeros((1, 3)), SIZE)
    assert lens.distance == pytest.approx(0.064)
    far, near = lens.project(np.array([[0.01, 0.0, 0.0], [0.01, 0.0, 0.032]]))[:, 0] - 320
    assert far == pytest.approx(100)
    assert near == pytest.approx(200)
    assert np.isnan(lens.project(np.array([0.0, 0.0, 0.065]))[2])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"view": "abov"}, "Unknown view 'abov'"),
        ({"view": (0.0, 0.0, 0.0)}, "direction"),
        ({"view": (0.0, math.nan, 0.0)}, "view of a camera"),
    ],
)
def test_impossible_cameras_are_refused(options, message):
    with pytest.raises(UsageError, match=message):
        Camera(**options)
