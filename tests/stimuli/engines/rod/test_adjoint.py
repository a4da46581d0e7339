"""Runs that are recorded: the ordinary steps, kept with the square root of their number."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from brainbench.core.devices import pick_device
from brainbench.stimuli.engines.rod.adjoint import RecordingSolver
from brainbench.stimuli.engines.rod.engine import RodEngine
from brainbench.stimuli.engines.rod.tasks import PackedTasks, make_task
from brainbench.stimuli.objects.obstacle import Capsule
from brainbench.stimuli.validation.contact_scenes import contact_jobs
from tests.factories.gradients import COARSE, touching_job

FINE = replace(COARSE, precision="double")
POST = Capsule((11e-3, 2.2e-3, -8e-3), (11e-3, 2.7e-3, 8e-3), 5e-4)


def _record(job, fidelity=FINE):
    task = make_task(job, fidelity, {}, silent=True)
    packed = PackedTasks.of([task], shared=False)
    solver = RecordingSolver(packed.chains, fidelity, pick_device("cpu"), packed.shapes.needs, twists=task.twists)
    return solver, packed.launch(solver, record_shape=True)


def _of_wrenches(solver, frames):
    """Return the derivatives of the sum of all wrenches by the results of one job."""
    return np.ones((1, frames, 6)), np.zeros((1, frames, solver.capacity + 1, 3)), np.zeros((1, frames, 6))


def test_a_recorded_run_takes_the_steps_of_the_ordinary_one():
    job = touching_job(POST)
    _, result = _record(job)
    ordinary = RodEngine(retry=1).run([job], FINE, record_shape=True)[0]
    assert ordinary.contact.any()
    assert result.steps[0, 0] == ordinary.steps
    # One frictionless contact is solved exactly by both.
    np.testing.assert_allclose(result.wrench[0, :, 0], ordinary.wrench, rtol=0, atol=1e-12 * 1e-3)


def test_beyond_its_room_memory_grows_with_the_square_root_of_the_steps(monkeypatch):
    monkeypatch.setattr(RecordingSolver, "room", 0)
    job = touching_job(POST)
    for share in (1, 4, 16):
        solver, result = _record(job, replace(FINE, time_step=1e-4 / share))
        steps = result.steps[0, 0]
        assert steps > 250 * share
        assert len(solver.checkpoints) + solver.paused.budget < 2.5 * np.sqrt(steps)


def test_forces_of_several_contacts_with_friction_are_solved_to_rounding():
    # Sweeps alone leave a seventh of the contact steps of this whisker on a mesh unsolved.
    job = contact_jobs(11, each=1)[31]
    solver, result = _record(job, replace(FINE, links=11))
    found = solver.reverse(*_of_wrenches(solver, result.wrench.shape[1]))["contacts"][0]
    assert result.steps[0, 0] > 2000
    assert found["slipped"] > 5
    assert found["degenerate"] == 0


def test_short_runs_are_written_down_once_and_long_ones_in_parts_with_the_same_derivatives(monkeypatch):
    solver, _ = _record(touching_job(POST, friction=0.4))
    outputs = _of_wrenches(solver, 30)
    assert len(solver.checkpoints) == 1
    whole = solver.reverse(*outputs)
    monkeypatch.setattr(RecordingSolver, "room", 0)
    solver, _ = _record(touching_job(POST, friction=0.4))
    assert len(solver.checkpoints) > 10
    assert np.array_equal(whole["link"], solver.reverse(*outputs)["link"])


def test_going_back_twice_gives_the_same():
    solver, result = _record(touching_job(POST, friction=0.4))
    outputs = _of_wrenches(solver, result.wrench.shape[1])
    first, second = solver.reverse(*outputs), solver.reverse(*outputs)
    for name in ("link", "knots", "shape_place"):
        assert np.abs(first[name]).max() > 0
        assert np.array_equal(first[name], second[name])


@pytest.mark.slow
def test_scenes_that_ask_for_no_gradient_do_not_load_its_kernels():
    code = (
        "import sys; from tests.stimuli.engines.rod.test_adjoint import *;"
        "RodEngine().run([touching_job(POST)], COARSE);"
        "found = [name for name in sys.modules if 'adjoint' in name and 'kernels' in name];"
        "assert not found, found"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
