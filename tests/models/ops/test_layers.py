from __future__ import annotations

import math
import re
import warnings

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn
from torch.nn import functional

from brainbench.core.errors import DataError, UsageError
from brainbench.models.cells import UGRNN
from brainbench.models.ops.layers import (
    Conv2d,
    Linear,
    activation,
    draw_silent_biases,
    load_named,
    packed,
    seeded,
    weights_hash,
)
from brainbench.models.registry import load_model


def test_silent_biases_lie_where_pytorch_draws_them_and_repeat_with_the_seed():
    def drawn(seed):
        layer = Conv2d(3, 200, kernel_size=(2, 2))
        with seeded(seed):
            draw_silent_biases(nn.Sequential(layer, nn.LayerNorm(2)))
        return layer.bias.detach()

    bound = 12**-0.5
    assert drawn(0).abs().max() <= bound
    assert drawn(0).std() == pytest.approx(bound / 3**0.5, rel=0.1)
    assert torch.equal(drawn(0), drawn(0))
    assert not torch.equal(drawn(0), drawn(1))


def test_parameters_are_loaded_all_or_none():
    targets = {"weight": torch.zeros(2, 3), "bias": torch.zeros(2)}
    given = {"weight": np.ones((2, 3), dtype=np.float32), "bias": torch.full((2,), 2.0)}
    for change, words in (
        ({"bias": torch.zeros(3)}, r"'bias' has shape \[3\], expected \[2\]"),
        ({"wieght": torch.zeros(1)}, "did you mean 'wieght' → 'weight'"),
        ({"bias": torch.full((2,), 127, dtype=torch.int8)}, r"'bias' of the layer must be .* floating point"),
        ({"bias": torch.ones(2, dtype=torch.float8_e4m3fn)}, r"'bias' of the layer must be .* floating point"),
        ({"bias": torch.ones(2, dtype=torch.complex64)}, r"'bias' of the layer must be .* floating point"),
    ):
        with pytest.raises(DataError, match=words):
            load_named(targets, given | change, what="the layer")
        assert not any(value.any() for value in targets.values())
    with pytest.raises(DataError, match="missing 'bias'"):
        load_named(targets, {"weight": given["weight"]}, what="the layer")
    load_named(targets, given, what="the layer")
    assert targets["weight"].eq(1).all()
    assert targets["bias"].eq(2).all()


def test_the_hash_is_of_values_whatever_drew_them():
    with seeded(3):
        first = torch.nn.Linear(3, 2)
    with seeded(3):
        again = torch.nn.Linear(3, 2)
    assert weights_hash(first) == weights_hash(again)
    half = weights_hash(again.to(torch.bfloat16))
    assert half == weights_hash(again.float())
    with torch.no_grad():
        again.bias[0] += 1
    assert weights_hash(again) != half


@settings(max_examples=40)
@given(
    kernel=st.tuples(st.integers(1, 4), st.integers(1, 4)),
    grid=st.tuples(st.integers(1, 7), st.integers(1, 7)),
)
def test_same_padding_equals_pytorchs(kernel, grid):
    layer = Conv2d(2, 3, kernel_size=kernel, bias=None)
    x = torch.randn(2, 2, *grid)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # PyTorch warns about the zero-padded copy of even kernels
        expected = functional.conv2d(x, layer.weight, layer.bias, padding="same")
    torch.testing.assert_close(layer(x), expected, atol=1e-6, rtol=1e-5)


def test_an_even_same_convolution_does_not_warn():
    assert Conv2d(1, 1, kernel_size=(2, 2))(torch.ones(1, 1, 5, 7)).shape == (1, 1, 5, 7)


@pytest.mark.parametrize("gain", [1.0, math.sqrt(2.0)])
def test_weights_have_the_variance_they_promise(gain):
    weight = Linear(400, 500, gain=gain).weight
    assert weight.var().item() == pytest.approx(gain**2 / 400, rel=0.02)
    assert weight.mean().item() == pytest.approx(0.0, abs=1e-3)


