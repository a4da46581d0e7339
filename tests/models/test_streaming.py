import pytest
import torch
from torch import nn

from brainbench.core.errors import UsageError
from brainbench.models.registry import load_model
from brainbench.models.streaming import StreamingStep
from tests.factories.training_sweeps import random_sweeps

NAMES = ["zhuang-intersection-ln-small", "zhuang-lstm-small+gpt", "zhuang-feedforward-small", "resnet18-small",
         "resnet18-small+mamba", "s4-small", "s4-small+gpt", "zhuang-small+mamba"]  # fmt: skip


@torch.no_grad()
@pytest.mark.parametrize("name", NAMES)
def test_a_flat_state_streams_the_sweeps_features(name):
    model, x = load_model(name), random_sweeps(2, 6)
    step, expected = StreamingStep(model), model.encode(x)
    h = step.init_state(2)
    for t in range(6):
        features, h = step(x[:, t], h)
        torch.testing.assert_close(features, expected[:, t], atol=1e-4, rtol=1e-4)
    assert h.shape == (2, step.state_size)


@torch.no_grad()
@pytest.mark.parametrize("name", ["zhuang-ugrnn-small+gpt", "s4-small+mamba"])
def test_zeroing_a_row_resets_it_alone(name):
    model, x = load_model(name), random_sweeps(2, 4)
    step = StreamingStep(model)
    h = step.init_state(2)
    for t in range(3):
        _, h = step(x[:, t], h)
    h[0] = 0.0
    features, _ = step(x[:, 3], h)
    torch.testing.assert_close(features[:1], model.encode(x[:1, 3:])[:, 0], atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(features[1:], model.encode(x[1:])[:, 3], atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("wrong", [-1, 1.5, None, True])
def test_states_are_of_a_whole_number_of_sweeps(wrong):
    model = load_model("zhuang-small")
    for of in (model, StreamingStep(model)):
        with pytest.raises(UsageError, match=f"batch .*{wrong}"):
            of.init_state(wrong)


@torch.no_grad()
def test_a_full_context_gives_nan_until_it_is_reset():
    model = load_model("zhuang-small+gpt")
    step, x = StreamingStep(model), random_sweeps(1, 1)[:, 0]
    h = step.init_state(1)
    for t in range(model.spec.max_steps + 1):
        features, h = step(x, h)
        assert torch.isfinite(features).all() == (t < model.spec.max_steps)
    assert torch.isfinite(step(x, step.init_state(1))[0]).all()


@torch.no_grad()
@pytest.mark.parametrize("turn", [lambda step: step, lambda step: step.eval().double()])
def test_a_state_space_follows_its_weights_and_their_precision(turn):
    model, other, x = load_model("s4-small"), load_model("s4-small", seed=1), random_sweeps(2, 4)
    step = StreamingStep(model)
    model.load_state_dict(other.state_dict())
    turn(step)
    h = step.init_state(2)
    x, other = x.to(h.dtype), other.to(h.dtype)
    for t in range(4):
        features, h = step(x[:, t], h)
    assert features.dtype == h.dtype
    torch.testing.assert_close(features, other.encode(x)[:, 3], atol=1e-4, rtol=1e-4)


def test_a_state_space_learns_through_its_stream():
    model, x = load_model("s4-small"), random_sweeps(2, 3)
    step = StreamingStep(model)
    h = step.init_state(2)
    for t in range(3):
        features, h = step(x[:, t], h)
    features.square().sum().backward()
    memory = model.encoder.blocks[0].memory
    assert all(weight.grad is not None and weight.grad.abs().sum() > 0 for weight in memory.parameters())
    streamed = {name: weight.grad.clone() for name, weight in memory.named_parameters()}
    model.zero_grad()
    model.encode(x)[:, 2].square().sum().backward()
    for name, weight in memory.named_parameters():
        torch.testing.assert_close(streamed[name], weight.grad, rtol=1e-3, atol=1e-3 * weight.grad.abs().max().item())


@pytest.mark.gpu
@torch.no_grad()
@pytest.mark.parametrize("name", NAMES)
def test_a_stream_moves_to_a_gpu(name):
    step, x = StreamingStep(load_model(name)), random_sweeps(2, 2)
    expected, h = [], step.init_state(2)
    for t in range(2):
        features, h = step(x[:, t], h)
        expected.append(features)
    step.cuda()
    h = step.init_state(2)
    for t in range(2):
        features, h = step(x[:, t].cuda(), h)
        torch.testing.assert_close(features.cpu(), expected[t], atol=1e-3, rtol=1e-3)


def test_other_networks_are_refused():
    with pytest.raises(UsageError, match="received Linear"):
        StreamingStep(nn.Linear(2, 2))
