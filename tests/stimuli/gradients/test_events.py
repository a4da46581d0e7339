"""Changes of contact that a gradient run reports."""

from dataclasses import replace

import numpy as np
import pytest

from brainbench.stimuli.gradients import GradientRun, JobParameters
from brainbench.stimuli.gradients.events import contact_events
from brainbench.stimuli.objects.obstacle import Capsule, Sphere
from tests.factories.gradients import COARSE, touching_job

SUMMARY = {
    "first": 0, "begun": 1, "ended": 1, "slipped": 0, "degenerate": 0, "largest_force": 1.0, "least_force": 0.1,
    "fastest_slip": 1.0, "slowest_slip": 0.1, "fullest_cone": 0.5, "least_gap": 0.01, "least_lead": 0.01,
}  # fmt: skip


def _events(solid, friction: float, *, frames: int = 30, **changes: float):
    job = touching_job(solid, friction=friction, frames=frames)
    parameters = JobParameters([job], ["young_modulus"])
    run = GradientRun(parameters.build, parameters.values, fidelity=replace(COARSE, **changes))
    return run.gradient([np.ones((frames, 6))]).events[0]


def test_beginning_end_and_slip_of_a_contact_are_counted():
    # This whisker slips off the ball.
    ball = _events(Sphere((11e-3, 2.2e-3, 0.6e-3), 1e-3), 0.0, frames=39)
    assert (ball.begun, ball.ended, ball.slipped) == (1, 1, 0)
    assert ball.status == "smooth"
    post = _events(Capsule((11e-3, 2.2e-3, -8e-3), (11e-3, 2.7e-3, 8e-3), 5e-4), 0.4, frames=39)
    assert post.begun == 1
    assert post.slipped >= 2


@pytest.mark.parametrize(
    ("change", "close"),
    [
        ({"least_force": 1e-7}, "ending"),
        ({"least_gap": 1e-9}, "beginning"),
        ({"least_lead": 1e-9}, "passing"),
        ({"fullest_cone": 1 - 1e-7}, "slipping"),
        ({"slowest_slip": 1e-8}, "sticking"),
    ],
)
def test_a_contact_close_to_another_state_makes_the_gradient_one_sided(change, close):
    assert contact_events(SUMMARY, "").status == "smooth"
    found = contact_events(SUMMARY | change, "")
    assert found.status == "one-sided"
    assert found.close == (close,)


def test_a_shared_load_and_an_unstable_run_are_told():
    assert contact_events(SUMMARY | {"degenerate": 3}, "").status == "degenerate"
    assert contact_events(SUMMARY | {"degenerate": 3}, "the state stopped being finite").status == "unstable"
