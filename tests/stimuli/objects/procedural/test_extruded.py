import numpy as np
import pytest

from brainbench.stimuli.objects import procedural


def test_a_torus_is_a_torus():
    shape = procedural.make("torus", 4, detail=20_000)
    r = shape.parameters["tube_over_ring"]
    size = np.sqrt(2 * (2 + 2 * r) ** 2 + (2 * r) ** 2)
    assert shape.mesh.volume == pytest.approx(2 * np.pi**2 * r**2 / size**3, rel=0.02)
