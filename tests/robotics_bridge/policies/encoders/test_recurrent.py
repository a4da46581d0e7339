"""A random encoder to hold others against, and features standardised one by one."""

from __future__ import annotations

import pytest
import torch

from robotics_bridge.policies.encoders.recurrent import EchoState, FeatureNorm
from robotics_bridge.policies.training.distill_config import DistillConfig


def test_the_same_seed_is_the_same_network_and_it_forgets_what_is_long_past() -> None:
    one, same, other = (EchoState(12, 20, seed=seed) for seed in (1, 1, 2))
    assert torch.equal(one.inner, same.inner)
    assert not torch.equal(one.inner, other.inner)
    assert torch.linalg.eigvals(one.inner).abs().max() == pytest.approx(0.9, abs=1e-5)
    drive = torch.randn(300, 1, 20, generator=torch.Generator().manual_seed(0))
    first, second = torch.zeros(1, 20), torch.ones(1, 20)
    for each in drive:
        first, second = one(each, first), one(each, second)
    torch.testing.assert_close(first, second)
    assert first.abs().max() > 0.05


def test_constant_energy_is_taken_away_and_small_features_count_as_much_as_large_ones() -> None:
    norm = FeatureNorm(3)
    x = torch.randn(4000, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([1e-5, 1.0, 1.0])
    x += torch.tensor([1e-4, 50.0, 0.0])
    for part in x.split(500):
        norm(part)
    found = norm.eval()(x)
    torch.testing.assert_close(found.mean(0), torch.zeros(3), atol=0.02, rtol=0)
    torch.testing.assert_close(found.std(0), torch.ones(3), atol=0.02, rtol=0)
    # After training nothing is counted any more, whatever the batch.
    torch.testing.assert_close(norm(x[:1]), found[:1])
    assert float(norm.count) == 4000


@pytest.mark.parametrize("name", ["reservoir", "reservoir_graph"])
def test_the_arm_steps_remembers_and_takes_its_draw_from_the_student(name: str) -> None:
    config = DistillConfig(task="in_palm_rotate", encoder=name, placement="tips", resolution="low", seed=4)
    assert config.tactile is not None
    assert config.tactile.seed == 4
    assert config.draw == "seed 4"
    with torch.random.fork_rng():
        torch.manual_seed(0)
        arm = config.tactile.build()
    touch = torch.randn(2, 6, *arm.shape, generator=torch.Generator().manual_seed(1))
    arm.observe_scale(touch)
    zeros = torch.zeros(6, arm.state_size)
    y, state = arm.train().unroll(touch, zeros)
    assert (tuple(y.shape), tuple(state.shape)) == ((2, 6, 32), (6, 96))
    learned = {name for name, _ in arm.named_parameters()}
    assert learned == {"project.weight", "project.bias"}
    ended = torch.tensor([[True] * 6, [False] * 6])
    again, _ = arm.eval().unroll(touch[[1, 1]], zeros, ended)
    torch.testing.assert_close(again[0], again[1])
    # Rows are independent.
    torch.testing.assert_close(arm(touch[0, :2], zeros[:2])[0], arm(touch[0], zeros)[0][:2])
