"""The arms of the controlled comparison: each student is counted as one of them, and as no other."""

from __future__ import annotations

import pytest

from robotics_bridge.policies.training.distill_config import DistillConfig
from tests.factories.benchmark_programs import benchmark_program

STUDENTS = benchmark_program("policies.students")


@pytest.mark.parametrize("arm", STUDENTS.ARMS | STUDENTS.NETWORKS)
def test_a_student_belongs_to_the_arm_that_it_was_trained_as(arm: str) -> None:
    settings = dict((STUDENTS.ARMS | STUDENTS.NETWORKS)[arm])
    own = {"seed": 3} if "encoder" in settings else {}
    if settings.get("encoder", "").startswith(("zhuang", "resnet", "s4")):
        own |= {"learning": "frozen"}
    settings["encoder_settings"] = own | settings.get("encoder_settings", {})
    assert STUDENTS.arm_of(DistillConfig(task="in_palm_rotate", **settings)) == arm


def test_a_student_of_another_network_belongs_to_no_arm() -> None:
    config = DistillConfig(task="in_palm_rotate", encoder="s4-small+gpt", encoder_settings={"learning": "frozen"})
    assert STUDENTS.arm_of(config) is None