def test_a_named_initialiser_is_used():
    weight = Linear(8, 8, method={"method": "orthogonal_", "gain": 2.0}).weight
    torch.testing.assert_close(weight @ weight.T, 4 * torch.eye(8), atol=1e-5, rtol=0)


def test_a_rectified_stack_keeps_the_scale_of_its_signal():
    x = torch.randn(200, 256)
    for _ in range(12):
        x = torch.relu(Linear(256, 256, gain=math.sqrt(2.0))(x))
    assert 0.3 < x.pow(2).mean().sqrt().item() < 3.0


def test_an_unknown_activation_names_the_nearest():
    with pytest.raises(UsageError, match="did you mean 'relu'"):
        activation("Rellu")


@pytest.mark.parametrize("value", [0, (2, 0), (1, 2, 3), (2.0, 2)])
def test_a_bad_kernel_size_says_what_was_received(value):
    with pytest.raises(UsageError, match="kernel size .*received " + re.escape(str(value))):
        UGRNN(3, 3, kernel_size=value)


@torch.no_grad()
@pytest.mark.parametrize("padding", ["same", "valid", (1, 0)])
@pytest.mark.parametrize("stride", [(1, 1), (2, 1)])
def test_one_stimulus_gives_what_many_give(padding, stride):
    options = {} if padding == "same" and stride != (1, 1) else {"stride": stride}
    layer, x = Conv2d(400, 200, kernel_size=(2, 2), padding=padding, **options), torch.randn(3, 400, 4, 6)
    torch.testing.assert_close(layer(x[:1]), layer(x)[:1], atol=1e-4, rtol=1e-4)
    whole = layer.conv_slice(x[:1, :150], 0, use_bias=True) + layer.conv_slice(x[:1, 150:], 150, use_bias=False)
    torch.testing.assert_close(whole, layer(x)[:1], atol=1e-4, rtol=1e-4)


def test_parts_without_layer_norm_and_biases_that_are_there_stay_as_they_are():
    silent, stated = Linear(2, 2), Linear(2, 2, bias=1.0)
    draw_silent_biases(nn.Sequential(silent, nn.BatchNorm1d(2)))
    draw_silent_biases(nn.Sequential(stated, nn.LayerNorm(2)))
    assert silent.bias.tolist() == [0.0, 0.0]
    assert stated.bias.tolist() == [1.0, 1.0]


def _stream(model, sweep):
    state, outputs = model.init_state(1), []
    with torch.no_grad():
        for x in sweep:
            y, state = model.step(x[None], state)
            outputs.append(y)
    return torch.cat(outputs)


@pytest.mark.parametrize("name", ["zhuang-intersection-ln-small", "resnet18-small", "s4-small+gpt"])
@pytest.mark.parametrize(("precision", "tolerance"), [("float32", 1e-5), ("bf16", 0.05)])
@pytest.mark.parametrize("ordered", [None, False], ids=["as-this-processor-can", "plain-order"])
def test_a_packed_network_streams_as_the_plain_one(name, precision, tolerance, ordered, monkeypatch):
    if ordered is not None:
        monkeypatch.setattr("brainbench.models.ops.layers._onednn_orders", lambda dtype: ordered)
    model = load_model(name, classes=5)
    sweep = torch.randn(8, 30, 5, 7, generator=torch.Generator().manual_seed(1)) * model.normaliser.scale
    plain, fast = _stream(model, sweep), _stream(packed(model, precision=precision), sweep)
    assert (fast - plain).abs().max() <= tolerance * plain.abs().max()
    assert precision == "float32" or not torch.equal(fast, plain)


def test_packing_leaves_the_network_and_larger_batches_as_they_were():
    model = load_model("zhuang-ugrnn-small", classes=5)
    before = {name: value.clone() for name, value in model.state_dict().items()}
    fast = packed(model, precision="bf16")
    x = torch.randn(3, 4, 30, 5, 7) * model.normaliser.scale
    with torch.no_grad():
        assert torch.equal(fast(x), model(x))
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())
    assert fast.state_dict().keys() == before.keys()


def test_an_unknown_precision_is_named():
    with pytest.raises(UsageError, match=r"int4.*bf16"):
        packed(load_model("s4-small"), precision="int4")
