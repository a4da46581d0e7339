"""The gymnasium adapter, judged by gymnasium's own checks."""

from __future__ import annotations

import warnings
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from brainbench.core.errors import UsageError
from robotics_bridge import tasks
from robotics_bridge.envs.gymnasium import IDS, GymEnv, GymVectorEnv


@pytest.fixture(scope="module")
def env() -> GymVectorEnv:
    task = replace(tasks.load("in_palm_rotate"), episode=0.1)
    return GymVectorEnv(tasks.make(task, num_envs=3, keep_final=True, threads=1), privileged=True)


def test_registered_ids_make_every_task_that_needs_no_grasps() -> None:
    made = gymnasium.make_vec("brainbench/InPalmRotate-v0", num_envs=2, threads=1)
    observations, _ = made.reset(seed=3)
    assert made.observation_space.contains(observations)
    assert set(IDS) <= set(gymnasium.registry)
    made.close()


@pytest.mark.parametrize("name", ["brainbench/InPalmRotate-v0", "brainbench/HotBall-v0"])
def test_a_single_environment_passes_the_checker_of_gymnasium(name: str) -> None:
    made = gymnasium.make(name, threads=1, observe="force_torque", placement="tips")
    # Its only remark is that actions reach further than -1 … 1, on purpose.
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*(action space|infinity).*")
        check_env(made.unwrapped)
    made.close()


def test_a_single_environment_shows_the_last_observation_of_an_episode() -> None:
    task = replace(tasks.load("in_palm_rotate"), episode=0.1)
    single = GymEnv(GymVectorEnv(tasks.make(task, num_envs=1, keep_final=True, threads=1)))
    single.reset(seed=4)
    for _ in range(4):
        observations, _, terminated, truncated, info = single.step(np.ones(5, dtype=np.float32))
    assert (terminated, truncated) == (False, True)
    assert observations["proprio"][-5:].tolist() == [1.0] * 5
    assert set(info) == {"diverged", "metric", "return"}


def test_it_declares_its_autoreset_mode_and_spaces(env: GymVectorEnv) -> None:
    assert env.metadata["autoreset_mode"] == gymnasium.vector.AutoresetMode.SAME_STEP
    assert env.single_action_space.shape == (5,)
    observations, info = env.reset(seed=1)
    assert info == {}
    assert env.observation_space.contains(observations)


def test_gymnasiums_statistics_wrapper_counts_whole_episodes(env: GymVectorEnv) -> None:
    counted = gymnasium.wrappers.vector.RecordEpisodeStatistics(env)
    counted.reset(seed=1)
    info: dict = {}
    for _ in range(4):
        *_, info = counted.step(np.zeros((3, 5), dtype=np.float32))
    assert info["episode"]["l"].tolist() == [4, 4, 4]


def test_the_same_seed_and_actions_give_the_same_rollout(env: GymVectorEnv) -> None:
    def run() -> tuple[np.ndarray, ...]:
        first, _ = env.reset(seed=11)
        env.action_space.seed(5)
        steps = [env.step(env.action_space.sample()) for _ in range(6)]
        return first["proprio"], *(step[0]["priv_obj_state"] for step in steps), *(step[1] for step in steps)

    for one, two in zip(run(), run(), strict=True):
        np.testing.assert_array_equal(one, two)


def test_an_ended_episode_shows_its_last_and_the_next_first_observation(env: GymVectorEnv) -> None:
    env.reset(seed=2)
    for _ in range(4):
        observations, reward, terminated, truncated, info = env.step(np.ones((3, 5), dtype=np.float32))
    assert truncated.all()
    assert not terminated.any()
    assert reward.dtype == np.float64
    assert info["_final_obs"].all()
    final = info["final_obs"][0]
    assert env.single_observation_space.contains(final)
    # The last action is part of the observation; a new episode has none yet.
    assert final["proprio"][-5:].tolist() == [1.0] * 5
    assert observations["proprio"][0, -5:].tolist() == [0.0] * 5


def test_a_mask_starts_some_environments_anew(env: GymVectorEnv) -> None:
    env.reset(seed=2)
    env.step(np.ones((3, 5), dtype=np.float32))
    observations, _ = env.reset(options={"reset_mask": np.array([True, False, False])})
    assert observations["proprio"][:, -1].tolist() == [0.0, 1.0, 1.0]


def test_wrong_requests_are_refused(env: GymVectorEnv) -> None:
    with pytest.raises(UsageError, match="num_envs=1; received 3"):
        GymEnv(env)
    with pytest.raises(UsageError, match="keep_final=True"):
        GymVectorEnv(tasks.make("in_palm_rotate", threads=1))
    with pytest.raises(UsageError, match=r"'vision'.*'proprio'"):
        GymVectorEnv(tasks.make("in_palm_rotate", keep_final=True, threads=1), ("vision",))


def test_what_a_hand_has_not_is_given_to_who_asks_for_it_alone() -> None:
    native = tasks.make("in_palm_rotate", num_envs=2, keep_final=True, threads=1)
    assert set(GymVectorEnv(native).single_observation_space.spaces) == {"proprio", "command"}
    for group in ("priv_obj_state", "aux_goal_dist", "goal"):
        with pytest.raises(UsageError, match=f"'{group}', which only the simulation knows"):
            GymVectorEnv(native, ("proprio", group))
    asked = GymVectorEnv(native, ("proprio", "priv_obj_state"), privileged=True)
    assert set(asked.single_observation_space.spaces) == {"proprio", "priv_obj_state"}
    assert {"goal", "aux_goal_dist"} < set(GymVectorEnv(native, privileged=True).single_observation_space.spaces)


def test_touch_is_a_keyword_of_make() -> None:
    env = gymnasium.make(
        "brainbench/InPalmRotate-v0", touch="force_torque", placement="tips", resolution="low", threads=1
    )
    assert env.observation_space["tactile"].shape == (5, 45, 6)
    felt = gymnasium.make("brainbench/InPalmRotate-v0", placement="tips", resolution="low", threads=1)
    assert felt.observation_space["tactile"].shape == (5, 5, 7)
    numb = gymnasium.make("brainbench/InPalmRotate-v0", touch="none", threads=1)
    assert "tactile" not in numb.observation_space.spaces


def test_an_option_that_a_reset_in_gymnasium_lacks_is_refused() -> None:
    pytest.importorskip("gymnasium")
    from robotics_bridge.envs.gymnasium import make_vec

    envs = make_vec("in_palm_rotate", 2)
    with pytest.raises(UsageError, match="reset_mask"):
        envs.reset(options={"reset_masks": [True, False]})
    envs.reset(seed=3, options={"reset_mask": [True, False]})
