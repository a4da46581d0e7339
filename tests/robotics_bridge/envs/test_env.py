"""The native environment, on C MuJoCo; what MuJoCo Warp does differently is in physics/test_gpu."""

from __future__ import annotations

import contextlib
import io
from typing import Any

import numpy as np
import pytest
import torch
from rsl_rl.algorithms import PPO, Distillation
from rsl_rl.env import VecEnv
from tensordict import TensorDict

from brainbench.core.errors import UsageError
from robotics_bridge import tasks
from tests.factories.task_worlds import Follower, TouchWorld, make_env, random_actions


def test_the_same_seed_gives_the_same_episode_and_another_seed_another() -> None:
    def run(seed: int) -> torch.Tensor:
        env = make_env(2, seed=seed)
        return torch.stack([env.step(a)[0]["priv_obj_state"].clone() for a in random_actions(env, 5)])

    first = run(1)
    assert torch.equal(first, run(1))
    assert not torch.equal(first, run(2))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"num_envs": 0}, "at least 1 and at most 1,000,000"),
        ({"engine": "mujoko"}, "did you mean 'mujoco'"),
        ({"observe": "forces"}, "did you mean 'force'"),
        ({"device": "cuda:0", "engine": "mujoco"}, "CUDA|processor"),
        ({"link_pose": True}, "choose an observation type"),
        ({"config": "publshed"}, "did you mean 'published'"),
    ],
)
def test_wrong_requests_say_what_is_allowed(options: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        tasks.make("in_palm_rotate", **options)


def test_actions_of_another_shape_are_refused() -> None:
    with pytest.raises(UsageError, match=r"\(2, 5\)"):
        make_env(2).step(torch.zeros(2, 12))


def test_what_does_not_fit_the_environments_is_refused() -> None:
    one, two = (tasks.make("in_palm_rotate", num_envs=count, threads=1) for count in (1, 2))
    for seed in (np.nan, 1.5, -1, 2**70, None):
        with pytest.raises(UsageError, match="seed"):
            two.seed(seed)
    with pytest.raises(UsageError, match="tensor"):
        two.step(np.zeros((2, two.num_actions), np.float32))
    for mask in (np.array([True, False]), torch.tensor([1, 0]), torch.tensor([True])):
        with pytest.raises(UsageError, match="mask"):
            two.reset(mask)
    for values in ({}, one.state_dict()):
        with pytest.raises(UsageError, match="other environments"):
            two.load_state_dict(values)
    two.load_state_dict(two.state_dict())
    with pytest.raises(UsageError, match=r"\(2,\)"):
        two.episode_length_buf = torch.zeros(1, dtype=torch.long)


STUDENT = {
    "class_name": "robotics_bridge.policies.student:TactilePolicy",
    "hidden_dims": [32, 32],
    "embedder": "none",
    "distribution_cfg": {"class_name": "GaussianDistribution", "init_std": 0.5, "std_type": "log"},
}


class World(VecEnv):
    """The small world in rsl_rl's form."""

    def __init__(self, num_envs: int = 8) -> None:
        self.world = TouchWorld(num_envs)
        self.num_envs, self.num_actions, self.device = num_envs, 2, "cpu"
        self.max_episode_length, self.cfg = 8, {}
        self.episode_length_buf = self.world.episode_length_buf

    def get_observations(self) -> TensorDict:
        values = {name: value.clone() for name, value in self.world.observations.items()}
        values["best"] = Follower()(self.world.observations)
        return TensorDict(values, batch_size=[self.num_envs])

    def step(self, actions):
        _, reward, ended, late, _ = self.world.step(actions)
        return self.get_observations(), reward, (ended | late).long(), {"time_outs": late}


def _built(kind, world: World, **models):
    cfg = {"num_steps_per_env": 8, "multi_gpu": None, **models}
    with contextlib.redirect_stdout(io.StringIO()):
        return kind.construct_algorithm(world.get_observations(), world, cfg, "cpu")


def _iterate(algorithm, world: World, count: int) -> list[dict[str, float]]:
    losses = []
    algorithm.train_mode()
    obs = world.get_observations()
    for _ in range(count):
        with torch.inference_mode():  # as rsl_rl's runner collects
            for _ in range(8):
                obs, reward, dones, extras = world.step(algorithm.act(obs))
                algorithm.process_env_step(obs, reward, dones, extras)
            algorithm.compute_returns(obs)
        losses.append(algorithm.update())
    return losses


@pytest.mark.parametrize("learning", ["finetuned", "frozen"])
def test_ppo_learns_through_a_network_with_memory(learning) -> None:
    world = World()
    tactile = {"name": "zhuang-small", "placement": "tips", "resolution": "low", "learning": learning}
    ppo = _built(
        PPO, world,
        obs_groups={"actor": ["proprio", "goal", "tactile"], "critic": ["proprio", "aux_aim"]},
        actor={**STUDENT, "tactile": tactile},
        critic={"class_name": "MLPModel", "hidden_dims": [32]},
        algorithm={"class_name": "PPO", "num_learning_epochs": 2, "num_mini_batches": 2, "learning_rate": 1e-3},
    )  # fmt: skip
    policy = ppo.get_policy()
    front = policy.core.tactile.front  # type: ignore[union-attr]
    before = [weight.clone() for weight in front.parameters()]
    head = policy.mlp[0].weight.clone()  # type: ignore[index]
    losses = _iterate(ppo, world, 2)
    assert all(torch.isfinite(torch.tensor(list(loss.values()))).all() for loss in losses)
    moved = any(not torch.equal(a, b) for a, b in zip(before, front.parameters(), strict=True))
    assert moved is (learning == "finetuned")
    assert not torch.equal(head, policy.mlp[0].weight)  # type: ignore[index]
    assert policy.get_hidden_state().shape == (1, 8, policy.core.state_size)


def test_rsl_rls_own_distillation_learns_touch_with_it() -> None:
    world = World(32)
    tactile = {"name": "rnn", "placement": "tips", "resolution": "low"}
    distillation = _built(
        Distillation, world,
        obs_groups={"student": ["proprio", "goal", "tactile"], "teacher": ["best"]},
        student={**STUDENT, "tactile": tactile, "distribution_cfg": {**STUDENT["distribution_cfg"], "init_std": 0.1}},
        teacher={"class_name": "MLPModel", "hidden_dims": [8]},
        algorithm={
            "class_name": "Distillation", "num_learning_epochs": 2, "gradient_length": 4, "learning_rate": 3e-3,
        },
    )  # fmt: skip
    losses = [loss["behavior"] for loss in _iterate(distillation, world, 15)]
    assert losses[-1] < 0.5 * losses[0]
