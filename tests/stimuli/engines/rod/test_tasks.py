"""What the solver needs of jobs: who shares a scene, and what comes too fast."""

from dataclasses import replace

import numpy as np
import pytest

from brainbench.stimuli.engines.error_estimates import halved_step, more_links
from brainbench.stimuli.engines.rod.engine import PackedTasks, make_task
from brainbench.stimuli.engines.rod.launch import Approach, followed
from brainbench.stimuli.objects.obstacle import Capsule, Obstacle
from tests.factories.gradients import COARSE, touching_job

POST = Capsule((11e-3, 2.2e-3, -8e-3), (11e-3, 2.7e-3, 8e-3), 5e-4)


def test_jobs_beside_the_same_object_share_its_shapes_unless_they_are_to_have_their_own():
    job, bodies = touching_job(POST), {}
    tasks = [make_task(job, COARSE, bodies) for _ in range(2)]
    assert tasks[0].names == tasks[1].names
    shared, apart = (PackedTasks.of(tasks, shared=shared) for shared in (True, False))
    assert shared.jobs.scene.tolist() == [0, 0]
    assert apart.jobs.scene.tolist() == [0, 1]
    assert len(shared.chains) == len(apart.chains) == 1
    assert shared.shapes.arrays()["quaternion"].shape == (1, 4)


def test_finer_simulations_of_a_whisker_take_the_motion_of_its_base_that_was_looked_at_before():
    job, motions = touching_job(POST), {}
    finer = more_links(halved_step(COARSE, job.whisker, job.spacing), job.whisker)
    tasks = [make_task(job, fidelity, motions) for fidelity in (COARSE, finer)]
    assert tasks[0].base is tasks[1].base
    assert tasks[0].chain.links < tasks[1].chain.links


def test_finer_simulations_of_a_whisker_do_not_look_at_what_it_meets_again():
    moments = []

    def motion(times):
        moments.append(len(times))
        return np.outer(times, (0.0, 0.05, 0.0)), np.tile([1.0, 0.0, 0.0, 0.0], (len(times), 1))

    job, motions = replace(touching_job(POST), obstacles=(Obstacle((POST,), motion),)), {}
    first = make_task(job, COARSE, motions)
    looks = len(moments)
    for finer in (halved_step(COARSE, job.whisker, job.spacing), more_links(COARSE, job.whisker)):
        task, alone = (make_task(job, finer, memory) for memory in (motions, {}))
        assert (task.names, task.bodies, task.twists) == (first.names, first.bodies, first.twists)
        assert (task.chain, task.fidelity) == (alone.chain, alone.fidelity)
        assert vars(task.approach) == vars(alone.approach)
        np.testing.assert_array_equal(task.limit, alone.limit)
    # Those without memory looked as often as the first, the others never.
    assert looks > 0
    assert len(moments) == 3 * looks


def test_a_blow_is_followed_up_to_a_part_of_the_radius_and_others_as_far_as_contacts_are_sought():
    speed, blow, step = np.array([1.0, 20.0]), np.array([1.0, 20.0]), np.array([1e-3, 1e-3])
    way, farthest = followed(speed, blow, step, 1e-4)
    np.testing.assert_allclose(way, [1e-3 / 16, 20e-3])
    np.testing.assert_allclose(farthest, [0.8e-3, 0.25e-4])


def test_approaches_of_jobs_become_a_table():
    table = Approach.table([Approach(), Approach(1e-3, 8e-4, 0.02, True)])
    assert table.fast_at.tolist() == [[np.inf], [pytest.approx(0.02)]]
    assert table.struck.tolist() == [[False], [True]]
