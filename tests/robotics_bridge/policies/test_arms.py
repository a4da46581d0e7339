"""The arms of the controlled comparison: each student is counted as one of them, and as no other."""

from __future__ import annotations

import pytest

from robotics_bridge.policies.training.distill_config import DistillConfig
from tests.factories.benchmark_programs import benchmark_program

ARMS = benchmark_program("policies.arms")


@pytest.mark.parametrize("arm", ARMS.ARMS | ARMS.NETWORKS)
def test_a_student_belongs_to_the_arm_that_it_was_trained_as(arm: str) -> None:
    assert ARMS.arm_of(DistillConfig(task="in_palm_rotate", **ARMS.settings_of(arm, draw=3))) == arm


def test_a_student_of_another_network_belongs_to_no_arm() -> None:
    config = DistillConfig(task="in_palm_rotate", encoder="s4-small+gpt", encoder_settings={"learning": "frozen"})
    assert ARMS.arm_of(config) is None
