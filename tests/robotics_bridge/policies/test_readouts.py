"""Read-outs: what is linear in features is found on environments left out, what is not there is not."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from brainbench.core.errors import UsageError
from brainbench.models.training.checkpoints import shipped
from robotics_bridge import tasks
from robotics_bridge.policies.encoders.calibration import HandCalibration
from robotics_bridge.policies.encoders.taxel_grid import TaxelGrid
from robotics_bridge.policies.evaluate import agent
from robotics_bridge.policies.readouts import arms
from robotics_bridge.policies.readouts.probe import ProbeOptions, differences, probe
from robotics_bridge.policies.readouts.regression import Readout, read_targets
from robotics_bridge.policies.readouts.rollout import TARGETS, TouchRollout, calibrate, collect


def _made(seed: int = 0, steps: int = 40, envs: int = 20) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    wanted = torch.randn(steps, envs, 12, generator=generator)
    return torch.randn(steps, envs, 4, generator=generator), wanted, torch.ones(steps, envs, dtype=torch.bool)


def _readout(features: torch.Tensor, proprio: torch.Tensor, wanted: torch.Tensor, valid: torch.Tensor) -> Readout:
    errors, spread = read_targets(proprio, features, wanted, valid)
    return Readout("made", features.shape[-1], errors[None], spread)


def test_what_features_hold_is_read_and_what_they_do_not_hold_is_not() -> None:
    proprio, wanted, valid = _made()
    mixed = wanted[..., :6] @ torch.randn(6, 9, generator=torch.Generator().manual_seed(1)) * 1e-4
    found = _readout(mixed, proprio, wanted, valid)
    # Nine mixtures of position and velocity, however small, hold these two and nothing else.
    assert found.r2("position") > 0.99
    assert found.r2("velocity") > 0.99
    assert abs(found.r2("spin")) < 0.05
    assert abs(found.r2("contact")) < 0.05
    low, high = found.interval("position")
    assert low <= found.r2("position") <= high


def test_knowing_the_environment_does_not_help_on_others() -> None:
    proprio, wanted, valid = _made()
    wanted = wanted + 5 * torch.randn(wanted.shape[1], 12, generator=torch.Generator().manual_seed(2))
    place = torch.eye(wanted.shape[1]).expand(len(wanted), -1, -1)
    assert _readout(place, proprio, wanted, valid).r2("position") < 0.05


def test_steps_that_do_not_count_change_nothing() -> None:
    proprio, wanted, valid = _made()
    features = wanted + 0.5 * torch.randn(wanted.shape, generator=torch.Generator().manual_seed(3))
    valid[:10] = False
    first = _readout(features, proprio, wanted, valid)
    spoilt = wanted.clone()
    spoilt[:10] = 1e6
    second = _readout(features, proprio, spoilt, valid)
    np.testing.assert_array_equal(first.errors, second.errors)


def test_an_arm_differs_from_itself_by_nothing_and_draws_widen_the_interval() -> None:
    proprio, wanted, valid = _made()
    one = _readout(wanted + 0.5, proprio, wanted, valid)
    assert one.interval("spin", less=one) == (0.0, 0.0)
    other = _readout(torch.zeros_like(wanted), proprio, wanted, valid)
    both = Readout("both", 12, np.concatenate([one.errors, other.errors]), one.spread)
    low, high = both.interval("spin")
    assert high - low > 0.4
    assert both.per_draw("spin")[0] > 0.99 > 0.1 > both.per_draw("spin")[1]


def test_memory_begins_anew_with_an_episode() -> None:
    begun = torch.zeros(6, 2, dtype=torch.bool)
    begun[0] = True
    begun[3, 1] = True
    x = torch.ones(6, 2, 1)
    found = arms.traces(x, begun)
    assert found.shape == (6, 2, 3)
    torch.testing.assert_close(found[:, 0, 1], 1 - 0.5 ** torch.arange(1, 7))
    torch.testing.assert_close(found[3:, 1], found[:3, 0])
    grid = TaxelGrid("xhand1", placement="tips", resolution="low")
    touch = torch.randn(6, 2, 5, grid.items, 6, generator=torch.Generator().manual_seed(0))
    touch[3:, 1] = touch[:3, 0]
    rollout = TouchRollout(torch.zeros(6, 2, 3), touch, begun, {}, ~begun, torch.empty(0))
    state = arms.reservoir(rollout, grid, HandCalibration(), seed=1)
    torch.testing.assert_close(state[3:, 1], state[:3, 0])
    assert not torch.equal(state, arms.reservoir(rollout, grid, HandCalibration(), seed=2))


def test_bits_say_that_more_than_two_taxels_of_a_link_touch() -> None:
    touch = torch.zeros(1, 1, 1, 7, 6)
    touch[..., :2, 2] = 1.0
    touch[..., 4:, 2] = 1.0
    rollout = TouchRollout(torch.zeros(1, 1, 1), touch, torch.ones(1, 1).bool(), {}, torch.ones(1, 1), touch)
    assert arms.bits(rollout, [4, 3]).flatten().tolist() == [0.0, 1.0]


def test_noise_is_no_touch() -> None:
    senses = {"observe": "force_torque", "placement": "tips", "resolution": "low", "threads": 1}
    env = tasks.make("in_palm_rotate", num_envs=4, noisy=True, **senses)
    felt = collect(env, agent("zero", env), 0.25)
    links = [int(probes.active.sum()) for probes in env.hand.layout("low", "tips").values()]
    assert float((felt.taxels != 0).any(-1).float().mean()) > 0.5
    assert float(arms.bits(felt, links).mean()) < 0.1


def test_a_rollout_in_a_task_is_read_from_every_arm_of_a_probe() -> None:
    env = tasks.make(
        "in_palm_rotate", num_envs=10, observe="force_torque", placement="tips", resolution="low", threads=1
    )
    names = ("none", "bits", "graph, memory", "reservoir", "simclr")
    own = f"local-dir:{shipped()[f'{arms.NETWORK}.simclr']}"
    options = ProbeOptions(seconds=1.0, arms=names, reservoirs=2, networks=("s4-small", own))
    read = probe(env, agent("random", env), options)
    found = {one.arm: one for one in read}
    assert [len(one.errors) for one in found.values()] == [1, 1, 1, 2, 1, 1, 1]
    # A folder of the same weights is the same network.
    assert found[own].r2("position") == found["simclr"].r2("position") != found["s4-small"].r2("position")
    assert {(row["arm"], row["less"]) for row in differences(read)} >= {("s4-small", "reservoir"), (own, "reservoir")}
    assert found["none"].features == 0
    assert all(np.isfinite([one.r2(name) for name in TARGETS]).all() for one in found.values())
    with pytest.raises(UsageError, match="runs without end"):
        probe(env, agent("random", env), ProbeOptions(networks=("zhuang-small+gpt",)))
    with pytest.raises(UsageError, match="observe='force_torque'"):
        probe(tasks.make("in_palm_rotate", num_envs=10, threads=1), agent("zero", env), options)
    with pytest.raises(UsageError, match="at least 10 environments; received 2"):
        probe(tasks.make("in_palm_rotate", num_envs=2, threads=1), agent("zero", env), options)


def test_options_of_a_probe_name_the_culprit() -> None:
    with pytest.raises(UsageError, match="did you mean 'reservoir'"):
        ProbeOptions(arms=("resevoir",))
    with pytest.raises(UsageError, match=r"received 0\.1 s"):
        ProbeOptions(seconds=0.1)


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
