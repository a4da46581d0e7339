"""The rsl_rl model class that feels, and its exports."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import pytest
import torch

from brainbench.core.errors import UsageError
from robotics_bridge.policies.encoders.arms import ARMS, EchoState, EncoderConfig, FeatureNorm, RunningScale
from robotics_bridge.policies.student import TactilePolicy
from robotics_bridge.policies.training.distill_config import DistillConfig
from tests.factories.policies import GROUPS, student_observations


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


def test_running_scale_counts_only_what_touches() -> None:
    scale = RunningScale(2)
    assert scale(torch.ones(1, 2)).tolist() == [[1.0, 1.0]]
    scale.update(torch.tensor([[0.0, 4.0], [3.0, 0.0], [0.0, float("nan")]]))
    assert scale(torch.tensor([[3.0, 4.0]])).tolist() == [[1.0, 1.0]]


def test_configurations_survive_a_file_and_name_what_is_wrong() -> None:
    config = EncoderConfig(name="mlp", calibration=EncoderConfig().calibration)
    assert EncoderConfig.of(asdict(config)) == config
    assert EncoderConfig(observe="agg_bool").arm == "rnn"
    assert EncoderConfig(observe="force").arm == "tactile_convrnn"
    with pytest.raises(UsageError, match="did you mean 'resolution'"):
        EncoderConfig.of({"resolutio": "med"})
    with pytest.raises(UsageError, match="did you mean 'tactile_cnn'"):
        EncoderConfig(name="tactil_cnn").build()
    with pytest.raises(UsageError, match=r"'tactile_cnn' .*'agg_bool'"):
        EncoderConfig(name="tactile_cnn", observe="agg_bool").build()
    with pytest.raises(UsageError, match=r"\[5, 199, 6\]; .*\[5, 45, 6\]"):
        TactilePolicy(student_observations(1)[0], GROUPS, "student", 12, tactile={"name": "mlp"})
    with pytest.raises(UsageError, match=r"tactile={'name'"):
        TactilePolicy(student_observations(1)[0], GROUPS, "student", 12)


def test_per_link_images_hold_each_taxel_once() -> None:
    encoder = EncoderConfig(name="tactile_cnn", placement="hand", resolution="high").build()
    slots, items, channels = encoder.shape
    assert items == 667
    taxels = torch.arange(1.0, items + 1).view(1, 1, items, 1).expand(1, slots, items, channels)
    pictures = encoder.pictures(taxels)  # type: ignore[attr-defined]
    values = pictures[:, 0].flatten()
    assert sorted(values[values != 0].tolist()) == np.arange(1.0, items + 1).tolist()


@pytest.mark.parametrize("name", ["tactile_convrnn", "tactile_canvas_convrnn"])
def test_convolutions_as_products_give_the_same_answers_and_gradients(name) -> None:
    encoder = EncoderConfig(name=name, placement="tips", resolution="low").build()
    with torch.no_grad():
        for weight in encoder.parameters():
            weight += 0.1 * torch.randn(weight.shape, generator=torch.Generator().manual_seed(2))
    touch = student_observations(6, 3)["tactile"]
    ended = torch.tensor([[0, 1, 0, 0, 0, 1], [1, 0, 0, 0, 0, 0], [0, 0, 1, 0, 0, 0]], dtype=torch.bool)
    found = []
    for unroll in (super(type(encoder), encoder).unroll, encoder.unroll_as_products):  # type: ignore[operator]
        encoder.zero_grad()
        h = torch.full((6, encoder.state_size), 0.1, requires_grad=True)
        y, after = unroll(touch, h, ended)
        (y.pow(2).mean() + after.pow(3).mean()).backward()
        found.append([y.detach(), after.detach(), h.grad, *(weight.grad for weight in encoder.parameters())])
    for slow, fast in zip(*found, strict=True):
        scale = float(slow.abs().max())
        torch.testing.assert_close(fast, slow, rtol=1e-3, atol=1e-5 * scale)
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
        mixed, _ = encoder.unroll_as_products(touch, h.detach(), ended)  # type: ignore[operator]
    torch.testing.assert_close(mixed.float(), found[0][0], rtol=0, atol=0.05 * float(found[0][0].abs().max()))


def test_units_are_of_the_lstm_alone() -> None:
    small, usual = (EncoderConfig(name="rnn", **own).build() for own in ({"units": 9}, {}))
    assert (small.state_size, usual.state_size) == (18, 128)
    count = [sum(weight.numel() for weight in each.parameters()) for each in (small, usual)]
    assert count[0] < count[1] / 6


@pytest.mark.parametrize(
    ("name", "own", "told"),
    [
        ("reservoir", {"units": 9}, "'units' = 9 .*'rnn'; 'reservoir'"),
        ("zhuang-small", {"units": 9}, "'units' = 9 .*'rnn'; 'zhuang-small'"),
        ("auto", {"time": "resampled"}, "'time' .*network.*'tactile_convrnn'"),
        ("reservoir", {"learning": "finetuned"}, "'learning' .*network.*'reservoir'"),
        ("mlp", {"pretrained": "a.safetensors"}, "'pretrained' .*network.*'mlp'"),
        ("rnn", {"options": {"unroll": "full"}}, "'options' .*network.*'rnn'"),
        ("tactile_cnn", {"calibration": {"force": 2.0}}, "'calibration' .*network.*'tactile_cnn'"),
        ("zhuang-small", {"time": "resample"}, "did you mean 'resampled'"),
        ("zhuang-small", {"learning": "froze"}, "did you mean 'frozen'"),
        ("reservoir", {"seed": -1}, "'seed' .*at least 0"),
    ],
)
def test_settings_that_an_encoder_does_not_have_are_refused(name, own, told) -> None:
    with pytest.raises(UsageError, match=told):
        EncoderConfig.of({"name": name, **own})
    with pytest.raises(UsageError, match=told):
        DistillConfig(task="in_palm_rotate", encoder=name, encoder_settings=own)


@pytest.mark.parametrize("name", [*ARMS, "zhuang-small"])
def test_settings_at_their_defaults_are_of_every_encoder(name) -> None:
    config = EncoderConfig(name=name)
    assert EncoderConfig.of(asdict(config)) == config
