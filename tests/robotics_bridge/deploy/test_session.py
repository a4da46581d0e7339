"""What a deployed policy may read: what a hand measures or is told, and no other group of the simulation."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from brainbench.core.errors import UsageError
from robotics_bridge.deploy.session import DeployedPolicy
from robotics_bridge.policies.contract import PolicyContract
from robotics_bridge.policies.schema import Values
from tests.factories.policies import contract_of


def _deployed(group: str, size: int = 1, **deployment: Any) -> DeployedPolicy:
    contract = contract_of()
    contract["inputs"][1] = [group, [size]]
    contract["deployment"] |= {"hand": "xhand1", **deployment}
    return DeployedPolicy(Path("policy.onnx"), PolicyContract.of(Values("policy.onnx.json", contract)))


@pytest.mark.parametrize("group", ["priv_obj_state", "priv_proprio", "aux_goal_dist", "aux_obj_size"])
def test_no_constant_stands_for_what_only_the_simulation_knows(group: str) -> None:
    with pytest.raises(UsageError, match=f"'{group}', which only the simulation knows"):
        _deployed(group).require({group, "tactile"})


def test_a_command_that_the_contract_states_needs_no_word_of_the_user() -> None:
    assert "command" not in _deployed("command", command=[1.0]).require({"tactile"})
    with pytest.raises(UsageError, match=r"command \(\[4\], what the hand is told"):
        _deployed("command", 4).require({"tactile"})


def test_the_goal_of_earlier_students_is_named_for_what_it_was() -> None:
    with pytest.raises(UsageError, match="angle to the goal, which changed with every step"):
        _deployed("goal").require({"tactile"})
    assert next(iter(_deployed("goal").require({"goal", "tactile"}))) == "goal"
