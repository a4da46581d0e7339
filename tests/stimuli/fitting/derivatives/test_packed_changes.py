"""How packed numbers change with parameters, and what cannot be differentiated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from brainbench.core.errors import UsageError
from brainbench.core.rotations import euler_matrix
from brainbench.geometry import Mesh
from brainbench.stimuli.fitting.gradients import GradientRun
from brainbench.stimuli.objects.obstacle import Obstacle
from tests.factories.gradients import COARSE, touching_job


def _prism() -> Mesh:
    corners = np.array([[x, y, z] for x in (-1e-3, 1e-3) for y in (-1e-3, 1e-3) for z in (-8e-3, 8e-3)])
    faces = np.array(
        [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4],
         [1, 5, 7], [1, 7, 3]]
    )  # fmt: skip
    turn = euler_matrix((0.1, 0.0, np.pi / 4))
    return Mesh(corners @ turn.T + [11e-3, 3e-3, 0.3e-3], faces.astype(np.int32))


def test_what_cannot_be_differentiated_is_refused():
    job = touching_job(_prism())

    def scaled(values):
        return [replace(job, obstacles=(Obstacle((), surface=_prism().scaled(values[0])),))]

    with pytest.raises(UsageError, match="deforms or scales a mesh"):
        GradientRun(scaled, [1.0], fidelity=COARSE).gradient([np.ones((30, 6))])
    with pytest.raises(UsageError, match="same number of jobs"):
        GradientRun(lambda values: [job] * (1 + (values[0] > 1)), [1.0], fidelity=COARSE)
    with pytest.raises(UsageError, match="positive scale"):
        GradientRun(lambda values: [job], [0.0], fidelity=COARSE)
    with pytest.raises(UsageError, match="finite"):
        GradientRun(lambda values: [job], [np.nan], fidelity=COARSE)
