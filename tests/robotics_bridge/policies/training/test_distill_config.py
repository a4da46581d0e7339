"""A student from its configuration alone."""

from __future__ import annotations

import pytest

from brainbench.core.errors import UsageError
from robotics_bridge.policies.training.distill_config import DistillConfig


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"observe": "none", "encoder": "rnn"}, "'none' has no touch; leave out 'encoder'"),
        ({"observe": "none", "placement": "tips", "noisy": True}, "leave out 'placement', 'noisy'"),
        ({"observe": "none", "encoder_settings": {"seed": 1}}, "leave out 'encoder_settings'"),
        ({"noisy": "no"}, "'noisy' of a student must be True or False; received 'no'"),
        ({"encoder_settings": []}, "'encoder_settings' must be names and values"),
        ({"placement": "tip"}, "did you mean 'tips'"),
        ({"resolution": "mid"}, "did you mean 'med'"),
        ({"teacher_iterations": 5}, "'teacher_share' falls, and that is 0"),
        ({"encoder": 5}, "tactile encoder 5"),
    ],
)
def test_settings_of_a_student_that_reach_nothing_are_refused(options, told) -> None:
    with pytest.raises(UsageError, match=told):
        DistillConfig(task="in_palm_rotate", **options)
