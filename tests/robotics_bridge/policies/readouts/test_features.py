"""The map along the fingers as they are bent."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from robotics_bridge import tasks
from robotics_bridge.policies.encoders.taxel_grid import HandCalibration, TaxelGrid
from robotics_bridge.policies.evaluate import agent
from robotics_bridge.policies.readouts import features
from robotics_bridge.policies.readouts.features import PostureTurn, TouchRollout, calibrate, collect


def _poses(grid: TaxelGrid, turns: list[Rotation]) -> torch.Tensor:
    """Poses [1, L, 7] of links that were turned from their reference, about the palm's axes."""
    rows = []
    for link, turn in zip(grid.layout, turns, strict=True):
        rotation, origin = grid.axes.place[link]
        rows.append([*origin, *(turn * Rotation.from_matrix(rotation)).as_quat(scalar_first=True)])
    return torch.tensor([rows], dtype=torch.float32)


@pytest.mark.parametrize("hand", ["xhand1", "sharpa"])
def test_a_site_of_one_link_turns_with_the_link(hand: str) -> None:
    grid = TaxelGrid(hand)
    turn = PostureTurn(grid)
    readings = torch.randn(1, 2, grid.items, 6, generator=torch.Generator().manual_seed(0))
    still = _poses(grid, [Rotation.identity()] * len(grid.layout))
    torch.testing.assert_close(turn(readings, still), readings, atol=1e-5, rtol=1e-5)
    bends = list(Rotation.random(len(grid.layout), rng=np.random.default_rng(0)))
    poses = _poses(grid, bends)
    first = 0
    for number, (bend, probes) in enumerate(zip(bends, grid.layout.values(), strict=True)):
        count = int(probes.active.sum())
        alone = torch.zeros_like(readings)
        alone[:, :, first : first + count] = readings[:, :, first : first + count]
        before, after = (grid(x).unflatten(1, (2, 2, 3)).movedim(3, -1).numpy() for x in (alone, turn(alone, poses)))
        np.testing.assert_allclose(after, before @ bend.as_matrix().T, atol=2e-4, err_msg=str(number))
        first += count


def test_memory_begins_anew_with_an_episode() -> None:
    begun = torch.zeros(6, 2, dtype=torch.bool)
    begun[0] = True
    begun[3, 1] = True
    x = torch.ones(6, 2, 1)
    found = features.traces(x, begun)
    assert found.shape == (6, 2, 3)
    torch.testing.assert_close(found[:, 0, 1], 1 - 0.5 ** torch.arange(1, 7))
    torch.testing.assert_close(found[3:, 1], found[:3, 0])
    grid = TaxelGrid("xhand1", placement="tips", resolution="low")
    touch = torch.randn(6, 2, 5, grid.items, 6, generator=torch.Generator().manual_seed(0))
    touch[3:, 1] = touch[:3, 0]
    rollout = TouchRollout(torch.zeros(6, 2, 3), touch, begun, {}, ~begun, torch.empty(0))
    state = features.reservoir(rollout, grid, HandCalibration(), seed=1)
    torch.testing.assert_close(state[3:, 1], state[:3, 0])
    assert not torch.equal(state, features.reservoir(rollout, grid, HandCalibration(), seed=2))


def test_bits_say_that_more_than_two_taxels_of_a_link_touch() -> None:
    touch = torch.zeros(1, 1, 1, 7, 6)
    touch[..., :2, 2] = 1.0
    touch[..., 4:, 2] = 1.0
    rollout = TouchRollout(torch.zeros(1, 1, 1), touch, torch.ones(1, 1).bool(), {}, torch.ones(1, 1), touch)
    assert features.bits(rollout, [4, 3]).flatten().tolist() == [0.0, 1.0]


def test_noise_is_no_touch() -> None:
    senses = {"observe": "force_torque", "placement": "tips", "resolution": "low", "threads": 1}
    env = tasks.make("in_palm_rotate", num_envs=4, noisy=True, **senses)
    felt = collect(env, agent("zero", env), 0.25)
    links = [int(probes.active.sum()) for probes in env.hand.layout("low", "tips").values()]
    assert float((felt.taxels != 0).any(-1).float().mean()) > 0.5
    assert float(features.bits(felt, links).mean()) < 0.1


@pytest.mark.slow
def test_what_is_read_does_not_set_the_unit_of_the_encoders() -> None:
    env = tasks.make(
        "in_palm_rotate", num_envs=4, observe="force_torque", placement="palm", resolution="low", threads=1, seed=3
    )
    policy, grid = agent("random", env), TaxelGrid("xhand1", placement="palm", resolution="low")
    first = collect(env, agent("random", env), 0.5)
    found = calibrate(env, policy, grid, 3)
    assert found != HandCalibration.fit(grid(first.taxels.flatten(0, 1)))
    # The episodes that follow are those of the seed, as if nothing had been calibrated.
    env.seed(3)
    again = collect(env, agent("random", env), 0.5)
    env.seed(3)
    torch.testing.assert_close(collect(env, agent("random", env), 0.5).taxels, again.taxels)


def test_a_policy_forgets_what_it_did_before_the_rollout() -> None:
    class Counting:
        def __init__(self) -> None:
            self.steps = torch.zeros(2)

        def __call__(self, _: object) -> torch.Tensor:
            self.steps += 1
            return 0.01 * self.steps[:, None].expand(2, env.num_actions)

        def reset(self, mask: torch.Tensor) -> None:
            self.steps[mask] = 0

    env, policy, found = (
        tasks.make("in_palm_rotate", num_envs=2, observe="force_torque", resolution="low"),
        Counting(),
        [],
    )
    for _ in range(2):
        env.seed(0)
        found.append(collect(env, policy, 0.2).proprio[..., -env.num_actions :])
    assert torch.equal(*found)


def test_of_several_objects_the_contacts_on_the_one_that_counts_are_read() -> None:
    env = tasks.make("hot_ball", num_envs=4, observe="force_torque", placement="tips", resolution="low", threads=1)
    env.seed(1)
    rollout = collect(env, agent("zero", env), 0.5)
    assert len(set(env.state.episode.target.tolist())) > 1
    apart = (rollout.targets["contact"] - rollout.targets["position"]).norm(dim=-1)
    touching = ~apart.isnan()
    assert touching.float().mean() > 0.3
    assert float(apart[touching].max()) < 0.042  # the balls have a radius of 40 mm
