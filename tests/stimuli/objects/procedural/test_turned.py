import numpy as np

from brainbench.stimuli.objects import procedural


def test_an_ellipsoid_has_the_drawn_axes():
    shape = procedural.make("ellipsoid", 4)
    extent = np.ptp(shape.mesh.bounds, axis=0)
    np.testing.assert_allclose(
        extent[1:] / extent[0], [shape.parameters["y_over_x"], shape.parameters["z_over_x"]], rtol=1e-6
    )
