import pytest
import torch

from robotics_bridge.policies.acting import ActingModel


def test_weights_of_rsl_rl_give_the_same_actions_without_it():
    models = pytest.importorskip("rsl_rl.models")
    observations = {"proprio": torch.randn(7, 5), "goal": torch.randn(7, 2)}
    groups = {"actor": ["proprio", "goal"]}
    spread = {"class_name": "GaussianDistribution", "init_std": 1.0}
    theirs = models.MLPModel(observations, groups, "actor", 3, (16, 8), "elu", True, spread)
    theirs.update_normalization({name: 3 * value + 1 for name, value in observations.items()})
    ours = ActingModel(observations, groups, "actor", 3, (16, 8))
    ours.load_state_dict({name: v for name, v in theirs.state_dict().items() if not name.startswith("distribution.")})
    assert torch.equal(ours(observations), theirs(observations))
    assert ours(observations).shape == (7, 3)
