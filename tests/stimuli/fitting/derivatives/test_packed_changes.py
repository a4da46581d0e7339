"""How packed numbers change with parameters, and what cannot be differentiated."""

from dataclasses import replace

import numpy as np
import pytest

from brainbench.core.errors import UsageError
from brainbench.core.rotations import euler_matrix
from brainbench.geometry import Mesh
from brainbench.stimuli.engines.rod.tasks import PackedTasks, make_task
from brainbench.stimuli.fitting.derivatives.packed_changes import PackedPlaces, packed_change, packed_part
from brainbench.stimuli.fitting.gradients import GradientRun
from brainbench.stimuli.objects.obstacle import Capsule, Obstacle
from tests.factories.gradients import COARSE, WHISKER, touching_job

POST = Capsule((11e-3, 2.2e-3, -8e-3), (11e-3, 2.7e-3, 8e-3), 5e-4)


def _ends(job, factor):
    low, high = (replace(job, whisker=replace(WHISKER, young_modulus=factor * value)) for value in (1.0, 3.0))
    return low, high


def test_stiffness_grows_with_the_modulus_and_masses_stay():
    job = touching_job(POST)
    task = make_task(job, COARSE, {}, silent=True)
    low, high = _ends(job, 1e9)
    change = packed_change(task, low, high, 2e9, quasistatic=False)
    length, _, mass, *_, stiffness, torsion, start, end = change["link"]
    np.testing.assert_allclose(stiffness, task.chain.stiffness * 1e6 / WHISKER.young_modulus, rtol=1e-9)
    for row in (length, mass, start, end):
        assert np.abs(row).max() == 0
    assert task.twists == bool(np.abs(torsion).max() > 0)
    # What is one object in both does not change.
    assert not any(name.startswith(("shape", "base", "body")) for name in change)


def test_numbers_of_each_job_stand_in_places_of_their_own():
    tasks = [make_task(touching_job(POST), COARSE, {}, silent=True) for _ in range(2)]
    places = PackedPlaces.of(PackedTasks.of(tasks, shared=False))
    arrays = {"shape_place": np.arange(6.0).reshape(2, 3), "beta": np.arange(2.0), "link": np.zeros((10, 12, 2))}
    for job, place in enumerate(places):
        assert packed_part(arrays, "shape_place", place, job).tolist() == [[3.0 * job, 3.0 * job + 1, 3.0 * job + 2]]
        assert packed_part(arrays, "beta", place, job).tolist() == [job]
        assert packed_part(arrays, "link", place, job).shape == (10, 8)


def test_jobs_of_another_structure_are_refused():
    job = touching_job(POST)
    task = make_task(job, COARSE, {}, silent=True)
    with pytest.raises(UsageError, match="same obstacles"):
        packed_change(task, job, replace(job, obstacles=()), 1.0, quasistatic=False)


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
