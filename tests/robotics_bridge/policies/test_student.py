"""The rsl_rl model class that feels, and its exports."""

from __future__ import annotations

import warnings

import pytest
import torch
from rsl_rl.utils import split_and_pad_trajectories

from brainbench import load_model
from brainbench.core.errors import UsageError
from robotics_bridge.policies.encoders.arms import ARMS
from robotics_bridge.policies.export import export_policy
from robotics_bridge.policies.student import ActingModel
from robotics_bridge.policies.training.distill_config import DistillConfig
from tests.factories.policies import NETWORK, make_student, student_observations


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


@pytest.mark.parametrize("name", [*ARMS, NETWORK, "s4-small", "zhuang-small+mamba"])
def test_every_arm_is_a_model_of_rsl_rl_whose_memory_is_reset_row_by_row(name) -> None:
    policy = make_student(name, embedder="lstm").eval()
    obs = student_observations(3, 6)
    with torch.no_grad():
        whole = torch.stack([policy(obs[step]) for step in range(6)])
        assert whole.shape == (6, 3, 12)
        state = policy.get_hidden_state()
        assert state.shape == (1, 3, policy.core.state_size)
        policy.reset()
        for step in range(6):
            if step == 3:
                policy.reset(torch.tensor([0, 1, 0]))
            actions = policy(obs[step])
        torch.testing.assert_close(actions[[0, 2]], whole[-1, [0, 2]])
        policy.reset()
        for step in range(3, 6):
            fresh = policy(obs[step])
        torch.testing.assert_close(fresh[1], actions[1])


@pytest.mark.parametrize("name", ["rnn", NETWORK])
def test_padded_sequences_of_ppo_give_the_actions_of_the_rollout(name) -> None:
    policy = make_student(name, tactile={"learning": "finetuned"} if name == NETWORK else {}).eval()
    obs = student_observations(2, 6)
    dones = torch.zeros(6, 2, 1)
    dones[2, 0] = 1
    with torch.no_grad():
        states, found = [], []
        for step in range(6):
            memory = policy.get_hidden_state()
            states.append(policy.zeros(2)[None] if memory is None else memory)
            found.append(policy(obs[step]))
            policy.reset(dones[step, :, 0])
        padded, masks = split_and_pad_trajectories(obs, dones)
        starts = torch.stack([states[0][0, 0], states[3][0, 0], states[0][0, 1]])[None]
        policy.reset()
        again = policy(padded, masks=masks, hidden_state=starts)
    torch.testing.assert_close(again, torch.stack(found), atol=1e-5, rtol=1e-4)


def test_gradients_reach_a_finetuned_network_and_never_a_frozen_one() -> None:
    for learning, moves in (("finetuned", True), ("frozen", False)):
        policy = make_student(tactile={"learning": learning}).train()
        obs = student_observations(2, 5)
        for step in range(5):
            actions = policy(obs[step])
        actions.pow(2).mean().backward()
        front = policy.core.tactile.front  # type: ignore[union-attr]
        assert any(p.grad is not None and p.grad.any() for p in front.parameters()) is moves
        assert policy.core.tactile.project.weight.grad.any()  # type: ignore[union-attr]
        policy.detach_hidden_state()
        assert not policy.get_hidden_state().requires_grad


def test_kept_features_of_a_frozen_network_give_the_same_latent() -> None:
    policy = make_student().eval()
    front = policy.core.tactile.frozen_part  # type: ignore[union-attr]
    obs, h, own = student_observations(2, 5), policy.zeros(2), torch.zeros(2, front.state_size)
    for step in range(5):
        latent, h = policy.advance(obs[step], h)
        features, own = front(obs[step]["tactile"], own)
        kept, _ = policy.advance({**obs[step], "tactile": features}, policy.zeros(2))
        torch.testing.assert_close(latent, kept)


@pytest.mark.slow
def test_a_policy_that_was_sampled_in_training_is_exported_and_never_as_a_program(tmp_path) -> None:
    policy = make_student("zhuang-small", distribution_cfg={"class_name": "GaussianDistribution", "init_std": 1.0})
    assert export_policy(policy, tmp_path / "policy").difference < 1e-4
    with pytest.raises(UsageError, match="ONNX"):
        policy.as_jit()


def test_a_network_keeps_the_weights_that_were_scored() -> None:
    policy = make_student()
    own = dict(load_model(NETWORK).named_parameters())
    front = policy.core.tactile.front  # type: ignore[union-attr]
    with warnings.catch_warnings():
        for name, weight in front.step.model.named_parameters():
            torch.testing.assert_close(weight, own[name], rtol=0, atol=0)


@pytest.mark.parametrize("name", [*ARMS, NETWORK])
def test_many_steps_at_once_are_those_steps_one_by_one(name) -> None:
    policy = make_student(name, embedder="lstm", tactile={"learning": "finetuned"} if name == NETWORK else {}).eval()
    obs, ended = student_observations(3, 4), torch.zeros(4, 3, dtype=torch.bool)
    ended[1, 0] = ended[3, 2] = True
    with torch.no_grad():
        h, found = torch.randn(3, policy.core.state_size, generator=torch.Generator().manual_seed(1)), []
        latents, after = policy.unroll(obs, h, ended)
        for step in range(4):
            latent, h = policy.advance(obs[step], h)
            found.append(latent)
            h = torch.where(ended[step][:, None], 0.0, h)
    torch.testing.assert_close(latents, torch.stack(found), atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(after, h, atol=1e-5, rtol=1e-4)


def test_what_a_frozen_network_gave_needs_no_memory_of_touch() -> None:
    policy = make_student(embedder="lstm").eval()
    front = policy.core.tactile.frozen_part  # type: ignore[union-attr]
    obs, own, features = student_observations(2, 3), torch.zeros(2, front.state_size), []
    with torch.no_grad():
        for step in range(3):
            given, own = front(obs[step]["tactile"], own)
            features.append(given)
        whole, _ = policy.unroll(obs, policy.zeros(2))
        kept, after = policy.unroll({**obs, "tactile": torch.stack(features)}, policy.zeros(2, stored=True))
    assert after.shape == (2, policy.core.stored_size)
    torch.testing.assert_close(kept, whole, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("own", ["hand", "observe", "placement", "resolution", "name"])
def test_what_is_the_students_own_cannot_be_set_for_its_encoder(own) -> None:
    with pytest.raises(UsageError, match=f"'{own}'"):
        DistillConfig(task="in_palm_rotate", encoder_settings={own: "tips"})
